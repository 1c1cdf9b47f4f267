"""One semi-implicit Euler step of a simulation, and its adjoint.

The step is written for XLA's CPU compiler, which fuses what is cheap into each of its uses:
axis by axis, every result that is used more than once ending in a division, which XLA holds too
dear to repeat.
"""

import dataclasses
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxsimp.dynamics.contact import table_contact
from jaxsimp.dynamics.simulation import Simulation, State
from jaxsimp.dynamics.springs import over_batch, pull, spring_forces_vjp, spring_tensions

Axes = list[Float[Array, "N *B"]]
"""Something of every particle along x, y and z."""

Packed = tuple[Float[Array, "3 NHH *B"], Float[Array, "3 NHH *B"]]
"""Positions and velocities as springs.py wants them: axis first, with halo, batch last."""


@partial(jax.tree_util.register_dataclass, data_fields=["held", "drive"], meta_fields=[])
@dataclass(frozen=True)
class Motion:
    """What pickers do to the particles during an action.

    Attributes:
        held: which are held, shape (N, *B).
        drive: their displacement over the time step, shape (3, N, *B), metres per second; zero
            where nothing is held.
    """

    held: Bool[Array, "N *B"]
    drive: Float[Array, "3 N *B"]


def step(simulation: Simulation, packed: Packed, motion: Motion, share: Float[Array, ""]) -> Packed:
    """Forces, velocities, contact, then positions; held particles move by a share of `drive`."""
    position, velocity = packed
    tensions = spring_tensions(simulation.springs, position, velocity)
    forces = pull(simulation.springs, tensions, position)
    moved = _velocities(simulation, motion, share, forces, *_here(simulation, packed))
    # Velocities are written in place, row by row: a stack of rows would not be vectorised. Then
    # all positions move, the halo by zero. (To write positions in place, too, costs a fifth of
    # the step: they are also what is read.)
    for axis in range(3):
        corner = (axis, simulation.springs.halo) + (0,) * (velocity.ndim - 2)
        velocity = jax.lax.dynamic_update_slice(velocity, moved[axis][None], corner)
    return position + simulation.time_step * velocity, velocity


def step_vjp(
    simulation: Simulation,
    packed: Packed,
    motion: Motion,
    share: Float[Array, ""],
    packed_bar: tuple[Axes, Axes],
) -> tuple[Simulation, tuple[Axes, Axes], Float[Array, "3 N *B"]]:
    """Cotangents of the simulation, state and drive for those of the state after a step.

    Without a batch. Cotangents of states have no halo.
    """
    dt, springs = simulation.time_step, simulation.springs
    tensions = spring_tensions(springs, *packed)
    forces = pull(springs, tensions, packed[0])
    position_bar, velocity_bar = packed_bar
    moved_bar = [v + dt * x for x, v in zip(position_bar, velocity_bar, strict=True)]
    names = ("mass", "radius", "drag", "friction", "gravity", "time_step")
    physics: dict[str, Any] = {name: getattr(simulation, name) for name in names}

    def velocities(
        physics: dict[str, Any],
        drive: Float[Array, "3 N"],
        forces: Axes,
        velocity: Axes,
        height: Float[Array, " N"],
    ) -> Axes:
        changed = dataclasses.replace(simulation, **physics)
        driven = Motion(motion.held, drive)
        return _velocities(changed, driven, share, forces, velocity, height)

    here = _here(simulation, packed)
    moved, pullback = jax.vjp(velocities, physics, motion.drive, forces, *here)
    physics_bar, drive_bar, forces_bar, velocity_bar, height_bar = pullback(moved_bar)
    physics_bar["time_step"] += sum(map(jnp.vdot, position_bar, moved))
    force_bar = packed[0]  # Any halo will do: the springs into it have no stiffness.
    for axis, row in enumerate(forces_bar):
        force_bar = jax.lax.dynamic_update_slice(force_bar, row[None], (axis, springs.halo))
    springs_bar, by_position, by_velocity = spring_forces_vjp(springs, tensions, *packed, force_bar)
    by_position[2] += height_bar
    rest_bar = jnp.zeros_like(simulation.rest)  # Only pickers look at it.
    simulation_bar = Simulation(springs=springs_bar, rest=rest_bar, **physics_bar)
    packed_bar = (
        [a + b for a, b in zip(position_bar, by_position, strict=True)],
        [a + b for a, b in zip(velocity_bar, by_velocity, strict=True)],
    )
    return simulation_bar, packed_bar, drive_bar


def _velocities(
    simulation: Simulation,
    motion: Motion,
    share: Float[Array, ""],
    forces: Axes,
    velocity: Axes,
    height: Float[Array, "N *B"],
) -> Axes:
    """Velocities after forces, contact and pickers, particle by particle."""
    dt = simulation.time_step
    # Held particles are not free: any mass will do. (With a batch, it makes the mass an array as
    # large as the batch; a division by anything smaller becomes a product with its inverse.)
    mass = jnp.where(motion.held, 1.0, over_batch(simulation.mass, height))
    kept = 1.0 - dt * simulation.drag
    gravity = (0.0, 0.0, simulation.gravity)
    # As momentum over mass, for the division.
    free = [
        (mass * (kept * velocity[axis] - dt * gravity[axis]) + dt * forces[axis]) / mass
        for axis in range(3)
    ]
    moved = table_contact(height - simulation.radius, free, simulation.friction, dt)
    return [jnp.where(motion.held, motion.drive[axis] * share, moved[axis]) for axis in range(3)]


def _here(simulation: Simulation, packed: Packed) -> tuple[Axes, Float[Array, "N *B"]]:
    """Velocities and heights without halo."""
    position, velocity = packed
    here = slice(simulation.springs.halo, simulation.springs.halo + len(simulation.mass))
    return [velocity[axis, here] for axis in range(3)], position[2, here]


def pack(simulation: Simulation, state: State) -> Packed:
    """A state as the steps want it."""
    halo = ((0, 0), (simulation.springs.halo,) * 2)
    return jnp.pad(state.position.T, halo), jnp.pad(state.velocity.T, halo)


def unpack(simulation: Simulation, packed: Packed) -> State:
    """A state as users want it."""
    halo, count = simulation.springs.halo, len(simulation.mass)
    position, velocity = (array[:, halo : halo + count].T for array in packed)
    return State(position, velocity)
