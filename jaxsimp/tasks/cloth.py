"""Tasks of cloths: the two folds of the paper, after SoftGym and fabric-vsf, and more."""

from collections.abc import Callable
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxsimp import goals
from jaxsimp.bodies import Body, cloth
from jaxsimp.dynamics import Actions, State
from jaxsimp.tasks.costs import RUNNING_WEIGHT, distance, distance_cost
from jaxsimp.tasks.episode import Episode
from jaxsimp.tasks.registry import register
from jaxsimp.tasks.starts import TurnedStart
from jaxsimp.tasks.task import Task

PositionCost = Callable[..., Float[Array, ""]]
"""A cost of positions: of an episode, a state, and an action that it ignores."""
STILL_WEIGHT = 1.2
"""Weight of the displacement of the still half, after SoftGym."""


@dataclass(frozen=True, eq=False)
class FoldCost:
    """Cost of a fold in half: `mean |a_i - b_i| + 1.2 mean |b_i - b_i(0)|`, metres.

    `a` is the moving half and `b` its mirror image in the still half, as in SoftGym.

    Attributes:
        moving: ids of the particles of the moving half, shape (M,).
        still: ids of their mirror images, shape (M,).
    """

    moving: Int[np.ndarray, " M"]
    still: Int[np.ndarray, " M"]

    def __call__(
        self, episode: Episode, state: State, action: Actions | None = None
    ) -> Float[Array, ""]:
        """The cost of a state, metres."""
        position = state.position
        apart = distance(position[self.moving] - position[self.still]).mean()
        start = jnp.asarray(episode.start)[self.still]
        dragged = distance(position[self.still] - start).mean()
        return apart + STILL_WEIGHT * dragged


@register(full=25, quick=9, group="paper")
def cloth_side_folding(resolution: int) -> Task:
    """Fold a square cloth in half sideways."""
    body = cloth((resolution, resolution))
    row, column = np.divmod(np.arange(resolution**2), resolution)
    moving = np.flatnonzero(2 * row <= resolution - 1)
    mirror = (resolution - 1 - row) * resolution + column
    return _fold_task(body, (0.0, 1.0), moving, mirror)


@register(full=25, quick=9, group="paper")
def cloth_diagonal_folding(resolution: int) -> Task:
    """Fold a square cloth along its diagonal."""
    body = cloth((resolution, resolution))
    row, column = np.divmod(np.arange(resolution**2), resolution)
    moving = np.flatnonzero(row + column <= resolution - 1)
    mirror = (resolution - 1 - column) * resolution + (resolution - 1 - row)
    return _fold_task(body, (-1.0, 1.0), moving, mirror)


def _fold_task(
    body: Body, direction: tuple[float, float], moving: np.ndarray, mirror: np.ndarray
) -> Task:
    """A fold about a line through the middle, from a flat start turned at random (see `FoldCost`).

    Args:
        body: a square cloth.
        direction: x and y of the line's direction.
        moving: ids of the particles of the moving half, shape (M,).
        mirror: id of the mirror image of each particle, shape (N,).
    """
    goal = goals.fold(body, goals.flat(body), np.zeros(2), np.array(direction))
    return turned_task(body, goal, FoldCost(moving, mirror[moving]), num_actions=2)


@register(full=25, quick=9, group="goals")
def cloth_letter_fold(resolution: int) -> Task:
    """Fold a square cloth in thirds, like a letter."""
    return _folds_task(cloth((resolution, resolution)), "letter", 6)


@register(full=25, quick=9, group="goals")
def cloth_quarter_fold(resolution: int) -> Task:
    """Fold a square cloth in half, and again."""
    return _folds_task(cloth((resolution, resolution)), "quarter", 6)


@register(full=25, quick=9, group="goals")
def cloth_four_corners(resolution: int) -> Task:
    """Fold the four corners of a square cloth to its centre."""
    return _folds_task(cloth((resolution, resolution)), "four_corners", 6)


def _folds_task(body: Body, folds: str, num_actions: int) -> Task:
    goal = goals.fold_sequence(body, goals.rectangle_folds(body, folds))
    return flat_task(body, goal, num_actions)


def flat_task(body: Body, goal: goals.Positions, num_actions: int) -> Task:
    """A task from a flat start, turned by a random angle within 45 degrees, to a goal.

    The cost is the mean distance of the particles to their goals.
    """
    return turned_task(body, goal, distance_cost, num_actions)


def turned_task(
    body: Body,
    goal: goals.Positions,
    cost: PositionCost,
    num_actions: int,
    start: goals.Positions | None = None,
) -> Task:
    """A task whose start and goal are turned by a random angle, see `TurnedStart`.

    Args:
        body: a cloth or a garment.
        goal: goal before the turn, shape (N, 3), metres.
        cost: cost of a state, on the way and at the end.
        num_actions: number of actions in a plan.
        start: start before the turn, shape (N, 3), metres; the flat body by default.
    """
    turned = TurnedStart(body, goal, start)
    return Task(
        body=body,
        goal=goal,
        episode_fn=turned,
        draw_fn=turned.draw,
        running_cost=cost,
        terminal_cost=cost,
        running_weight=RUNNING_WEIGHT,
        limits=(0.2, 0.2, 0.2),
        num_actions=num_actions,
        action_seconds=0.25,
    )
