"""Trajectories: the frames of a plan, against executions and closed forms."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxsimp.dynamics import NONE, Actions
from jaxsimp.engines import MassSprings, MuJoCo, Recorder, Trajectory
from jaxsimp.engines.trajectory import frame_times, held_particles, stride_of
from jaxsimp.tasks import make_task

SECONDS = 0.16
TASK = dataclasses.replace(
    make_task("rope_folding", 9), num_actions=2, action_seconds=SECONDS, settle_actions=2
)
PLAN = Actions(
    jnp.array([[0, 8], [NONE, 3]]),
    jnp.array([[[0.0, 0.02, 0.05], [-0.03, 0.0, 0.04]], [[0.0, 0.0, 0.0], [0.02, 0.01, 0.03]]]),
)


@given(st.integers(1, 400), st.floats(0.01, 3.0), st.floats(0.1, 500.0))
def test_frames_are_as_close_as_asked_and_cover_an_action(steps, seconds, rate):
    stride = stride_of(steps, seconds, rate)
    assert 1 <= stride <= steps
    times = frame_times(3, steps, seconds / steps, stride)
    assert np.all(np.diff(times) > 0)
    for action in range(4):  # the ends of actions are frames
        assert np.abs(times - action * seconds).min() < 1e-9 * max(1.0, action * seconds)
    wanted = min(steps, max(1, round(seconds * rate)))
    # Equal parts of whole steps: at most one step longer than asked.
    assert np.diff(times).max() <= seconds / wanted + seconds / steps + 1e-9


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize("rate", [0.0, np.nan, "fast", 1e9])
def test_a_rate_out_of_range_is_refused(rate):
    with pytest.raises(ValueError, match=r"frames_per_second is .*; give a number from 0\.1"):
        MassSprings().trajectory(TASK, TASK.episode_fn(0), PLAN, rate)


@pytest.mark.parametrize(
    ("engine", "rate"),
    [(MassSprings(), 45.0), (MassSprings(self_contact=True), 30.0), (MuJoCo("fast"), 45.0)],
)
def test_frames_at_the_ends_of_actions_are_those_of_the_execution(engine, rate):
    assert isinstance(engine, Recorder)
    episode = TASK.episode_fn(0)
    done = engine.executor(TASK)(episode, PLAN)
    found = engine.trajectory(TASK, episode, PLAN, rate)
    assert isinstance(found, Trajectory)
    assert found.positions.shape == (len(found.times), 9, 3)
    assert found.held.shape == (len(found.times) - 1, 2)
    ends = [np.abs(found.times - SECONDS * action).argmin() for action in range(3)]
    np.testing.assert_allclose(found.times[ends], [0.0, SECONDS, 2 * SECONDS], atol=1e-3)
    # float32; a rope amplifies rounding little in 0.6 s
    np.testing.assert_allclose(found.positions[ends], done.positions[:3], atol=1e-5)
    np.testing.assert_allclose(found.positions[-1], done.positions[-1], atol=1e-4)
    during = found.times[:-1] + np.diff(found.times) / 2
    np.testing.assert_array_equal(found.held[during < SECONDS], [[0, 8]] * (during < SECONDS).sum())
    np.testing.assert_array_equal(found.held[during > 2 * SECONDS], NONE)


def test_a_held_particle_follows_the_cubic_of_its_speed():
    """The position profile of a parabola of speed is 3 t^2 - 2 t^3."""
    found = MassSprings().trajectory(TASK, TASK.episode_fn(0), PLAN, 100.0)
    first = found.times < SECONDS + 1e-9
    part = found.times[first, None] / found.times[first].max()
    wanted = found.positions[0, 0] + (3 * part**2 - 2 * part**3) * np.array([0.0, 0.02, 0.05])
    # The profile is sampled at the middle of each of 80 steps: an error of order 80^-2.
    np.testing.assert_allclose(found.positions[first, 0], wanted, atol=0.06 / 80**2 + 1e-6)


def test_the_first_of_two_pickers_holds_a_particle_that_both_name():
    pick = jnp.array([[4, 4, NONE], [NONE, NONE, 2], [1, 0, 1]])
    held = held_particles(Actions(pick, jnp.zeros((3, 3, 3))))
    np.testing.assert_array_equal(held, [[4, NONE, NONE], [NONE, NONE, 2], [1, 0, NONE]])
