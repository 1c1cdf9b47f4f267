"""The time steps of an action, and their adjoint in memory of the square root of their number.

Reverse mode keeps the states at the start of `sqrt(S)` segments of the S steps. The backward pass
repeats the steps of one segment, keeps their states, and then takes their adjoints.
"""

import dataclasses
import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import PyTreeDef
from jaxtyping import Array, Bool, Float, Int

from jaxsimp.dynamics.batching import batch_last
from jaxsimp.dynamics.contact.contacts import DIRECTION, Contacts
from jaxsimp.dynamics.contact.layers import PARAMETERS
from jaxsimp.dynamics.contact.stepping import (
    Moving,
    Touch,
    advance,
    touch_step,
    touch_step_vjp,
)
from jaxsimp.dynamics.simulation import Simulation
from jaxsimp.dynamics.step import Axes, Motion, Packed, step_and_free, step_vjp

try:
    from jaxsimp.dynamics.modes import constant, forward_only, reverse_only
except (ImportError, AttributeError):  # of a JAX that is made otherwise: its own words must do
    constant = forward_only = reverse_only = lambda tree: tree


def plain_steps(
    simulation: Simulation, moving: Moving, motion: Motion, shares: Float[Array, " S"]
) -> Moving:
    """Time steps in which held particles move by shares of their drive.

    In JAX alone, so that it differentiates them in any mode and order.
    """
    return _run(simulation, moving, motion, shares, use_kernel=False)


def _run(
    simulation: Simulation,
    moving: Moving,
    motion: Motion,
    shares: Float[Array, " S"],
    *,
    use_kernel: bool,
) -> Moving:
    def one(moving: Moving, share: Float[Array, ""]) -> tuple[Moving, None]:
        return advance(simulation, moving, motion, share, use_kernel=use_kernel), None

    return jax.lax.scan(one, moving, shares)[0]


def steps(
    simulation: Simulation, moving: Moving, motion: Motion, shares: Float[Array, " S"]
) -> Moving:
    """`plain_steps`, differentiated in reverse mode, once, by the adjoint.

    Shares count as constants. A CPU runs contact by its compiled kernels.
    """
    leaves, tree = jax.tree.flatten(simulation)
    leaves, flat, drive = reverse_only((leaves, _flat(moving), motion.drive))
    return _moving(_steps(tree, leaves, flat, motion.held, drive, shares))


Flat = tuple[Packed, list[Any]]
"""A state, and the fields of its contacts, none without self-contact."""
Starts = tuple[tuple[Any, Any], list[Any]]
"""`Flat`, with an axis of segments first: the states that they start from."""


# Of leaves, not of a `Simulation`: JAX makes trees of things that are no arrays here.
@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _steps(
    tree: PyTreeDef,
    leaves: list[Any],
    flat: Flat,
    held: Bool[Array, "N *B"],
    drive: Float[Array, "3 N *B"],
    shares: Float[Array, " S"],
) -> Flat:
    def run(shared: Shared, own: tuple[Any, ...]) -> Flat:
        leaves, shares = shared
        flat, *motion = own
        simulation = _simulation(tree, leaves)
        moving = _run(simulation, _moving(flat), Motion(*motion), shares, use_kernel=True)
        return _flat(moving)

    return _batched(run, flat)((leaves, shares), (flat, held, drive))


def _batched(run: Callable[..., Any], flat: Flat | Starts) -> Callable[..., Any]:
    """The function, with the axis of a batch last for a body that does not touch itself.

    Contacts are of one sample each: with them a batch goes first.
    """
    return run if flat[1] else batch_last(run)


Shared = tuple[list[Any], Float[Array, " S"]]
"""Leaves of the simulation, and the shares: what is the same for all samples of a batch."""
Kept = tuple[Shared, tuple[Any, Any], Starts, list[Any] | None]
"""Arguments, states at the start of segments, and zero cotangents of the simulation, if wanted."""


def _forward(tree: PyTreeDef, *arguments: Any) -> tuple[Flat, Kept]:
    """The steps, and what their adjoint needs."""
    wanted = any(leaf.perturbed for leaf in arguments[0])
    leaves, flat, held, drive, shares = jax.tree.map(
        lambda leaf: jnp.asarray(leaf.value),
        arguments,
        is_leaf=lambda leaf: hasattr(leaf, "perturbed"),
    )
    again = constant if flat[1] else forward_only  # compiled kernels have no derivative
    leaves, flat, drive = again((leaves, flat, drive))

    def run(shared: Shared, own: tuple[Any, ...]) -> tuple[Flat, Starts]:
        (leaves, shares), (flat, *motion) = shared, own
        simulation = _simulation(tree, leaves)

        def segment(flat: Flat, bounds: Int[Array, " 2"]) -> tuple[Flat, Flat]:
            def one(i: Int[Array, ""], flat: Flat) -> Flat:
                return _flat(advance(simulation, _moving(flat), Motion(*motion), shares[i]))

            return jax.lax.fori_loop(bounds[0], bounds[1], one, flat), flat

        return jax.lax.scan(segment, flat, jnp.asarray(_segments(len(shares))))

    shared, motion = (leaves, shares), (held, drive)
    after, starts = _batched(run, flat)(shared, (flat, *motion))
    zeros = jax.tree.map(jnp.zeros_like, leaves) if wanted else None
    return after, (shared, motion, starts, zeros)


def _backward(
    tree: PyTreeDef, kept: Kept, flat_bar: Any
) -> tuple[list[Any] | None, Any, None, Float[Array, "3 N"], None]:
    """Segment by segment from the last: its steps again, then their adjoints backwards."""
    shared, motion, starts, zeros = kept
    packed_bar, fields_bar = flat_bar
    # Of the contacts, directions alone have a cotangent.
    given = jax.tree.map(_dense, (packed_bar, fields_bar[DIRECTION:][:1]), is_leaf=_is_zero)

    def run(shared: Any, own: Any) -> tuple[Any, ...]:
        (leaves, shares), zeros = shared
        motion, starts, given = own
        return _adjoint_steps(tree, leaves, shares, zeros, Motion(*motion), starts, *given)

    # Cotangents of a simulation belong to one sample each: with them a batch goes first.
    adjoint = run if zeros else _batched(run, starts)
    simulation_bar, packed_bar, directions_bar, drive_bar = adjoint(
        (shared, zeros), (motion, starts, given)
    )
    fields_bar = [None] * len(fields_bar)
    if directions_bar:
        fields_bar[DIRECTION] = directions_bar[0]
    leaves_bar = [
        leaf if jnp.issubdtype(leaf.dtype, jnp.floating) else None  # ids have no cotangent
        for leaf in jax.tree.leaves(simulation_bar)
    ]
    return leaves_bar or None, (packed_bar, fields_bar), None, drive_bar, None


class Bars(NamedTuple):
    """Cotangents that are carried backwards.

    Attributes:
        simulation: of the simulation without self-contact, None if not wanted.
        packed: of positions and velocities, without halo.
        drive: of the drive.
        direction: of the directions of contacts, None without self-contact.
        parameters: of the parameters of contact, None without self-contact.
    """

    simulation: Simulation | None
    packed: tuple[Axes, Axes]
    drive: Axes
    direction: Array | None
    parameters: dict[str, Array] | None


Recorded = tuple[Packed, Axes, Touch | None]
"""A state, the velocities without contact after the step from there, and the contact in it."""


def _adjoint_steps(
    tree: PyTreeDef,
    leaves: list[Any],
    shares: Float[Array, " S"],
    zeros: list[Any] | None,
    motion: Motion,
    starts: Starts,
    packed_bar: Packed,
    directions_bar: list[Array],
) -> tuple[Simulation | None, Packed, list[Array], Float[Array, "3 N *B"]]:
    """Cotangents of the simulation, if `zeros` are given, of the first state, and of the drive.

    Those of directions, of the contacts after and before, are lists of one; empty without contact.
    """
    simulation = _simulation(tree, leaves)
    plain = dataclasses.replace(simulation, self_contact=None)
    segments = _segments(len(shares))
    length = int(np.diff(segments).max(initial=0))
    padded = jnp.pad(shares, (0, length))

    def record(flat: Flat, share: Float[Array, ""]) -> tuple[Flat, Recorded]:
        packed, contacts = _moving(flat)
        moved, free = step_and_free(plain, packed, motion, share)
        if contacts is None:
            return (moved, []), (packed, free, None)
        after, touch = touch_step(simulation, moved, motion, contacts)
        return _flat(after), (packed, free, touch)

    def back_one(bars: Bars, recorded: Recorded, share: Float[Array, ""]) -> Bars:
        packed, free, touch = recorded
        if touch is not None:
            bars = _through_contact(simulation, motion, touch, bars)
        simulation_bar, packed_bar, drive_bar = step_vjp(
            plain, packed, free, motion, share, bars.packed, zeros is not None
        )
        if zeros is not None:
            simulation_bar = jax.tree.map(jnp.add, bars.simulation, simulation_bar)
        drive_bar = [a + b for a, b in zip(bars.drive, drive_bar, strict=True)]
        return bars._replace(simulation=simulation_bar, packed=packed_bar, drive=drive_bar)

    def segment(bars: Bars, saved: tuple[Int[Array, " 2"], Flat]) -> tuple[Bars, None]:
        (first, end), flat = saved
        again = jax.lax.dynamic_slice_in_dim(padded, first, length)
        _, (states, *others) = jax.lax.scan(record, flat, again)

        def state_at(i: Int[Array, ""]) -> Packed:
            return jax.tree.map(lambda array: array[jnp.maximum(i - first, 0)], states)

        def back(k: Int[Array, ""], carry: tuple[Bars, Packed]) -> tuple[Bars, Packed]:
            # The state of the next turn is carried: XLA would look it up in `states` anew for
            # each of its uses, element by element.
            bars, packed = carry
            i = end - 1 - k
            free, touch = jax.tree.map(lambda array: array[i - first], others)
            return back_one(bars, (packed, free, touch), shares[i]), state_at(i - 1)

        return jax.lax.fori_loop(0, end - first, back, (bars, state_at(end - 1)))[0], None

    bars = _first_bars(simulation, motion, zeros is not None, packed_bar, directions_bar)
    bars, _ = jax.lax.scan(segment, bars, (jnp.asarray(segments), starts), reverse=True)
    halo = simulation.springs.halo
    position_bar, velocity_bar = (_stack(rows, halo) for rows in bars.packed)
    simulation_bar = None if zeros is None else _whole(tree, zeros, bars, motion, simulation)
    directions_bar = [] if bars.direction is None else [bars.direction]
    return simulation_bar, (position_bar, velocity_bar), directions_bar, _stack(bars.drive, 0)


def _through_contact(simulation: Simulation, motion: Motion, touch: Touch, bars: Bars) -> Bars:
    """Cotangents before self-contact."""
    assert bars.direction is not None
    packed_bar, direction_bar, more = touch_step_vjp(
        simulation, motion, touch, bars.packed, bars.direction
    )
    parameters_bar = jax.tree.map(jnp.add, bars.parameters, more)
    return bars._replace(packed=packed_bar, direction=direction_bar, parameters=parameters_bar)


def _first_bars(
    simulation: Simulation,
    motion: Motion,
    wanted: bool,
    packed_bar: Packed,
    directions_bar: list[Array],
) -> Bars:
    """Cotangents after the last step; those of the simulation and of parameters are zero."""
    halo, count = simulation.springs.halo, len(simulation.mass)
    position_bar, velocity_bar = (_rows(bar, halo, count) for bar in packed_bar)
    plain, parameters = dataclasses.replace(simulation, self_contact=None), None
    if directions_bar:
        parameters = {name: jnp.zeros_like(simulation.radius) for name in PARAMETERS}
        parameters["inverse_mass"] = jnp.zeros_like(simulation.mass)
    return Bars(
        jax.tree.map(jnp.zeros_like, plain) if wanted else None,
        (position_bar, velocity_bar),
        [jnp.zeros_like(row) for row in motion.drive],
        directions_bar[0] if directions_bar else None,
        parameters,
    )


def _whole(
    tree: PyTreeDef, zeros: list[Any], bars: Bars, motion: Motion, simulation: Simulation
) -> Simulation:
    """Cotangents of a simulation, those of self-contact included."""
    assert bars.simulation is not None
    contact, found = _simulation(tree, zeros).self_contact, bars.parameters
    if found is None or contact is None:
        return dataclasses.replace(bars.simulation, self_contact=contact)
    contact = dataclasses.replace(contact, thickness=found["thickness"], friction=found["friction"])
    by_mass = -found["inverse_mass"] / simulation.mass**2
    return dataclasses.replace(
        bars.simulation,
        mass=bars.simulation.mass + jnp.where(motion.held, 0.0, by_mass),
        radius=bars.simulation.radius + found["floor"],
        time_step=bars.simulation.time_step + found["seconds"],
        self_contact=contact,
    )


def _flat(moving: Moving) -> Flat:
    packed, contacts = moving
    return packed, jax.tree.leaves(contacts)


def _moving(flat: Flat) -> Moving:
    packed, fields = flat
    return packed, Contacts(*fields) if fields else None


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
