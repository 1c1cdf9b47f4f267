"""One semi-implicit Euler step of a simulation, and its adjoint.

The step is written for XLA's CPU compiler, which fuses what is cheap into each of its uses:
axis by axis, every result that is used more than once ending in a division, which XLA holds too
dear to repeat.
"""

import dataclasses
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxsimp.dynamics.contact import table_contact
from jaxsimp.dynamics.simulation import Simulation, State
from jaxsimp.dynamics.springs import pull, spring_forces_vjp, spring_tensions

Axes = list[Float[Array, " N"]]
"""Something of every particle along x, y and z."""

Packed = tuple[Float[Array, "3 NHH"], Float[Array, "3 NHH"]]
"""Positions and velocities as springs.py wants them: axis first, with halo."""


@partial(jax.tree_util.register_dataclass, data_fields=["held", "drive"], meta_fields=[])
@dataclass(frozen=True)
class Motion:
    """What pickers do to the particles during an action.

    Attributes:
        held: which are held, shape (N,).
        drive: their displacement over the time step, shape (3, N), metres per second; zero
            where nothing is held.
    """

    held: Bool[Array, " N"]
    drive: Float[Array, "3 N"]


def step(simulation: Simulation, packed: Packed, motion: Motion, share: Float[Array, ""]) -> Packed:
    """Forces, velocities, contact, then positions; held particles move by a share of `drive`."""
    position, velocity = packed
    tensions = spring_tensions(simulation.springs, position, velocity)
    forces = pull(simulation.springs, tensions, position)
    moved = _velocities(simulation, motion, share, forces, *_here(simulation, packed))
    # Velocities are written in place; then all positions move, the halo by zero. (To write
    # positions in place, too, costs a fifth of the step: they are also what is read.)
    halo = simulation.springs.halo
    velocity = jax.lax.dynamic_update_slice(velocity, moved, (0, halo))
    return position + simulation.time_step * velocity, velocity


def step_vjp(
    simulation: Simulation,
    packed: Packed,
    motion: Motion,
    share: Float[Array, ""],
    packed_bar: tuple[Axes, Axes],
) -> tuple[Simulation, tuple[Axes, Axes], Float[Array, "3 N"]]:
    """Cotangents of the simulation, state and drive for those of the state after a step.

    Cotangents of states have no halo.
    """
    dt, springs = simulation.time_step, simulation.springs
    tensions = spring_tensions(springs, *packed)
    forces = pull(springs, tensions, packed[0])
    position_bar, velocity_bar = packed_bar
    moved_bar = jnp.stack([v + dt * x for x, v in zip(position_bar, velocity_bar, strict=True)])

    names = ("mass", "radius", "drag", "friction", "gravity", "time_step")
    physics = {name: getattr(simulation, name) for name in names}

    def velocities(
        physics: dict[str, Array], drive: Float[Array, "3 N"], *state: Axes | Float[Array, " N"]
    ) -> Float[Array, "3 N"]:
        changed = dataclasses.replace(simulation, **physics)
        return _velocities(changed, Motion(motion.held, drive), share, *state)

    here = _here(simulation, packed)
    moved, pullback = jax.vjp(velocities, physics, motion.drive, forces, *here)
    physics_bar, drive_bar, forces_bar, velocity_bar, height_bar = pullback(moved_bar)
    physics_bar["time_step"] += jnp.vdot(jnp.stack(position_bar), moved)
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
    height: Float[Array, " N"],
) -> Float[Array, "3 N"]:
    """Velocities after forces, contact and pickers, particle by particle."""
    mass, dt = simulation.mass, simulation.time_step
    kept = 1.0 - dt * simulation.drag
    gravity = (0.0, 0.0, simulation.gravity)
    # As momentum over mass, for the division.
    free = [
        (mass * (kept * velocity[axis] - dt * gravity[axis]) + dt * forces[axis]) / mass
        for axis in range(3)
    ]
    moved = table_contact(height - simulation.radius, free, simulation.friction, dt)
    return jnp.where(motion.held[None], motion.drive * share, jnp.stack(moved))


def _here(simulation: Simulation, packed: Packed) -> tuple[Axes, Float[Array, " N"]]:
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
