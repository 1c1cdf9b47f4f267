"""Rollouts: semi-implicit Euler steps of a simulation under actions, as `jax.lax.scan`.

Pure functions of arrays: `jit`, `vmap`, `grad` and `scan` apply. Reverse mode uses the adjoint of
adjoint.py; forward mode (`jvp`, `jacfwd`) needs `adjoint=False`, see modes.py.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from jaxsimp.checks import require_count
from jaxsimp.dynamics.adjoint import plain_steps, steps
from jaxsimp.dynamics.contact.stepping import Moving, begin, end
from jaxsimp.dynamics.pickers import Actions, Pickers, grasp, require_actions, speed_profile
from jaxsimp.dynamics.simulation import Simulation, State, require_state
from jaxsimp.dynamics.step import Motion, unpack


def rollout(
    simulation: Simulation,
    pickers: Pickers,
    state: State,
    actions: Actions,
    observe: Callable[[State], PyTree[Any]] = lambda state: state.position,
    *,
    adjoint: bool = True,
) -> tuple[State, PyTree[Any]]:
    """Carry out a plan.

    Args:
        simulation: the body's physics.
        pickers: limits of the pickers' motion.
        state: state at the start, shapes (N, 3).
        actions: the plan, shapes (T, G) and (T, G, 3).
        observe: function applied to the state at the end of each action.
        adjoint: whether to differentiate by the adjoint of adjoint.py: in reverse mode, and without
            self-contact twice by `jax.hessian`. False leaves differentiation to JAX, in any mode
            and order, but reverse takes many times as long.

    Returns:
        The state at the end of the last action, and the observations stacked along a first
        axis of length T; by default the positions, shape (T, N, 3).

    Raises:
        ValueError: if `require_actions` refuses the plan, or `require_state` the state.
    """
    return rollout_observing(
        simulation, pickers, state, actions, lambda state, _: observe(state), adjoint=adjoint
    )


def rollout_observing(
    simulation: Simulation,
    pickers: Pickers,
    state: State,
    actions: Actions,
    observe: Callable[[State, Actions], PyTree[Any]],
    *,
    adjoint: bool = True,
) -> tuple[State, PyTree[Any]]:
    """`rollout`, but `observe` takes the state at the end of each action, and the action."""
    state = require_state(state, len(simulation.mass))
    actions = require_actions(actions, len(simulation.mass))

    def one(moving: Moving, action: Actions) -> tuple[Moving, PyTree[Any]]:
        moving = act(simulation, pickers, moving, action, adjoint=adjoint)
        return moving, observe(end(simulation, moving), action)

    moving, observations = jax.lax.scan(one, begin(simulation, state), actions)
    return end(simulation, moving), observations


def act(
    simulation: Simulation,
    pickers: Pickers,
    moving: Moving,
    action: Actions,
    *,
    adjoint: bool = True,
) -> Moving:
    """The time steps of one action, shapes (G,) and (G, 3); see `rollout`."""
    position = unpack(simulation, moving[0]).position
    around = simulation.rest, simulation.obstacles, simulation.radius
    held, displacement = grasp(pickers, *around, position, action)
    motion = Motion(held, displacement.T / simulation.time_step)
    run = steps if adjoint else plain_steps
    return run(simulation, moving, motion, speed_profile(pickers.steps))


def settle(simulation: Simulation, state: State, num_steps: int) -> State:
    """The state after `num_steps` time steps with nothing held.

    Raises:
        ValueError: if `num_steps` is no whole number, or `require_state` refuses the state.
    """
    state = require_state(state, len(simulation.mass))
    num_steps = require_count("num_steps", num_steps, 0)
    moving = begin(simulation, state)
    held = jnp.zeros(len(state.position), dtype=bool)
    drive = jnp.zeros_like(state.position.T)
    share = jnp.zeros(num_steps, dtype=drive.dtype)
    moving = steps(simulation, moving, Motion(held, drive), share)
    return end(simulation, moving)
