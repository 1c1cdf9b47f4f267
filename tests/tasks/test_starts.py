"""Starts of episodes: turned at random, or crumpled."""

import numpy as np
import pytest

from jaxsimp import goals
from jaxsimp.tasks import crumple, make_task

FOLDS = ("cloth_side_folding", "cloth_diagonal_folding")


@pytest.mark.parametrize("name", FOLDS)
def test_episodes_are_turned_by_random_angles_up_to_45_degrees(name):
    task = make_task(name, quick=True)
    angles = []
    for seed in range(40):
        episode = task.episode_fn(seed)
        edge = episode.start[-1] - episode.start[0]
        angle = np.arctan2(edge[1], edge[0]) - np.pi / 4  # the diagonal of a square at rest
        angles.append((angle + np.pi) % (2 * np.pi) - np.pi)
        np.testing.assert_allclose(episode.start, goals.flat(task.body, angles[-1]), atol=1e-12)
        np.testing.assert_allclose(episode.goal, goals.turn(task.goal, angles[-1]), atol=1e-12)
    assert np.max(np.abs(angles)) <= np.pi / 4
    # 40 uniform draws all miss an eighth of the range at either end once in 10^2.
    assert min(angles) < -np.pi / 8 < np.pi / 8 < max(angles)
    assert len(set(angles)) == 40


def test_straightening_starts_crumpled():
    task = make_task("rope_straightening", 11)
    episode = task.episode_fn(1)
    np.testing.assert_array_equal(episode.start, crumple(task.body, 1))
    np.testing.assert_array_equal(episode.goal, task.goal)
