"""Environments of Gymnasium: as its checker wants them, and the same as the pure functions."""

import dataclasses
import warnings

import jax
import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium")

# What follows imports Gymnasium, an extra, and would fail without it: hence E402.
from gymnasium.utils.env_checker import check_env  # noqa: E402

from jaxsimp.envs import EnvAction  # noqa: E402
from jaxsimp.envs.gym import TaskEnv, env_id, register_envs  # noqa: E402
from jaxsimp.tasks import make_task, registry, task_names  # noqa: E402

FOLD = "jaxsimp/ClothDiagonalFolding-v1"
SMALL = {"resolution": 5, "candidates": np.array([0, 4, 7])}
RESOLUTIONS = {"t_shirt_sleeves_in": 9, "trousers_leg_over_leg": 9}
"""Least resolutions of garments, whose parts are narrow."""


@pytest.fixture(scope="module")
def env():
    """A single environment that draws; each test resets it."""
    return gymnasium.make(FOLD, render_mode="rgb_array", **SMALL)


@pytest.fixture(scope="module")
def batch():
    """Three environments; each test resets them."""
    return gymnasium.make_vec(FOLD, 3, vectorization_mode="vector_entry_point", **SMALL)


def played(env, seed, actions):
    observation, info = env.reset(seed=seed)
    return [(observation, 0.0, False, False, info), *(env.step(action) for action in actions)]


def drawn(env, count):
    env.action_space.seed(0)
    return [env.action_space.sample() for _ in range(count)]


def assert_same(found, others, **tolerance):
    for one, other in zip(found, others, strict=True):
        for leaf, wanted in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
            np.testing.assert_allclose(leaf, wanted, **tolerance)


@pytest.mark.parametrize("name", ["cloth_diagonal_folding", "rope_folding"])
def test_gymnasiums_checker_finds_no_fault(name):
    env = gymnasium.make(env_id(name), resolution=5, candidates=[0, 2])
    with warnings.catch_warnings():
        # Positions have no bounds that all bodies keep.
        warnings.filterwarnings("ignore", message=r".*Box observation space m\w+ value is -?inf")
        check_env(env.unwrapped)


def test_every_task_is_registered_and_can_be_made():
    ids = {each for each in gymnasium.registry if each.startswith("jaxsimp/")}
    assert ids == {env_id(name) for name in task_names()}
    for name in task_names():
        resolution = RESOLUTIONS.get(name, 5)
        env = gymnasium.make(env_id(name), resolution=resolution, candidates=[0, 1, 2])
        shape = make_task(name, resolution).goal.shape
        assert env.observation_space["position"].shape == shape
        assert env.action_space["choice"].nvec.tolist() == [4, 4]


def test_ids_are_names_in_camel_case():
    assert env_id("t_shirt_sleeves_in") == "jaxsimp/TShirtSleevesIn-v1"


def test_a_task_of_ones_own_is_registered_too(monkeypatch):
    monkeypatch.setattr(registry, "_REGISTRY", dict(registry._REGISTRY))
    monkeypatch.setattr(gymnasium.envs.registration, "registry", gymnasium.registry.copy())
    monkeypatch.setattr(gymnasium, "registry", gymnasium.envs.registration.registry)

    @registry.register(full=9, quick=5)
    def my_fold(resolution):
        return dataclasses.replace(make_task("cloth_side_folding", resolution), num_actions=1)

    register_envs()  # of those that were registered before nothing is said
    env = gymnasium.make("jaxsimp/MyFold-v1", **SMALL)
    env.reset(seed=0)
    assert env.step(env.action_space.sample())[2]


def test_a_seed_repeats_all_episodes_and_other_seeds_give_others(env):
    actions = drawn(env, 2)

    def three_episodes(seed):
        return [each for again in (seed, None, None) for each in played(env, again, actions)]

    one = three_episodes(3)
    assert_same(one, three_episodes(3), rtol=0)
    starts = [one[index][0]["position"] for index in (0, 3, 6)]
    starts.append(env.reset(seed=4)[0]["position"])
    for index, start in enumerate(starts):
        for other in starts[:index]:
            assert np.abs(start - other).max() > 1e-3


def test_a_step_is_that_of_the_pure_functions(env):
    plain = env.unwrapped.env
    (action,) = drawn(env, 1)
    _, (seen, reward, terminated, truncated, info) = played(env, 5, [action])
    key = jax.random.key(int(np.random.Generator(np.random.PCG64(5)).integers(2**32)))
    found = jax.jit(plain.step)(
        plain.reset(key), EnvAction(**jax.tree.map(jax.numpy.asarray, action))
    )
    for name, array in seen.items():
        np.testing.assert_allclose(array, getattr(found.observation, name), atol=1e-6)
    assert reward == pytest.approx(float(found.reward), abs=1e-5)
    assert info["score"] == pytest.approx(float(found.info["score"]), abs=1e-5)
    assert (terminated, truncated) == (False, False)


def test_an_episode_ends_after_the_last_action_with_the_score_as_return(env):
    found = played(env, 0, drawn(env, 2))
    assert [each[2] for each in found] == [False, False, True]
    assert sum(each[1] for each in found) == pytest.approx(found[-1][4]["score"], abs=1e-5)


def test_a_batch_is_single_environments_of_following_seeds(env, batch):
    actions = drawn(batch, 5)
    together = played(batch, 7, actions)
    for index in range(3):
        own = [jax.tree.map(lambda leaf, i=index: leaf[i], each) for each in actions]
        # The third step starts the next episode; so the single environment is reset then.
        apart = [*played(env, 7 + index, own[:2]), *played(env, None, own[3:])]
        for alone, found in zip(apart, together, strict=True):
            for name, array in alone[0].items():
                np.testing.assert_allclose(found[0][name][index], array, atol=1e-5)
            if found is not together[0]:
                assert found[1][index] == pytest.approx(alone[1], abs=1e-4)
                assert found[2][index] == alone[2]
            assert found[4]["score"][index] == pytest.approx(alone[4]["score"], abs=1e-4)


def test_a_batch_is_of_its_spaces(batch):
    observation, _ = batch.reset(seed=0)
    assert observation in batch.observation_space
    observation, reward, terminated, truncated, _ = batch.step(batch.action_space.sample())
    assert observation in batch.observation_space
    assert [array.shape for array in (reward, terminated, truncated)] == [(3,)] * 3


def test_environments_that_are_not_done_together_start_anew_apart(batch):
    batch.reset(seed=1)
    actions = drawn(batch, 2)
    inner, state = batch.unwrapped, batch.unwrapped._state
    # One episode is further than the others.
    inner._state = dataclasses.replace(state, num_actions=np.array([0, 1, 0], np.int32))
    assert batch.step(actions[0])[2].tolist() == [False, True, False]
    observation, reward, done, _, info = batch.step(actions[1])
    assert done.tolist() == [True, False, True]
    assert observation["time_left"].tolist() == [0.0, 1.0, 0.0]
    assert (reward[1], info["score"][1]) == (0.0, 0.0)
    assert not observation["velocity"][1].any()


def test_a_picture_shows_what_moved(env):
    env.reset(seed=0)
    before = env.render()
    assert (before.shape, before.dtype) == ((400, 400, 3), np.uint8)
    np.testing.assert_array_equal(env.render(), before)
    grasped = {"choice": np.array([0, 3]), "direction": np.full((2, 3), 0.9)}
    env.step(grasped)
    changed = (env.render() != before).any(axis=2)
    # The corner is lifted and the rest stays: some of the picture changes, and most does not.
    assert 50 < changed.sum() < changed.size / 2


@pytest.mark.parametrize(
    ("action", "said"),
    [
        (0, "the action is 0; give a dict of choice and direction"),
        ({"choice": [0, 0]}, "the action is .*; give a dict"),
        ({"choice": [0, 4]}, r"choice is \[0, 4\]; give indices of shape \(2,\), from 0 to 2 .* 3"),
        ({"choice": [0]}, r"choice is \[0\]; give indices of shape \(2,\)"),
        ({"choice": [0.5, 1]}, "choice is .* whole numbers"),
        ({"direction": np.zeros((2, 2))}, r"direction has shape \(2, 2\); give shape \(2, 3\)"),
        ({"direction": np.full((2, 3), np.nan)}, "direction is not finite; give numbers from -1"),
    ],
)
def test_an_action_that_is_none_is_refused(env, action, said):
    env.reset(seed=0)
    if isinstance(action, dict) and said.startswith(("choice", "direction")):
        action = {"choice": [0, 0], "direction": np.zeros((2, 3))} | action
    with pytest.raises(ValueError, match=f"^{said}"):
        env.unwrapped.step(action)


def test_a_step_without_an_episode_is_refused():
    single = gymnasium.make(FOLD, **SMALL).unwrapped
    batch = gymnasium.make_vec(FOLD, 2, **SMALL).unwrapped
    for env in (single, batch):
        with pytest.raises(ValueError, match="no episode yet; call reset first"):
            env.step(env.action_space.sample())


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize(
    ("options", "said"),
    [({"render_mode": "human"}, "render_mode is 'human'"), ({"resolution": 2}, "resolution is 2")],
)
def test_other_options_are_refused(options, said):
    with pytest.raises(ValueError, match=said):
        TaskEnv("rope_folding", **({"candidates": [0]} | options))
