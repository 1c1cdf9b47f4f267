"""The cost of a plan: running costs of states and actions, and a terminal cost."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsimp.dynamics import NONE, Actions, at_rest, rollout
from jaxsimp.engines import MassSprings, plan_cost, settled_cost, then_idle
from jaxsimp.engines.rollouts import require_plan
from jaxsimp.tasks import make_task


def effort(episode, state, action):
    """Speed after the action, and the way that pickers go: by action, so the order matters."""
    return jnp.linalg.norm(state.velocity) + jnp.abs(action.displacement).sum()


def height(episode, state):
    return 100.0 + state.position[:, 2].mean()


@pytest.mark.parametrize("weight", [1.0, 0.3, 0.0])
def test_a_plan_costs_its_actions_and_the_state_that_it_leaves(weight):
    task = dataclasses.replace(
        make_task("rope_letter_u", 7),
        running_cost=effort,
        terminal_cost=height,
        running_weight=weight,
        num_actions=2,
        action_seconds=0.1,
    )
    actions = Actions(jnp.array([[0, 6], [NONE, 3]]), jnp.linspace(0.01, 0.1, 12).reshape(2, 2, 3))
    engine, episode = MassSprings(), task.episode_fn(0)
    physics = engine.physics(task)
    found = jax.jit(lambda plan: plan_cost(task, engine, physics, episode, plan))(actions)
    start = at_rest(episode.start)
    _, states = rollout(*physics, start, then_idle(actions, 1), lambda state: state)
    speeds = [np.linalg.norm(each) for each in np.asarray(states.velocity, float)]
    ways = np.abs(np.asarray(actions.displacement, float)).sum(axis=(1, 2))
    left = 100.0 + np.asarray(states.position[2, :, 2], float).mean()
    # float32 of a number of 100
    np.testing.assert_allclose(found, weight * (sum(speeds[:2]) + ways.sum()) + left, atol=3e-5)
    assert speeds[2] > 1e-3  # the action with nothing held has no running cost


def test_the_settled_cost_is_that_of_the_execution():
    task = dataclasses.replace(
        make_task("rope_letter_u", 7), num_actions=1, action_seconds=0.1, settle_actions=2
    )
    actions = Actions(jnp.array([[0, 6]]), jnp.full((1, 2, 3), 0.05))
    engine, episode = MassSprings(), task.episode_fn(0)
    found = settled_cost(task, engine, engine.physics(task), episode, actions)
    done = engine.executor(task)(episode, actions)
    np.testing.assert_allclose(found, 1.0 - done.score, atol=1e-5)  # float32, other machine code


@pytest.mark.usefixtures("unchecked_shapes")
def test_a_plan_of_other_types_is_carried_out_alike():
    task = make_task("rope_folding", 5)
    pick = np.zeros((task.num_actions, task.num_pickers), int)
    kept = require_plan(task, Actions(pick.astype(np.uint8), np.zeros((*pick.shape, 3), np.int64)))
    assert kept.pick.dtype == jnp.zeros(1, int).dtype
    assert kept.displacement.dtype == jnp.zeros(1).dtype
