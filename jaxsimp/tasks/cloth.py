"""Tasks of cloths: the two folds of the paper, after SoftGym and fabric-vsf, and more."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsimp import goals
from jaxsimp.bodies import Body, cloth
from jaxsimp.tasks.costs import distance, distance_cost
from jaxsimp.tasks.task import Episode, Task, register

STILL_WEIGHT = 1.2
"""Weight of the displacement of the half that should lie still, after SoftGym."""


@register("cloth_side_folding", full=25, quick=9, group="paper")
def cloth_side_folding(resolution: int) -> Task:
    """Fold a square cloth in half sideways."""
    body = cloth((resolution, resolution))
    row, column = np.divmod(np.arange(resolution**2), resolution)
    moving = np.flatnonzero(2 * row <= resolution - 1)
    mirror = (resolution - 1 - row) * resolution + column
    return _fold_task("cloth_side_folding", body, (0.0, 1.0), moving, mirror)


@register("cloth_diagonal_folding", full=25, quick=9, group="paper")
def cloth_diagonal_folding(resolution: int) -> Task:
    """Fold a square cloth along its diagonal."""
    body = cloth((resolution, resolution))
    row, column = np.divmod(np.arange(resolution**2), resolution)
    moving = np.flatnonzero(row + column <= resolution - 1)
    mirror = (resolution - 1 - column) * resolution + (resolution - 1 - row)
    return _fold_task("cloth_diagonal_folding", body, (-1.0, 1.0), moving, mirror)


def _fold_task(
    name: str, body: Body, direction: tuple[float, float], moving: np.ndarray, mirror: np.ndarray
) -> Task:
    """A fold about a line through the middle.

    The cost is `mean |a_i - b_i| + 1.2 mean |b_i - b_i(0)|`, with `a` the moving half and `b`
    its mirror image in the half that should lie still. The start is flat, turned at random
    within 45 degrees, as in SoftGym.
    """
    still = mirror[moving]
    line = np.zeros(2), np.array(direction)

    def cost(episode: Episode, position: Float[Array, "N 3"]) -> Float[Array, ""]:
        apart = distance(position[moving] - position[still]).mean()
        dragged = distance(position[still] - jnp.asarray(episode.start)[still]).mean()
        return apart + STILL_WEIGHT * dragged

    def episode(seed: int) -> Episode:
        angle = random_angle(seed)
        return Episode(goals.flat(body, angle), goals.turn(goal, angle))

    goal = goals.fold(body, goals.flat(body), *line)
    return Task(
        name=name,
        body=body,
        goal=goal,
        episode_fn=episode,
        cost_fn=cost,
        limits=(0.2, 0.2, 0.2),
        num_actions=2,
        action_seconds=0.25,
    )


@register("cloth_letter_fold", full=25, quick=9, group="goals")
def cloth_letter_fold(resolution: int) -> Task:
    """Fold a square cloth in thirds, like a letter."""
    return _folds_task("cloth_letter_fold", cloth((resolution, resolution)), "letter", 6)


@register("cloth_quarter_fold", full=25, quick=9, group="goals")
def cloth_quarter_fold(resolution: int) -> Task:
    """Fold a square cloth in half, and again."""
    return _folds_task("cloth_quarter_fold", cloth((resolution, resolution)), "quarter", 6)


@register("cloth_four_corners", full=25, quick=9, group="goals")
def cloth_four_corners(resolution: int) -> Task:
    """Fold the four corners of a square cloth to its centre."""
    return _folds_task("cloth_four_corners", cloth((resolution, resolution)), "four_corners", 6)


def _folds_task(name: str, body: Body, folds: str, num_actions: int) -> Task:
    goal = goals.fold_sequence(body, goals.rectangle_folds(body, folds))
    return flat_task(name, body, goal, num_actions)


def flat_task(name: str, body: Body, goal: goals.Positions, num_actions: int) -> Task:
    """A goal from a flat start that is turned at random within 45 degrees.

    The cost is the mean distance of the particles to their goals.
    """

    def episode(seed: int) -> Episode:
        angle = random_angle(seed)
        return Episode(goals.flat(body, angle), goals.turn(goal, angle))

    return Task(
        name=name,
        body=body,
        goal=goal,
        episode_fn=episode,
        cost_fn=distance_cost,
        limits=(0.2, 0.2, 0.2),
        num_actions=num_actions,
        action_seconds=0.25,
    )


def random_angle(seed: int) -> float:
    """Of a flat start, radians, within 45 degrees, as in SoftGym."""
    return np.random.default_rng(seed).uniform(-np.pi / 4, np.pi / 4)
