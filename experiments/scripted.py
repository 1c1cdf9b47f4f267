"""Hand-made plans of some tasks, as a reference for the score of a known good fold or pull.

A plan found by a search may fail in another engine because the search exploited its own. A
hand-made plan fails only if the engines differ.
"""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxsimp.dynamics import NONE, Actions
from jaxsimp.tasks import Episode, Task

APEX = 0.12
"""Height of a carried part in a fold, metres."""
Moves = dict[int, Float[np.ndarray, "3"]]
"""Displacements by picked particle, metres."""


def scripted_plan(task: Task, episode: Episode) -> Actions:
    """The hand-made plan of a task.

    Raises:
        ValueError: if the task has no hand-made plan.
    """
    if task.name not in SCRIPTS:
        raise ValueError(f"no plan is scripted for {task.name!r}; choose one of {list(SCRIPTS)}")
    return _actions(task, SCRIPTS[task.name](task, episode))


def _straighten(task: Task, episode: Episode) -> list[Moves]:
    """Pull the two ends apart along the table, to their distance in the goal."""
    last = task.body.num_particles - 1
    apart, wanted = (
        np.asarray(positions, float)[last] - np.asarray(positions, float)[0]
        for positions in (episode.start, episode.goal)
    )
    longer = np.linalg.norm(wanted) / np.linalg.norm(apart) - 1
    share = longer * apart / 2 / task.num_actions
    return [{0: -share, last: share}] * task.num_actions


def _fold_rope(task: Task, episode: Episode) -> list[Moves]:
    """Pull the middle to the corner, then lay one end after the other."""
    way, last = _ways(episode), task.body.num_particles - 1
    middle = last // 2
    half = way[middle] / 2
    both = {0: way[0] / 2, last: way[last] / 2}
    return [{middle: half}, both, {middle: half}, both]


def _fold_sideways(task: Task, episode: Episode) -> list[Moves]:
    """Carry the two corners of the moving edge onto those of the still edge."""
    return _carry_over(task, episode, (0, task.body.shape[1] - 1))


def _fold_diagonally(task: Task, episode: Episode) -> list[Moves]:
    """Carry a corner onto the opposite one."""
    return _carry_over(task, episode, (0,))


def _hang_over_bar(task: Task, episode: Episode) -> list[Moves]:
    """Lift the edge beside the bar, draw it over the bar, and bring it down on the other side."""
    last, width = task.body.num_particles - 1, task.body.shape[1]
    way, up, over = _ways(episode), np.array([0.08, 0.0, 0.28]), np.array([0.22, 0.0, 0.0])
    edge = (last - width + 1, last)
    down = {corner: way[corner] - up - over for corner in edge}
    return [dict.fromkeys(edge, up), dict.fromkeys(edge, over), down]


def _carry_over(task: Task, episode: Episode, corners: tuple[int, ...]) -> list[Moves]:
    """Move up and half the way, then the other half and down to just above the layer below."""
    way, up = _ways(episode), np.array([0.0, 0.0, APEX])
    gap = np.array([0.0, 0.0, 3 * task.body.radius])
    return [
        {corner: way[corner] / 2 + up for corner in corners},
        {corner: way[corner] / 2 - up + gap for corner in corners},
    ]


def _ways(episode: Episode) -> Float[np.ndarray, "N 3"]:
    """Displacements from the start to the goal, metres."""
    return np.asarray(episode.goal, float) - np.asarray(episode.start, float)


def _actions(task: Task, moves: list[Moves]) -> Actions:
    """A plan of the task's length from the moves of its first actions."""
    shape = (task.num_actions, task.num_pickers)
    pick, displacement = np.full(shape, NONE), np.zeros((*shape, 3))
    for t, each in enumerate(moves[: task.num_actions]):
        pick[t, : len(each)] = list(each)
        displacement[t, : len(each)] = list(each.values())
    return Actions(jnp.asarray(pick), jnp.asarray(displacement))


SCRIPTS: dict[str, Callable[[Task, Episode], list[Moves]]] = {
    "rope_straightening": _straighten,
    "rope_folding": _fold_rope,
    "cloth_side_folding": _fold_sideways,
    "cloth_diagonal_folding": _fold_diagonally,
    "towel_over_bar": _hang_over_bar,
}
"""Functions that make the moves of each action, by task."""
