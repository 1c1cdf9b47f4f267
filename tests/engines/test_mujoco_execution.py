"""Plans in MuJoCo: pickers go where ours go, failures are a status, batches change nothing."""

import dataclasses
import os

import jax.numpy as jnp
import numpy as np
import pytest

from jaxsimp.dynamics import NONE, Actions
from jaxsimp.engines import ExecutionStatus, Layout, replay
from jaxsimp.engines.mujoco import model as flex
from jaxsimp.engines.mujoco.model import VARIANTS, Variant
from jaxsimp.planning import Planner
from jaxsimp.tasks import Episode, make_task, score


def small_rope():
    return dataclasses.replace(make_task("rope_folding", 9), num_actions=2, settle_actions=1)


def small_cloth():
    return dataclasses.replace(make_task("cloth_side_folding", 7), num_actions=2, settle_actions=1)


TASKS = [small_rope(), small_cloth()]


def plan(*actions):
    """A plan for two pickers, of displacements by particle."""
    pick, move = np.full((len(actions), 2), NONE), np.zeros((len(actions), 2, 3))
    for t, each in enumerate(actions):
        if not each:
            continue
        pick[t, : len(each)] = list(each)
        move[t, : len(each)] = list(each.values())
    return Actions(jnp.asarray(pick), jnp.asarray(move))


def random_plan(task, seed):
    rng = np.random.default_rng(seed)
    pick = rng.integers(-1, task.body.num_particles, (task.num_actions, 2))
    move = rng.uniform(-0.08, 0.08, (task.num_actions, 2, 3))
    move[..., 2] += 0.05
    return Actions(jnp.asarray(pick), jnp.asarray(move))


def one(task, actions, variant="full", seed=0):
    (found,) = replay(task, [task.episode_fn(seed)], [actions], variant)
    return found


@pytest.mark.parametrize("task", TASKS, ids=lambda task: task.name)
@pytest.mark.parametrize("variant", VARIANTS)
def test_a_grasped_particle_is_where_its_picker_is_after_each_action(task, variant):
    up, over = [0.01, 0.02, 0.06], [-0.02, 0.01, -0.03]
    last = task.body.num_particles - 1
    found = one(task, plan({0: up}, {0: over, last: up}), variant)
    assert found.status == ExecutionStatus.FINE
    assert found.warnings == ()
    path = found.positions[:, [0, last]]
    np.testing.assert_array_equal(path[0], np.asarray(task.episode_fn(0).start)[[0, last]])
    # The speed of a picker ends at zero, and what holds the particle is stiff: 0.1 mm.
    np.testing.assert_allclose(path[1, 0] - path[0, 0], up, rtol=0, atol=1e-4)
    np.testing.assert_allclose(path[2] - path[1], [over, up], rtol=0, atol=1e-4)
    assert np.linalg.norm(path[3, 0] - path[2, 0]) > 0.01  # let go, it falls


@pytest.mark.parametrize("variant", VARIANTS)
def test_displacements_are_clipped_to_the_limits_and_to_the_table(variant):
    task = small_rope()
    found = one(task, plan({0: [0.0, 1.0, 0.05]}, {0: [0.0, 0.0, -1.0]}), variant)
    moved = np.diff(found.positions[:, 0], axis=0)
    np.testing.assert_allclose(moved[0], [0.0, task.limits[1], 0.05], rtol=0, atol=1e-4)
    # The table is soft, and pushes the particle up a little.
    assert found.positions[2, 0, 2] == pytest.approx(task.body.radius, abs=3e-4)


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_motion_that_stretches_the_body_too_far_is_refused(variant):
    task = small_rope()
    apart = plan({0: [-0.1, 0.0, 0.0], 8: [0.1, 0.0, 0.0]}, {0: [0.1, 0.0, 0.0]})
    found = one(task, apart, variant)
    # 0.74 m is beyond 1.2 times 0.54 m: both hold still in the first action.
    np.testing.assert_allclose(found.positions[1, [0, 8]], found.positions[0, [0, 8]], atol=1e-4)
    assert found.positions[2, 0, 0] - found.positions[1, 0, 0] == pytest.approx(0.1, abs=1e-4)


@pytest.mark.parametrize("task", TASKS, ids=lambda task: task.name)
def test_the_score_is_the_tasks_of_the_settled_positions(task):
    found = one(task, random_plan(task, 1), "fast", seed=3)
    assert found.positions.shape == (task.num_actions + 2, task.body.num_particles, 3)
    settled = jnp.asarray(found.positions[-1], dtype=float)
    expected = float(score(task, task.episode_fn(3), settled))
    assert found.score == pytest.approx(expected, abs=1e-6)  # rounding of compiled code
    idle = one(task, plan({}, {}), "full")
    # Nothing moves but for what settles: fractions of a millimetre of 0.1 m and more.
    assert abs(idle.score) < 0.01


@pytest.mark.parametrize("task", TASKS, ids=lambda task: task.name)
def test_a_body_settles_until_it_is_still_and_no_longer(task, monkeypatch):
    lifted = plan({0: [0.05, 0.0, 0.1]}, {0: [0.05, 0.0, 0.0]})
    soon, late = (
        one(dataclasses.replace(task, settle_actions=count), lifted).positions[-1]
        for count in (4, 8)
    )
    np.testing.assert_array_equal(soon, late)
    monkeypatch.setattr("jaxsimp.engines.mujoco.execution.STILL", 0.0)
    fully = one(dataclasses.replace(task, settle_actions=4), lifted).positions[-1]
    # At STILL it could move 5 mm in what is left of those seconds; it only creeps: 0.4 mm.
    assert 0 < np.abs(fully - soon).max() < 1e-3


@pytest.mark.slow
def test_a_dragged_rope_moves_as_ours():
    # Dragged along the table by one end, sideways: what is compared depends on mass, friction,
    # drag and stiffness alike.
    task = dataclasses.replace(make_task("rope_folding", 15), num_actions=2, settle_actions=1)
    actions = plan({0: [0.1, 0.14, 0.0]}, {0: [0.1, 0.14, 0.0]})
    planner = Planner(task, layout=Layout())
    ours = planner.execute(task.episode_fn(0), actions).positions[-1]
    full = one(task, actions).positions[-1]
    moved = np.linalg.norm(ours - np.asarray(task.episode_fn(0).start), axis=-1)
    error = np.linalg.norm(full - ours, axis=-1)
    assert moved.max() > 0.2
    # MuJoCo's friction creeps and its integrator has another step: 5 % of the way of the end.
    assert error.mean() < 0.05 * moved.max()


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_batch_is_its_plans_one_by_one_bit_for_bit(variant):
    task = small_cloth()
    seeds = [0, 1, 2, 0]
    plans = [random_plan(task, seed) for seed in seeds]
    episodes = [task.episode_fn(seed) for seed in seeds]
    together = list(replay(task, episodes, plans, variant, num_workers=3))
    again = list(replay(task, episodes, plans, variant, num_workers=1))
    for index, found in enumerate(together):
        # Alone, other particles can be grasped: the model is another, its numbers are not.
        (alone,) = replay(task, episodes[index : index + 1], plans[index : index + 1], variant)
        for other in (again[index], alone):
            np.testing.assert_array_equal(found.positions, other.positions)
            assert found.score == other.score
    np.testing.assert_array_equal(together[0].positions, together[3].positions)


def test_an_unstable_simulation_is_a_status(monkeypatch, tmp_path):
    # Springs that are explicit, at twenty times their stable step.
    monkeypatch.chdir(tmp_path)
    step = 20 * flex.largest_time_step(small_rope().body)
    monkeypatch.setattr(flex, "largest_time_step", lambda body: 1.0)
    task = small_rope()
    variant = Variant(step, elastic=True, self_collision=False)
    found = one(task, plan({0: [0.05, 0.1, 0.1]}, {0: [0.05, 0.1, 0.1]}), variant)
    assert found.status == ExecutionStatus.UNSTABLE
    assert np.isnan(found.score)
    assert np.isnan(found.positions[-1]).all()
    assert np.isfinite(found.positions[0]).all()
    assert os.listdir(tmp_path) == []  # no log of MuJoCo's


def test_wrong_requests_are_refused():
    task = small_rope()
    with pytest.raises(ValueError, match="1 episodes are given for 2 plans; give one for each"):
        replay(task, [task.episode_fn(0)], [random_plan(task, 0)] * 2)
    with pytest.raises(ValueError, match=r"pick\[0, 0\] is 9; a body of 9 particles has"):
        one(task, plan({9: [0.0, 0.0, 0.1]}))
    with pytest.raises(ValueError, match="num_workers is 0; give a whole number from 1"):
        replay(task, [], [], num_workers=0)
    start = np.array(task.episode_fn(0).start)
    with pytest.raises(ValueError, match=r"episode.start.* is nan"):
        replay(task, [Episode(start * np.nan, start)], [random_plan(task, 0)])
