"""Environments as pure functions: their steps are a rollout, and their returns are scores."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsimp.dynamics import at_rest, rollout
from jaxsimp.engines.engine import then_idle
from jaxsimp.envs import Env, EnvAction, EnvState, Transition, make_env
from jaxsimp.planning import Plans
from jaxsimp.simplification import simplify
from jaxsimp.tasks import Episode, FixedStart, distance_cost, make_task, score

CANDIDATES = np.array([0, 4, 7])
# float32 sums of metres in another order, grown over some hundred steps of stiff springs.
ROUNDING = 5e-6


def fold(**changes) -> Env:
    task = dataclasses.replace(make_task("cloth_diagonal_folding", 5), action_seconds=0.1)
    return make_env(dataclasses.replace(task, **changes), CANDIDATES)


def rope(*, self_contact: bool) -> Env:
    task = dataclasses.replace(make_task("rope_straightening", 9), num_actions=3)
    return make_env(task, np.array([0, 4, 8]), self_contact=self_contact)


def drawn(env: Env, seed: int, *batch: int) -> EnvAction:
    """Random actions, in which some pickers grasp nothing."""
    rng, shape = np.random.default_rng(seed), (*batch, env.task.num_pickers)
    choice = rng.integers(0, len(env.space.candidates) + 1, shape)
    direction = rng.uniform([-1, -1, 0.5], 1, (*shape, 3))  # lifted: it has to settle
    return EnvAction(jnp.asarray(choice), jnp.asarray(direction, float))


def episode_of(env: Env, state: EnvState, actions: EnvAction) -> tuple[EnvState, Transition]:
    """All actions of an episode, by `lax.scan`: the last state, and every transition's rest."""

    def one(state: EnvState, action: EnvAction):
        found = env.step(state, action)
        return found.state, found._replace(state=None)

    return jax.lax.scan(one, state, actions)


@pytest.fixture(scope="module")
def env() -> Env:
    return fold()


@pytest.fixture(scope="module")
def played(env):
    """A random start, actions, and what an environment makes of them step by step."""
    state, actions = env.reset(jax.random.key(1)), drawn(env, 0, env.task.num_actions)
    step, found = jax.jit(env.step), []
    for index in range(env.task.num_actions):
        action = jax.tree.map(lambda leaf, index=index: leaf[index], actions)
        found.append(step(found[-1].state if found else state, action))
    return state, actions, found


def assert_close(tree, other, tolerance=ROUNDING):
    for leaf, wanted in zip(jax.tree.leaves(tree), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(leaf, wanted, atol=tolerance)


@pytest.mark.parametrize("self_contact", [False, True])
def test_an_episode_is_a_rollout_of_the_plan_and_its_return_the_score(self_contact):
    env = rope(self_contact=self_contact)
    task, episode = env.task, env.task.episode_fn(3)
    actions = drawn(env, 1, task.num_actions)
    final, found = jax.jit(lambda state, actions: episode_of(env, state, actions))(
        env.start(episode), actions
    )
    plan = env.space.actions(Plans(actions.choice, actions.direction))
    settled, during = jax.jit(rollout)(
        env.simulation, env.pickers, at_rest(episode.start), then_idle(plan, task.settle_actions)
    )
    np.testing.assert_allclose(
        found.observation.position[:-1], during[: task.num_actions - 1], atol=ROUNDING
    )
    np.testing.assert_allclose(found.observation.position[-1], settled.position, atol=ROUNDING)
    np.testing.assert_allclose(found.observation.velocity[-1], settled.velocity, atol=1e-3)
    assert np.abs(during[-1] - during[task.num_actions - 1]).max() > 1e-3  # settling matters
    assert float(found.info["missed"][-1]) == float(settled.missed)
    wanted = float(score(task, episode, settled))
    assert float(final.score) == pytest.approx(wanted, abs=1e-4)
    assert float(found.reward.sum()) == pytest.approx(wanted, abs=1e-4)
    assert found.done.tolist() == [False, False, True]


def test_each_reward_is_the_saved_part_of_the_starts_cost(env, played):
    state, _, found = played
    cost = [float(env.task.terminal_cost(state.episode, at_rest(state.episode.start)))]
    for each in found:
        still = at_rest(each.observation.position)
        cost.append(float(env.task.terminal_cost(state.episode, still)))
        assert float(each.reward) == pytest.approx((cost[-2] - cost[-1]) / cost[0], abs=1e-5)
        assert float(each.info["score"]) == pytest.approx(1 - cost[-1] / cost[0], abs=1e-5)


def test_observations_have_the_goal_and_the_time_left(env, played):
    state, _, found = played
    seen = [env.observe(state), *(each.observation for each in found)]
    count = env.task.num_actions
    assert [float(each.time_left) for each in seen] == [1 - index / count for index in range(3)]
    np.testing.assert_array_equal(seen[0].position, state.episode.start)
    assert not seen[0].velocity.any()
    for each in seen:
        np.testing.assert_array_equal(each.goal, state.episode.goal)


def test_a_scan_and_a_batch_are_a_loop(env, played):
    state, actions, found = played
    others = drawn(env, 5, env.task.num_actions)
    states = jax.tree.map(lambda *leaves: jnp.stack(leaves), state, env.reset(jax.random.key(2)))
    both = jax.tree.map(lambda *leaves: jnp.stack(leaves), actions, others)
    run = jax.jit(lambda state, actions: episode_of(env, state, actions))
    final, scanned = run(state, actions)
    batch_final, batch = jax.jit(jax.vmap(lambda *given: episode_of(env, *given)))(states, both)
    looped = jax.tree.map(
        lambda *leaves: jnp.stack(leaves), *(each._replace(state=None) for each in found)
    )
    assert_close(final, found[-1].state, 1e-4)  # velocities of m/s
    assert_close(scanned, looped, 1e-4)
    assert_close(jax.tree.map(lambda leaf: leaf[0], (batch_final, batch)), (final, looped), 1e-4)
    assert np.abs(batch.observation.position[0] - batch.observation.position[1]).max() > 0.01


def test_in_a_batch_only_what_ends_settles(env, played):
    state, actions, found = played
    first, second = (jax.tree.map(lambda leaf, i=i: leaf[i], actions) for i in range(2))
    states = jax.tree.map(lambda *leaves: jnp.stack(leaves), state, found[0].state)
    both = jax.tree.map(lambda *leaves: jnp.stack(leaves), first, second)
    batch = jax.jit(jax.vmap(env.step))(states, both)
    for index in range(2):
        assert_close(jax.tree.map(lambda leaf, i=index: leaf[i], batch), found[index], 1e-4)


def test_a_batch_settles_at_the_price_of_one_branch(env):
    # In the program of a batch the steps of settling are in a branch, not beside the others.
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 3))
    program = str(jax.make_jaxpr(jax.vmap(env.step))(states, drawn(env, 0, 3)))
    assert "cond[" in program


def test_a_key_gives_one_start(env):
    one, again, other = (env.reset(jax.random.key(seed)) for seed in (1, 1, 2))
    for leaf, same in zip(jax.tree.leaves(one), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(leaf, same)
    assert np.abs(one.episode.start - other.episode.start).max() > 0.01


def test_after_the_end_nothing_changes(env, played):
    _, actions, found = played
    action = jax.tree.map(lambda leaf: leaf[0], actions)
    after = jax.jit(env.step)(found[-1].state, action)
    for leaf, same in zip(
        jax.tree.leaves(after.state), jax.tree.leaves(found[-1].state), strict=True
    ):
        np.testing.assert_array_equal(leaf, same)
    assert bool(after.done)
    assert float(after.reward) == 0.0


def test_an_action_that_is_not_finite_ends_the_episode(env, played):
    state, *_ = played
    wild = EnvAction(jnp.zeros(2, int), jnp.full((2, 3), jnp.nan))
    found = jax.jit(env.step)(state, wild)
    assert bool(found.done)
    assert np.isnan(found.reward)
    after = jax.jit(env.step)(found.state, wild)
    assert (bool(after.done), float(after.reward)) == (True, 0.0)


def test_a_start_that_costs_nothing_has_no_nan(env):
    start = FixedStart(Episode(env.task.goal, env.task.goal))
    free = fold(episode_fn=start, draw_fn=start.draw, terminal_cost=distance_cost)
    final, found = jax.jit(lambda *given: episode_of(free, *given))(
        free.reset(jax.random.key(0)), drawn(free, 0, 2)
    )
    assert float(final.score) == -np.inf  # see `jaxsimp.tasks.score`
    assert found.reward.tolist() == [-np.inf, 0.0]


def test_displacements_beyond_the_limits_are_clipped(env, played):
    state, actions, _ = played
    first = jax.tree.map(lambda leaf: leaf[0], actions)
    ends = dataclasses.replace(first, direction=jnp.sign(first.direction))
    far = dataclasses.replace(first, direction=5 * jnp.sign(first.direction))
    step = jax.jit(env.step)
    np.testing.assert_array_equal(
        step(state, far).observation.position, step(state, ends).observation.position
    )


def test_the_reward_is_differentiable_by_the_displacement(x64):
    env = fold(num_actions=1, settle_actions=1)  # one step, in which it settles
    start = jax.jit(env.reset)(jax.random.key(1))

    def reward(direction):
        return env.step(start, EnvAction(jnp.array([0, 3]), direction)).reward

    at = jnp.array([[0.3, -0.4, 0.5], [0.0, 0.0, 0.0]])
    along = jnp.array([[1.0, -0.5, 0.7], [0.0, 0.0, 0.0]])
    slope = float((jax.jit(jax.grad(reward))(at) * along).sum())
    rewarded, h = jax.jit(reward), 1e-6
    difference = float(rewarded(at + h * along) - rewarded(at - h * along)) / (2 * h)
    # Central differences: an error of h^2, and rounding of 1e-16 / h.
    assert slope == pytest.approx(difference, rel=1e-5)
    assert abs(slope) > 1e-3


def test_candidates_are_the_key_points_by_default():
    task = make_task("rope_folding", 21)
    key_points = simplify(task.body, task.goal)
    np.testing.assert_array_equal(make_env(task).space.candidates, key_points.particles)


def test_an_environment_is_a_pytree(env):
    doubled = jax.tree.map(lambda leaf: leaf, env)
    assert doubled.task is env.task
    heavier = dataclasses.replace(
        env, simulation=dataclasses.replace(env.simulation, mass=2 * env.simulation.mass)
    )
    state, action = env.reset(jax.random.key(0)), drawn(env, 0)
    step = jax.jit(lambda env, state, action: env.step(state, action).observation.position)
    assert np.abs(step(heavier, state, action) - step(env, state, action)).max() > 1e-4


def test_a_task_without_a_draw_fn_is_no_environment():
    with pytest.raises(ValueError, match=r"'cloth_diagonal_folding' has no draw_fn.* give it one"):
        fold(draw_fn=None)


@pytest.mark.usefixtures("unchecked_shapes")
def test_a_flag_is_true_or_false():
    with pytest.raises(ValueError, match="self_contact is 2"):
        make_env(make_task("rope_folding", 9), np.array([0]), self_contact=2)
