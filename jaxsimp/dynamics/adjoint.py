"""The time steps of an action, and their adjoint in memory of the square root of their number.

Reverse mode keeps the states at the start of `sqrt(S)` segments of the S steps. The backward pass
repeats the steps of one segment, keeps their states, and then takes their adjoints.
"""

import math
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import PyTreeDef
from jaxtyping import Array, Bool, Float, Int

from jaxsimp.dynamics.batching import batch_last
from jaxsimp.dynamics.simulation import Simulation
from jaxsimp.dynamics.step import Axes, Motion, Packed, step, step_and_free, step_vjp


def plain_steps(
    simulation: Simulation, packed: Packed, motion: Motion, shares: Float[Array, " S"]
) -> Packed:
    """Time steps in which held particles move by fractions of their drive."""

    def one(packed: Packed, share: Float[Array, ""]) -> tuple[Packed, None]:
        return step(simulation, packed, motion, share), None

    return jax.lax.scan(one, packed, shares)[0]


def steps(
    simulation: Simulation, packed: Packed, motion: Motion, shares: Float[Array, " S"]
) -> Packed:
    """`plain_steps`, differentiated in reverse mode by the adjoint; shares count as constants."""
    leaves, tree = jax.tree.flatten(simulation)
    return _steps(tree, leaves, packed, motion.held, motion.drive, shares)


# Leaves, not a `Simulation`: JAX builds trees of objects that are not arrays here.
@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _steps(
    tree: PyTreeDef,
    leaves: list[Any],
    packed: Packed,
    held: Bool[Array, "N *B"],
    drive: Float[Array, "3 N *B"],
    shares: Float[Array, " S"],
) -> Packed:
    def run(shared: Shared, own: tuple[Any, ...]) -> Packed:
        leaves, shares = shared
        packed, *motion = own
        return plain_steps(_simulation(tree, leaves), packed, Motion(*motion), shares)

    return batch_last(run)((leaves, shares), (packed, held, drive))


Shared = tuple[list[Any], Float[Array, " S"]]
"""Leaves of the simulation, and the shares; the same for all samples of a batch."""
Starts = tuple[Float[Array, "segments 3 NHH *B"], Float[Array, "segments 3 NHH *B"]]
"""States at the start of segments."""
Kept = tuple[Shared, tuple[Any, Any], Starts, list[Any] | None]
"""Arguments, states at the start of segments, and zero cotangents of the simulation, if wanted."""


def _forward(tree: PyTreeDef, *arguments: Any) -> tuple[Packed, Kept]:
    """Take the steps, and keep the inputs of their adjoint."""
    wanted = any(leaf.perturbed for leaf in arguments[0])
    leaves, packed, held, drive, shares = jax.tree.map(
        lambda leaf: jnp.asarray(leaf.value),
        arguments,
        is_leaf=lambda leaf: hasattr(leaf, "perturbed"),
    )

    def run(shared: Shared, own: tuple[Any, ...]) -> tuple[Packed, Starts]:
        (leaves, shares), (packed, *motion) = shared, own
        simulation = _simulation(tree, leaves)

        def segment(packed: Packed, bounds: Int[Array, " 2"]) -> tuple[Packed, Packed]:
            def one(i: Int[Array, ""], packed: Packed) -> Packed:
                return step(simulation, packed, Motion(*motion), shares[i])

            return jax.lax.fori_loop(bounds[0], bounds[1], one, packed), packed

        return jax.lax.scan(segment, packed, jnp.asarray(_segments(len(shares))))

    shared, motion = (leaves, shares), (held, drive)
    packed, starts = batch_last(run)(shared, (packed, *motion))
    zeros = jax.tree.map(jnp.zeros_like, leaves) if wanted else None
    return packed, (shared, motion, starts, zeros)


Recorded = tuple[Packed, Axes]
"""A state, and the velocities after the next step without contact."""
Bars = tuple[Simulation | None, tuple[Axes, Axes], Axes]
"""Cotangents of the simulation, if wanted, of the state without halo, and of the drive."""


def _backward(
    tree: PyTreeDef, kept: Kept, packed_bar: Any
) -> tuple[list[Any] | None, Packed, None, Float[Array, "3 N"], None]:
    """Repeat the steps of each segment, from the last one, and take their adjoints backwards."""
    shared, motion, starts, zeros = kept
    packed_bar = jax.tree.map(_dense, packed_bar, is_leaf=_is_zero)

    def run(shared: Any, own: Any) -> tuple[Any, ...]:
        (leaves, shares), zeros = shared
        motion, starts, packed_bar = own
        return _adjoint_steps(tree, leaves, shares, zeros, Motion(*motion), starts, packed_bar)

    # Cotangents of a simulation belong to one sample each: with them a batch goes first.
    adjoint = run if zeros else batch_last(run)
    simulation_bar, packed_bar, drive_bar = adjoint((shared, zeros), (motion, starts, packed_bar))
    leaves_bar = [
        leaf if jnp.issubdtype(leaf.dtype, jnp.floating) else None  # ids have no cotangent
        for leaf in jax.tree.leaves(simulation_bar)
    ]
    return leaves_bar or None, packed_bar, None, drive_bar, None


def _adjoint_steps(
    tree: PyTreeDef,
    leaves: list[Any],
    shares: Float[Array, " S"],
    zeros: list[Any] | None,
    motion: Motion,
    starts: Starts,
    packed_bar: Packed,
) -> tuple[Simulation | None, Packed, Float[Array, "3 N *B"]]:
    """Cotangents of the simulation, if `zeros` are given, of the first state, and of the drive."""
    simulation = _simulation(tree, leaves)
    simulation_bar = None if zeros is None else _simulation(tree, zeros)
    segments = _segments(len(shares))
    length = int(np.diff(segments).max(initial=0))
    padded = jnp.pad(shares, (0, length))

    def segment(bars: Bars, saved: tuple[Int[Array, " 2"], Packed]) -> tuple[Bars, None]:
        (first, end), packed = saved

        def record(packed: Packed, share: Float[Array, ""]) -> tuple[Packed, Recorded]:
            after, free = step_and_free(simulation, packed, motion, share)
            return after, (packed, free)

        again = jax.lax.dynamic_slice_in_dim(padded, first, length)
        _, (states, free) = jax.lax.scan(record, packed, again)

        def state_at(i: Int[Array, ""]) -> Packed:
            return jax.tree.map(lambda array: array[jnp.maximum(i - first, 0)], states)

        def back(k: Int[Array, ""], carry: tuple[Bars, Packed]) -> tuple[Bars, Packed]:
            (simulation_bar, packed_bar, drive_bar), packed = carry
            i = end - 1 - k
            more, packed_bar, drive_more = step_vjp(
                simulation,
                packed,
                [axis[i - first] for axis in free],
                motion,
                shares[i],
                packed_bar,
                simulation_bar is not None,
            )
            if simulation_bar is not None:
                simulation_bar = jax.tree.map(jnp.add, simulation_bar, more)
            # Carry the state of the next turn: otherwise XLA reads it from `states` again for each
            # of its uses, element by element.
            drive_bar = [a + b for a, b in zip(drive_bar, drive_more, strict=True)]
            return (simulation_bar, packed_bar, drive_bar), state_at(i - 1)

        return jax.lax.fori_loop(0, end - first, back, (bars, state_at(end - 1)))[0], None

    halo, count = simulation.springs.halo, len(simulation.mass)
    position_bar, velocity_bar = (_rows(bar, halo, count) for bar in packed_bar)
    drive_bar = [jnp.zeros_like(row) for row in motion.drive]
    bars: Bars = simulation_bar, (position_bar, velocity_bar), drive_bar
    bars, _ = jax.lax.scan(segment, bars, (jnp.asarray(segments), starts), reverse=True)
    simulation_bar, (position_bar, velocity_bar), drive_bar = bars
    packed_bar = _stack(position_bar, halo), _stack(velocity_bar, halo)
    return simulation_bar, packed_bar, _stack(drive_bar, 0)


def _rows(array: Float[Array, "3 NHH *B"], halo: int, count: int) -> Axes:
    """The rows of an array, without halo."""
    return [array[axis, halo : halo + count] for axis in range(3)]


def _stack(rows: Axes, halo: int) -> Float[Array, "3 NHH *B"]:
    """An array of rows, with a halo of zeros."""
    padding = ((0, 0), (halo, halo)) + ((0, 0),) * (rows[0].ndim - 1)
    return jnp.pad(jnp.stack(rows), padding)


_steps.defvjp(_forward, _backward, symbolic_zeros=True)


def _simulation(tree: PyTreeDef, leaves: list[Any]) -> Simulation:
    # JAX passes constants on as NumPy arrays.
    return jax.tree.unflatten(tree, [jnp.asarray(leaf) for leaf in leaves])


def _segments(count: int) -> Int[np.ndarray, "segments 2"]:
    """First and end step of about `sqrt(count)` segments of about `sqrt(count)` steps each."""
    length = math.isqrt(max(count - 1, 0)) + 1
    first = np.arange(0, count, length)
    return np.stack([first, np.minimum(first + length, count)], axis=1)


def _is_zero(tree: Any) -> bool:
    return isinstance(tree, jax.custom_derivatives.SymbolicZero)


def _dense(bar: Any) -> Array:
    return jnp.zeros(bar.shape, bar.dtype) if _is_zero(bar) else bar
