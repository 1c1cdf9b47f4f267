"""Starts of episodes: turned at random, or crumpled; by seed, and by key in batches."""

import dataclasses

import jax
import numpy as np
import pytest
from scipy.stats import kstest, uniform

from jaxsimp import goals
from jaxsimp.tasks import Task, crumple, make_task, task_names

FOLDS = ("cloth_side_folding", "cloth_diagonal_folding")


def unturned(task: Task) -> goals.Positions:
    """The start before the turn."""
    folded = task.episode_fn.start
    return goals.flat(task.body) if folded is None else folded


def angle_of(task: Task, start: np.ndarray) -> float:
    """Angle, radians, from -pi to pi, by which a start is turned."""
    (x, y), (rest_x, rest_y) = ((p[-1] - p[0])[:2] for p in (start, unturned(task)))
    return float(np.angle((x + 1j * y) / (rest_x + 1j * rest_y)))


@pytest.mark.parametrize("name", FOLDS)
def test_episodes_are_turned_by_random_angles_up_to_45_degrees(name):
    task = make_task(name, quick=True)
    angles = []
    for seed in range(40):
        episode = task.episode_fn(seed)
        angles.append(angle_of(task, episode.start))
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


# --- drawn by key ---------------------------------------------------------------------------------

DRAWN = [name for name in task_names() if name != "rope_straightening"]
STRAIGHT = [name for name in DRAWN if name.startswith("rope")]
TURNED = sorted(set(DRAWN) - {*STRAIGHT, *task_names("obstacles")})
# Coordinates of up to 0.4 m and their turns, each a sum of two products, in float32.
ROUNDING = 2e-7


@pytest.mark.parametrize("name", DRAWN)
def test_a_batch_of_keys_draws_what_each_key_draws(name):
    task = make_task(name, 5)
    keys = jax.random.split(jax.random.key(3), 6)
    batch = jax.jit(jax.vmap(task.draw_episode))(keys)
    assert batch.start.shape == batch.goal.shape == (6, *task.goal.shape)
    for index, key in enumerate(keys):
        one = task.draw_episode(key)
        np.testing.assert_allclose(batch.start[index], one.start, atol=ROUNDING)
        np.testing.assert_allclose(batch.goal[index], one.goal, atol=ROUNDING)


@pytest.mark.parametrize("name", TURNED)
def test_a_drawn_start_and_its_goal_are_turned_alike(name):
    task = make_task(name, 5)
    for seed in range(3):
        episode = task.draw_episode(jax.random.key(seed))
        angle = angle_of(task, np.asarray(episode.start, dtype=float))
        start, goal = (goals.turn(each, angle) for each in (unturned(task), task.goal))
        # The angle is read off coordinates that are rounded themselves.
        np.testing.assert_allclose(episode.start, start, atol=2 * ROUNDING)
        np.testing.assert_allclose(episode.goal, goal, atol=2 * ROUNDING)


@pytest.mark.parametrize("name", FOLDS)
def test_drawn_angles_are_uniform_within_45_degrees(name):
    task = make_task(name, 5)
    starts = jax.vmap(task.draw_episode)(jax.random.split(jax.random.key(0), 2000)).start
    angles = [angle_of(task, start) for start in np.asarray(starts, dtype=float)]
    assert np.max(np.abs(angles)) <= np.pi / 4 + 1e-5  # read off float32 coordinates
    # Kolmogorov and Smirnov: of uniform draws one set in a thousand has a p-value below 0.001.
    assert kstest(angles, uniform(-np.pi / 4, np.pi / 2).cdf).pvalue > 1e-3


@pytest.mark.parametrize("name", STRAIGHT)
def test_a_drawn_start_of_a_straight_rope_is_that_of_every_seed(name):
    task = make_task(name, 5)
    drawn, made = task.draw_episode(jax.random.key(1)), task.episode_fn(7)
    np.testing.assert_array_equal(drawn.start, made.start.astype(np.float32))
    np.testing.assert_array_equal(drawn.goal, made.goal.astype(np.float32))


def test_a_crumpled_start_is_drawn_as_it_is_made():
    task = make_task("rope_straightening", 11)
    drawn = jax.jit(jax.vmap(task.draw_episode))(jax.vmap(jax.random.key)(np.arange(2)))
    for index in range(2):
        made = task.episode_fn(index)
        # A batch is other machine code, and what lies on what amplifies its rounding.
        np.testing.assert_allclose(drawn.start[index], made.start, atol=1e-3)
        np.testing.assert_array_equal(drawn.goal[index], made.goal.astype(np.float32))


def test_a_crumpled_start_of_another_body_is_refused():
    task, other = make_task("rope_straightening", 5), make_task("rope_straightening", 6)
    with pytest.raises(ValueError, match=r"draw_fn returns arrays of shapes .*\(6, 3\)"):
        dataclasses.replace(task, draw_fn=other.draw_fn)


def test_a_task_without_a_draw_fn_draws_no_episode():
    task = dataclasses.replace(make_task("rope_folding", 5), draw_fn=None)
    with pytest.raises(ValueError, match=r"'rope_folding' has no draw_fn.* episode_fn"):
        task.draw_episode(jax.random.key(0))
