"""Goals from settled states of a simulation: a cloth folded by two pickers, with small errors."""

from collections.abc import Callable
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from experiments.ideal_goals import IdealGoal, ideal_goal, partial_folds
from jaxsimp import goals
from jaxsimp.bodies import Body
from jaxsimp.dynamics import (
    NONE,
    Actions,
    at_rest,
    largest_time_step,
    make_pickers,
    make_simulation,
    rollout,
)

SETTLED_FOLDS = ("side, x", "side, y", "diagonal", "other diagonal", "letter")
CARELESSNESS = 0.003
"""Standard deviation of the pickers from their targets, along each axis, metres."""
LIFT = 0.4
"""Height of a carried corner halfway, as a fraction of its horizontal displacement."""
ACTION_SECONDS = 0.3
IDLE_ACTIONS = 4
"""Number of actions with nothing held, at the end."""


def settled_goal(body: Body, name: str, seed: int) -> IdealGoal:
    """The state of a cloth after a scripted fold, settled; its key points are those of the fold.

    Pickers carry the corners that a fold moves in an arc of two actions, with a random error.

    Args:
        body: a rectangular cloth.
        name: one of `SETTLED_FOLDS`.
        seed: seed of the pickers' errors.
    """
    rng = np.random.default_rng(seed)
    picks, moves = [], []
    corners = _corners(body)
    positions = goals.flat(body)
    for folded in partial_folds(body, name):
        away = np.linalg.norm(folded[corners, :2] - positions[corners, :2], axis=1)
        moved = corners[away > body.spacing][:2]
        half = np.zeros((2, 2, 3))
        half[:, : len(moved)] = (folded[moved] - positions[moved]) / 2
        half += rng.normal(scale=CARELESSNESS, size=half.shape)
        lift = LIFT * np.linalg.norm(2 * half[0], axis=1)
        half[:, :, 2] = lift, -lift
        picks += [[*moved, NONE][:2]] * 2
        moves += list(half)
        positions = folded
    picks += [[NONE, NONE]] * IDLE_ACTIONS
    moves += [np.zeros((2, 3))] * IDLE_ACTIONS
    actions = Actions(jnp.asarray(picks), jnp.asarray(np.array(moves), dtype=float))
    settled = np.asarray(_simulation_fn(body)(actions), dtype=float)
    return IdealGoal(name, body, settled, ideal_goal(body, name).true_points)


def _corners(body: Body) -> np.ndarray:
    """Particle ids of the corners of a rectangular cloth."""
    ends = [body.rest[:, axis] for axis in range(2)]
    outer = [np.isclose(np.abs(end), np.abs(end).max()) for end in ends]
    return np.flatnonzero(outer[0] & outer[1])


@cache
def _simulation_fn(body: Body) -> Callable[[Actions], Float[Array, "N 3"]]:
    """Function from actions to the final positions of a body that starts flat."""
    time_step = min(2e-3, 0.9 * largest_time_step(body))
    simulation = make_simulation(body, time_step)
    pickers = make_pickers((1.0, 1.0, 1.0), steps=round(ACTION_SECONDS / time_step))

    @jax.jit
    def simulate(actions: Actions) -> Float[Array, "N 3"]:
        return rollout(simulation, pickers, at_rest(goals.flat(body)), actions)[0].position

    return simulate
