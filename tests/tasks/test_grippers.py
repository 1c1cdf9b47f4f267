"""The constraint that grippers stay apart: its value, its gradient, and plans that keep to it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import jaxsimp as js
from jaxsimp import goals
from jaxsimp.engines import least_distance, plan_cost, settled_cost
from jaxsimp.engines.rollouts import merit
from jaxsimp.planning import CEM, Joint
from jaxsimp.tasks.grippers import WEIGHT, violation


@given(st.integers(0, 2**32 - 1))
def test_a_violation_is_that_of_finely_sampled_paths(seed):
    rng = np.random.default_rng(seed)
    position = rng.normal(size=(6, 3)).astype(np.float32)
    pick = rng.integers(-1, 6, 3)
    move = rng.normal(size=(3, 3)).astype(np.float32)
    found = violation(1.5, jnp.asarray(position), js.Actions(jnp.asarray(pick), jnp.asarray(move)))
    times = np.linspace(0.0, 1.0, 2001)[:, None]
    wanted = 0.0
    for first, second in [(0, 1), (0, 2), (1, 2)]:
        if js.NONE not in (pick[first], pick[second]):
            at = [position[pick[g]] - (1.0 - times) * move[g] for g in (first, second)]
            wanted += max(1.5 - np.linalg.norm(at[0] - at[1], axis=1).min(), 0.0)
    assert found == pytest.approx(wanted, abs=2e-3)  # between samples: |way| / 4000


@pytest.mark.parametrize("pick", [[0, 1], [1, 1], [0, js.NONE], [js.NONE, js.NONE]])
@pytest.mark.parametrize("same_way", [False, True])
def test_gradients_are_finite_also_where_grippers_meet(pick, same_way):
    position = jnp.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]])
    move = jnp.array([[0.1, 0.0, 0.0], [0.1 if same_way else -0.1, 0.0, 0.0]])

    def of_move(move):
        return violation(0.3, position, js.Actions(jnp.array(pick), move))

    assert np.all(np.isfinite(jax.grad(of_move)(move)))


def test_a_plan_costs_more_by_how_much_nearer_grippers_come():
    free = dataclasses.replace(js.make_task("rope_folding", 7), num_actions=2, settle_actions=1)
    engine, episode = js.MassSprings(), free.episode_fn(0)
    plan = js.Actions(
        jnp.array([[0, 1], [6, js.NONE]]), jnp.full((2, 2, 3), 0.02).at[0, 1].set(-0.02)
    )
    done = engine.executor(free)(episode, plan)
    moved = done.positions
    near = sum(
        float(violation(0.2, jnp.asarray(end), js.Actions(plan.pick[t], plan.displacement[t])))
        for t, end in enumerate(moved[1:-1])
    )
    assert near > 0.05  # neighbours of a rope of 7 are 0.08 m apart
    apart = dataclasses.replace(free, gripper_distance=0.2)
    assert merit(free, plan, done) == done.score
    assert merit(apart, plan, done) == pytest.approx(done.score - WEIGHT * near, abs=1e-6)
    assert merit(apart, plan, dataclasses.replace(done, score=np.nan)) == -np.inf
    for cost in (plan_cost, settled_cost):
        without, with_limit = (
            cost(task, engine, engine.physics(task), episode, plan) for task in (free, apart)
        )
        # float32, and machine code of another program
        assert with_limit - without == pytest.approx(WEIGHT * near, abs=1e-4)


def test_plans_keep_grippers_apart():
    body = js.rope(11, 0.4)
    goal = goals.polyline(body, np.array([[0.0, 0.0], [0.2, 0.0], [0.2, 0.2]]))
    search = CEM(num_iterations=6, population=32, initial_populations=1, encoding=Joint())
    plans = []
    for distance in (0.0, 0.15):
        task = js.reach(body, goal, num_actions=2, gripper_distance=distance)
        planner, episode = js.Planner(task), task.episode_fn(0)
        found, _ = planner.plan_best(episode, np.arange(11), search, [0, 1])
        plans.append(js.MassSprings(True).trajectory(task, episode, found.actions))
    free, apart = map(least_distance, plans)
    assert free is not None
    assert free < 0.13
    assert apart is None or apart > 0.148  # frames, of which a picker's path is made, are float32


def test_a_plan_file_keeps_the_distance(tmp_path):
    body = js.rope(7)
    task = js.reach(body, goals.letter(body, "U"), num_actions=1, gripper_distance=0.07)
    episode = task.episode_fn(0)
    actions = js.Actions(jnp.array([[0, 6]]), jnp.zeros((1, 2, 3)))
    execution = js.MassSprings().executor(task)(episode, actions)
    js.save_plan(tmp_path / "plan.npz", task, episode, actions, execution, engine="springs")
    assert js.load_plan(tmp_path / "plan.npz").task().gripper_distance == 0.07


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize("distance", [-0.1, float("nan"), 100.0, "far"])
def test_distances_that_are_none_are_refused(distance):
    task = js.make_task("rope_folding", 7)
    with pytest.raises(ValueError, match="gripper_distance is"):
        dataclasses.replace(task, gripper_distance=distance)
