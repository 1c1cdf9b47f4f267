"""Rollouts: semi-implicit Euler steps of a simulation under actions, as `jax.lax.scan`.

Pure functions of arrays: `jit`, `vmap` and `grad` apply, in either mode. Gradients store one
state an action and recompute the steps between (`jax.checkpoint`).
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from jaxsimp.dynamics.contact import table_contact
from jaxsimp.dynamics.pickers import Actions, Pickers, grasp, speed_profile
from jaxsimp.dynamics.simulation import Simulation, State
from jaxsimp.dynamics.springs import spring_forces

Packed = tuple[Float[Array, "3 NHH"], Float[Array, "3 NHH"]]
"""Positions and velocities as springs.py wants them: axis first, with halo."""


def rollout(
    simulation: Simulation,
    pickers: Pickers,
    state: State,
    actions: Actions,
    observe: Callable[[State], PyTree[Any]] = lambda state: state.position,
) -> tuple[State, PyTree[Any]]:
    """Carry out a plan.

    Args:
        simulation: the body's physics.
        pickers: how the pickers may move.
        state: at the start, shapes (N, 3).
        actions: shapes (T, G) and (T, G, 3).
        observe: applied to the state at the end of each action.

    Returns:
        The state at the end of the last action, and the observations stacked along a first
        axis of length T; by default the positions, shape (T, N, 3).
    """

    @jax.checkpoint
    def act(packed: Packed, action: Actions) -> tuple[Packed, PyTree[Any]]:
        position = _unpack(simulation, packed).position
        held, displacement = grasp(pickers, simulation.rest, simulation.radius, position, action)
        drive = displacement.T / simulation.time_step
        packed = _steps(simulation, packed, held, drive, speed_profile(pickers.steps))
        return packed, observe(_unpack(simulation, packed))

    packed, observations = jax.lax.scan(act, _pack(simulation, state), actions)
    return _unpack(simulation, packed), observations


def settle(simulation: Simulation, state: State, steps: int) -> State:
    """The state after `steps` time steps with nothing held."""
    packed = _pack(simulation, state)
    held = jnp.zeros(len(state.position), dtype=bool)
    drive = jnp.zeros_like(state.position.T)
    share = jnp.zeros(steps, dtype=drive.dtype)
    return _unpack(simulation, _steps(simulation, packed, held, drive, share))


def _steps(
    simulation: Simulation,
    packed: Packed,
    held: Bool[Array, " N"],
    drive: Float[Array, "3 N"],
    shares: Float[Array, " steps"],
) -> Packed:
    """Time steps in which held particles move by a share of `drive` (metres per second)."""

    def step(packed: Packed, share: Float[Array, ""]) -> tuple[Packed, None]:
        return _step(simulation, packed, held, drive * share), None

    return jax.lax.scan(step, packed, shares)[0]


def _step(
    simulation: Simulation,
    packed: Packed,
    held: Bool[Array, " N"],
    velocity_held: Float[Array, "3 N"],
) -> Packed:
    """One semi-implicit Euler step: forces, velocities, contact, then positions."""
    position, velocity = packed
    halo, mass, dt = simulation.springs.halo, simulation.mass, simulation.time_step
    here = slice(halo, halo + len(mass))
    forces = spring_forces(simulation.springs, position, velocity)
    gravity = (0.0, 0.0, simulation.gravity)
    kept = 1.0 - dt * simulation.drag
    # Axis by axis, and as momentum over mass: XLA holds a division too dear to repeat, and keeps
    # each of the three in memory, where it would otherwise compute it again for each of its uses.
    free = [
        (mass * (kept * velocity[axis, here] - dt * gravity[axis]) + dt * forces[axis]) / mass
        for axis in range(3)
    ]
    height = position[2, here] - simulation.radius
    moved = table_contact(height, free, simulation.friction, dt)
    moved = jnp.where(held[None], velocity_held, moved)
    # Only velocities are written in place; then all positions move, the halo by zero. (Writing
    # positions in place too costs a fifth of the step: they are also what is read.)
    velocity = jax.lax.dynamic_update_slice(velocity, moved, (0, halo))
    return position + dt * velocity, velocity


def _pack(simulation: Simulation, state: State) -> Packed:
    halo = ((0, 0), (simulation.springs.halo,) * 2)
    return jnp.pad(state.position.T, halo), jnp.pad(state.velocity.T, halo)


def _unpack(simulation: Simulation, packed: Packed) -> State:
    halo, count = simulation.springs.halo, len(simulation.mass)
    position, velocity = (array[:, halo : halo + count].T for array in packed)
    return State(position, velocity)
