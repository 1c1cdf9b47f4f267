"""Waypoints of grippers: against the plan that they are of."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxsimp.dynamics import NONE, Actions
from jaxsimp.engines import MassSprings, Trajectory, grasps, least_distance, waypoints
from jaxsimp.tasks import make_task

TASK = dataclasses.replace(
    make_task("rope_folding", 9), num_actions=2, action_seconds=0.1, settle_actions=1
)
PLAN = Actions(
    jnp.array([[0, 8], [4, 8]]),
    jnp.array([[[0.0, 0.02, 0.05], [-0.03, 0.0, 0.04]], [[0.0, 0.0, 0.03], [0.02, 0.01, 0.02]]]),
)


def test_waypoints_go_along_the_displacements_of_the_plan():
    start = np.asarray(TASK.episode_fn(0).start)
    found = waypoints(MassSprings().trajectory(TASK, TASK.episode_fn(0), PLAN))
    assert [each.time for each in found] == sorted(each.time for each in found)
    own = {p: [each for each in found if (each.picker, each.particle) == p] for p in
           ((0, 0), (0, 4), (1, 8))}  # fmt: skip
    assert sum(map(len, own.values())) == len(found)
    for rows, displacement, at in (
        (own[0, 0], PLAN.displacement[0, 0], (0.0, 0.1)),
        (own[0, 4], PLAN.displacement[1, 0], (0.1, 0.2)),
        (own[1, 8], PLAN.displacement[:, 1].sum(axis=0), (0.0, 0.2)),  # held through both
    ):
        assert [each.gripper for each in rows] == ["closed"] * (len(rows) - 1) + ["open"]
        np.testing.assert_allclose([rows[0].time, rows[-1].time], at, atol=1e-6)
        moved = np.array(rows[-1][2:5]) - np.array(rows[0][2:5])
        np.testing.assert_allclose(moved, displacement, atol=1e-6)  # float32
    np.testing.assert_allclose(own[0, 0][0][2:5], start[0], atol=1e-6)
    # Picker 0 lets go of one particle before it grasps the other at the same time.
    changes = [each for each in found if each.picker == 0 and abs(each.time - 0.1) < 1e-6]
    assert [(each.gripper, each.particle) for each in changes] == [("open", 0), ("closed", 4)]


@given(st.integers(0, 10**6), st.integers(1, 3), st.integers(1, 8))
def test_grasps_are_runs_of_one_particle(seed, num_pickers, count):
    random = np.random.default_rng(seed)
    held = random.integers(NONE, 2, (count, num_pickers))
    motion = Trajectory(np.arange(count + 1.0), np.zeros((count + 1, 2, 3)), held)
    again = np.full_like(held, NONE)
    for picker, begin, end in grasps(motion):
        assert begin < end
        assert (again[begin:end, picker] == NONE).all()
        again[begin:end, picker] = held[begin, picker]
        assert end == count or held[end, picker] != held[begin, picker]
    np.testing.assert_array_equal(again, held)


@given(st.integers(0, 10**6))
def test_the_least_distance_is_that_of_finely_sampled_paths(seed):
    positions = np.random.default_rng(seed).normal(size=(4, 3, 3))
    held = np.array([[0, 1], [2, 1], [NONE, 1]])
    found = least_distance(Trajectory(np.arange(4.0), positions, held))
    part = np.linspace(0, 1, 2001)[:, None]
    sampled = [
        np.linalg.norm((1 - part) * (now[a] - now[b]) + part * (then[a] - then[b]), axis=1).min()
        for now, then, (a, b) in zip(positions[:2], positions[1:3], held[:2], strict=True)
    ]
    # Samples are at most 1/4000 of a path from the nearest place.
    assert found == pytest.approx(min(sampled), abs=20 / 4000)
    assert found <= min(sampled) + 1e-9


def test_one_gripper_has_no_distance():
    motion = Trajectory(np.arange(2.0), np.zeros((2, 2, 3)), np.array([[0, NONE]]))
    assert least_distance(motion) is None
