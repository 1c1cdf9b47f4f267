"""Scores of states: 0 for the start, 1 where the cost is 0."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxsimp.dynamics import at_rest
from jaxsimp.tasks import make_task, score, task_names

FOLDS = ("cloth_side_folding", "cloth_diagonal_folding")
ROUNDING = 2e-6  # of costs, relative: see test_costs.py


@pytest.mark.parametrize("name", task_names())
def test_score_is_0_at_the_start_and_near_1_at_the_goal(name):
    task = make_task(name, quick=True)
    episode = task.episode_fn(2)
    start, goal = (jnp.asarray(p, dtype=float) for p in (episode.start, episode.goal))
    assert float(score(task, episode, start)) == 0.0
    # A rope reaches its goal exactly. The layers of a fold stay a thickness (4 mm) apart.
    start_cost = float(task.terminal_cost(episode, at_rest(start)))
    gap = 2 * task.body.radius / start_cost if name in FOLDS else 0.0
    assert 1 - gap - ROUNDING <= float(score(task, episode, goal)) <= 1.0


@pytest.mark.parametrize("name", FOLDS)
def test_score_is_1_for_the_ideal_fold(name):
    # The moving half exactly on its images, which have not moved.
    task = make_task(name, quick=True)
    episode = task.episode_fn(4)
    ideal = np.array(episode.goal)
    ideal[:, 2] = episode.start[:, 2]
    assert float(score(task, episode, jnp.asarray(ideal, dtype=float))) == pytest.approx(
        1.0,
        abs=1e-5,  # images coincide to the rounding of coordinates, 1e-8 m of 0.14 m
    )


def test_a_worse_state_than_the_start_scores_below_0():
    task = make_task("cloth_side_folding", quick=True)
    episode = task.episode_fn(0)
    dragged = jnp.asarray(episode.start + np.array([0.5, 0.0, 0.0]), dtype=float)
    assert float(score(task, episode, dragged)) < -1
