"""One semi-implicit Euler step of a simulation, and its adjoint.

The code suits XLA's CPU compiler, which recomputes cheap expressions in each of their uses: it goes
axis by axis, and every result with more than one use ends in a division, which XLA does not repeat.
"""

import dataclasses
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxsimp.dynamics.contact.rigid import contact
from jaxsimp.dynamics.simulation import PHYSICS, Simulation, State
from jaxsimp.dynamics.springs import (
    over_batch,
    pull,
    spring_forces_vjp,
    spring_tensions,
    springs_vjp,
)

Axes = list[Float[Array, "N *B"]]
"""Values of every particle along x, y and z."""

Packed = tuple[Float[Array, "3 NHH *B"], Float[Array, "3 NHH *B"]]
"""Positions and velocities in the layout of springs.py: axis first, with halo, batch last."""


@partial(jax.tree_util.register_dataclass, data_fields=["held", "drive"], meta_fields=[])
@dataclass(frozen=True)
class Motion:
    """Effect of pickers on the particles during an action.

    Attributes:
        held: whether each particle is held, shape (N, *B).
        drive: displacement of each held particle over the time step, zero elsewhere, shape
            (3, N, *B), metres per second.
    """

    held: Bool[Array, "N *B"]
    drive: Float[Array, "3 N *B"]


def step(simulation: Simulation, packed: Packed, motion: Motion, share: Float[Array, ""]) -> Packed:
    """Forces, velocities, contact, then positions; held particles move by `share` of `drive`."""
    return step_and_free(simulation, packed, motion, share)[0]


def step_and_free(
    simulation: Simulation, packed: Packed, motion: Motion, share: Float[Array, ""]
) -> tuple[Packed, Axes]:
    """The state after a step, and the velocities without contact."""
    position, velocity = packed
    tensions = spring_tensions(simulation.springs, position, velocity)
    forces = pull(simulation.springs, tensions, position)
    place, speed = _here(simulation, packed)
    free = _free(simulation, motion, forces, speed)
    moved = _constrained(simulation, motion.held, list(motion.drive), share, free, place)
    # Write velocities in place, row by row: XLA does not vectorise a stack of rows. Then all
    # positions move, the halo by zero. (Writing positions in place, too, costs a fifth of the
    # step, as the step also reads them.)
    velocity = _write_rows(simulation, velocity, moved)
    return (position + simulation.time_step * velocity, velocity), free


def step_vjp(
    simulation: Simulation,
    packed: Packed,
    free: Axes,
    motion: Motion,
    share: Float[Array, ""],
    packed_bar: tuple[Axes, Axes],
    of_simulation: bool,
) -> tuple[Simulation | None, tuple[Axes, Axes], Axes]:
    """Cotangents of the simulation, state and drive from those of the state after a step.

    Args:
        simulation: the body's physics.
        packed: state before the step.
        free: velocities without contact, see `step_and_free`.
        motion: effect of the pickers.
        share: fraction of `motion.drive` in this step.
        packed_bar: cotangents of the state after the step, without halo.
        of_simulation: whether to compute cotangents of the simulation; if so, without a batch.
    """
    dt, springs = simulation.time_step, simulation.springs
    tensions = spring_tensions(springs, *packed)
    position_bar, velocity_bar = packed_bar
    moved_bar = [v + dt * x for x, v in zip(position_bar, velocity_bar, strict=True)]
    # Only parameters that the velocities depend on: ids have no cotangent.
    physics: dict[str, Any] = {name: getattr(simulation, name) for name in PHYSICS}

    def constrained(physics: dict[str, Any], drive: Axes, free: Axes, place: Axes) -> Axes:
        changed = dataclasses.replace(simulation, **physics)
        return _constrained(changed, motion.held, drive, share, free, place)

    def unconstrained(physics: dict[str, Any], forces: Axes, velocity: Axes) -> Axes:
        return _free(dataclasses.replace(simulation, **physics), motion, forces, velocity)

    place, speed = _here(simulation, packed)
    moved, pullback = jax.vjp(constrained, physics, list(motion.drive), free, place)
    physics_bar, drive_bar, free_bar, place_bar = pullback(moved_bar)
    # The step is linear in forces: their values matter only to cotangents of the physics.
    forces = pull(springs, tensions, packed[0]) if of_simulation else speed
    _, pullback = jax.vjp(unconstrained, physics, forces, speed)
    more_bar, forces_bar, speed_bar = pullback(free_bar)
    # The values in the halo do not matter: the springs into it have no stiffness.
    force_bar = _write_rows(simulation, packed[0], forces_bar)
    by_position, by_velocity = spring_forces_vjp(springs, tensions, *packed, force_bar)
    by_position = [a + b for a, b in zip(by_position, place_bar, strict=True)]
    simulation_bar = None
    if of_simulation:
        physics_bar = jax.tree.map(jnp.add, physics_bar, more_bar)
        physics_bar["time_step"] += sum(map(jnp.vdot, position_bar, moved))
        springs_bar = springs_vjp(springs, tensions, *packed, force_bar)
        rest_bar = jnp.zeros_like(simulation.rest)  # Only pickers use it.
        simulation_bar = Simulation(springs=springs_bar, rest=rest_bar, **physics_bar)
    packed_bar = (
        [a + b for a, b in zip(position_bar, by_position, strict=True)],
        [a + b for a, b in zip(speed_bar, by_velocity, strict=True)],
    )
    return simulation_bar, packed_bar, drive_bar


def _free(simulation: Simulation, motion: Motion, forces: Axes, velocity: Axes) -> Axes:
    """Velocities after forces, particle by particle."""
    dt = simulation.time_step
    # The mass of held particles does not matter. (With a batch, `where` makes the mass an array as
    # large as the batch; XLA turns a division by a smaller array into a product with its inverse.)
    mass = jnp.where(motion.held, 1.0, over_batch(simulation.mass, forces[0]))
    kept = 1.0 - dt * simulation.drag
    gravity = (0.0, 0.0, simulation.gravity)
    # As momentum over mass, for the division.
    return [
        (mass * (kept * velocity[axis] - dt * gravity[axis]) + dt * forces[axis]) / mass
        for axis in range(3)
    ]


def _constrained(
    simulation: Simulation,
    held: Bool[Array, "N *B"],
    drive: Axes,
    share: Float[Array, ""],
    free: Axes,
    place: Axes,
) -> Axes:
    """Velocities after contact and pickers."""
    moved = contact(simulation, place, free)
    return [jnp.where(held, drive[axis] * share, moved[axis]) for axis in range(3)]


def _write_rows(
    simulation: Simulation, array: Float[Array, "3 NHH *B"], rows: Axes
) -> Float[Array, "3 NHH *B"]:
    """The array with these rows, and its old halo."""
    for axis, row in enumerate(rows):
        corner = (axis, simulation.springs.halo) + (0,) * (row.ndim - 1)
        array = jax.lax.dynamic_update_slice(array, row[None], corner)
    return array


def _here(simulation: Simulation, packed: Packed) -> tuple[Axes, Axes]:
    """Positions and velocities without halo."""
    here = slice(simulation.springs.halo, simulation.springs.halo + len(simulation.mass))
    position, velocity = ([array[axis, here] for axis in range(3)] for array in packed)
    return position, velocity


def pack(simulation: Simulation, state: State) -> Packed:
    """A state in the layout of the steps."""
    halo = ((0, 0), (simulation.springs.halo,) * 2)
    return jnp.pad(state.position.T, halo), jnp.pad(state.velocity.T, halo)


def unpack(simulation: Simulation, packed: Packed) -> State:
    """A state in the layout of `State`, particles first."""
    halo, count = simulation.springs.halo, len(simulation.mass)
    position, velocity = (array[:, halo : halo + count].T for array in packed)
    return State(position, velocity)
