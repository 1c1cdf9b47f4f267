"""Encodings: decoding after the rule of the paper's author, masks, and updates, against NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxsimp.dynamics import NONE
from jaxsimp.planning import ENCODINGS, ActionSpace, Categorical, GaussianIndex, Joint, Plans
from jaxsimp.planning.encodings import ChoiceAndGaussian, Gaussian

LIMITS = (0.1, 0.2, 0.05)
encodings = pytest.mark.parametrize("encoding", ENCODINGS.values(), ids=ENCODINGS)
both_ks = pytest.mark.parametrize("count", [1, 4, 625])


def space_of(candidates, num_actions=3, num_pickers=2) -> ActionSpace:
    return ActionSpace(
        jnp.asarray(candidates), jnp.asarray(LIMITS, dtype=float), num_actions, num_pickers
    )


def drawn(encoding, space, num, key=0, spread=0.7):
    distribution = encoding.init(space, spread)
    sample = encoding.sample(space, distribution, jax.random.key(key), num)
    return sample, decoded(encoding, space, sample)


def decoded(encoding, space, sample):
    return space.actions(encoding.decode(space, sample))


# --- decoding the Gaussian index ------------------------------------------------------------------


@both_ks
def test_gaussian_index_is_floored_after_a_linear_map(count):
    # The author's rule: g in [-1, 1] goes linearly to [0, K + 1] and is floored; index k < K
    # grasps candidate k, anything else is None. The middle of each of the K + 1 intervals is
    # farther from their ends (1/1252 at K = 625) than float32 rounds (1e-7).
    candidates = np.random.default_rng(0).permutation(1000)[:count]
    space = space_of(candidates, num_actions=1, num_pickers=1)
    middle = (np.arange(count + 1) + 0.5) / (count + 1) * 2 - 1
    sample = np.zeros((count + 1, 1, 1, 4))
    sample[:, 0, 0, 3] = middle
    actions = decoded(GaussianIndex(), space, jnp.asarray(sample, dtype=float))
    np.testing.assert_array_equal(actions.pick[:, 0, 0], [*candidates, NONE])


@both_ks
def test_gaussian_index_at_the_ends_of_its_range(count):
    space = space_of(np.arange(100, 100 + count), num_actions=1, num_pickers=2)
    ends = jnp.zeros((1, 2, 4)).at[0, :, 3].set(jnp.array([-1.0, 1.0]))
    picked = decoded(GaussianIndex(), space, ends).pick
    np.testing.assert_array_equal(picked, [[100, NONE]])


@both_ks
def test_share_of_none_in_the_range_is_one_in_k_plus_1(count):
    space = space_of(np.arange(count), num_actions=1, num_pickers=1)
    grid = 200 * (count + 1)  # a multiple of K + 1: each choice has exactly 200 points
    sample = np.zeros((grid, 1, 1, 4))
    sample[:, 0, 0, 3] = (np.arange(grid) + 0.5) / grid * 2 - 1
    picked = np.asarray(decoded(GaussianIndex(), space, jnp.asarray(sample, dtype=float)).pick)
    # A point next to a boundary may be rounded over it: at most one a side of each choice.
    counts = np.unique(picked, return_counts=True)[1]
    assert len(counts) == count + 1
    assert np.abs(counts - 200).max() <= 2


@both_ks
def test_first_categorical_draws_are_even(count):
    space = space_of(np.arange(count), num_actions=1, num_pickers=1)
    first = Categorical().init(space, 0.7).frequency
    np.testing.assert_allclose(first, 1 / (count + 1), rtol=1e-6)
    sample = Categorical().sample(space, Categorical().init(space, 0.7), jax.random.key(0), 20_000)
    none = np.mean(np.asarray(sample.choice) == count)
    share = 1 / (count + 1)
    # Five deviations of a binomial share.
    assert abs(none - share) < 5 * np.sqrt(share * (1 - share) / 20_000)


# --- masks and limits -----------------------------------------------------------------------------


@encodings
@settings(max_examples=10)
@given(
    candidates=st.lists(st.integers(0, 600), min_size=3, max_size=3, unique=True),
    key=st.integers(0, 2**31 - 1),
)
def test_only_candidates_are_picked_and_displacements_stay_within_limits(encoding, candidates, key):
    _, actions = drawn(encoding, space_of(candidates), 50, key, spread=3.0)
    assert actions.pick.shape == (50, 3, 2)
    assert actions.displacement.shape == (50, 3, 2, 3)
    assert set(np.unique(actions.pick)) <= {*candidates, NONE}
    # A float32 product of the limits and a number of at most 1 is not above the limits.
    assert np.all(np.abs(actions.displacement) <= np.asarray(LIMITS, dtype=np.float32))


@encodings
def test_every_candidate_and_none_is_picked_and_every_direction_is_tried(encoding):
    candidates = [7, 3, 500]
    _, actions = drawn(encoding, space_of(candidates), 400)
    assert set(np.unique(actions.pick)) == {*candidates, NONE}
    moves = np.asarray(actions.displacement).reshape(-1, 3) / LIMITS
    assert np.all(moves.min(axis=0) < -0.95)
    assert np.all(moves.max(axis=0) > 0.95)


@encodings
def test_one_sample_decodes_as_it_does_in_a_batch(encoding):
    space = space_of([4, 8, 15])
    sample, actions = drawn(encoding, space, 6)
    one = decoded(encoding, space, jax.tree.map(lambda array: array[2], sample))
    np.testing.assert_array_equal(one.pick, actions.pick[2])
    np.testing.assert_array_equal(one.displacement, actions.displacement[2])


@encodings
def test_draws_are_those_of_the_key(encoding):
    space = space_of([4, 8, 15])
    _, first = drawn(encoding, space, 20, key=1)
    _, again = drawn(encoding, space, 20, key=1)
    _, other = drawn(encoding, space, 20, key=2)
    np.testing.assert_array_equal(first.pick, again.pick)
    np.testing.assert_array_equal(first.displacement, again.displacement)
    assert np.any(first.pick != other.pick)
    assert np.mean(np.asarray(first.displacement) != np.asarray(other.displacement)) > 0.5


def test_draws_of_a_gaussian_have_its_moments():
    mean, spread = jnp.array([0.2, -0.1]), jnp.array([0.1, 0.2])
    draws = np.asarray(Gaussian(mean, spread).sample(jax.random.key(0), 20_000))
    # Clipping at 1 is 4.5 deviations away. Five deviations of a mean, and of a deviation.
    assert np.all(np.abs(draws.mean(axis=0) - mean) < 5 * spread / np.sqrt(20_000))
    assert np.all(np.abs(draws.std(axis=0) / spread - 1) < 5 / np.sqrt(2 * 20_000))


# --- updates --------------------------------------------------------------------------------------


def test_categorical_update_counts_the_elites():
    space = space_of([5, 6, 7, 8])
    rng = np.random.default_rng(0)
    choice = rng.integers(0, 5, (9, 3, 2))
    move = rng.uniform(-1, 1, (9, 3, 2, 3)).astype(np.float32)
    before = Categorical().init(space, 0.7)
    after = Categorical().update(space, before, Plans(jnp.asarray(choice), jnp.asarray(move)), 0.0)
    counted = np.stack(
        [[np.bincount(choice[:, t, g], minlength=5) / 9 for g in range(2)] for t in range(3)]
    )
    np.testing.assert_allclose(after.frequency, counted, atol=1e-6)  # float32 sums of 9 terms
    np.testing.assert_allclose(after.displacement.mean, move.mean(axis=0), atol=1e-6)
    np.testing.assert_allclose(after.displacement.spread, move.std(axis=0), atol=1e-6)


def test_gaussian_update_takes_the_moments_of_the_elites():
    space = space_of([5, 6, 7, 8])
    elites = np.random.default_rng(1).uniform(-1, 1, (9, 3, 2, 4)).astype(np.float32)
    before = GaussianIndex().init(space, 0.5)
    assert before.mean.shape == (3, 2, 4)
    assert np.all(before.mean == 0)
    assert np.all(before.spread == 0.5)
    after = GaussianIndex().update(space, before, jnp.asarray(elites), 0.0)
    np.testing.assert_allclose(after.mean, elites.mean(axis=0), atol=1e-6)  # float32 sums
    np.testing.assert_allclose(after.spread, elites.std(axis=0), atol=1e-6)


@encodings
@settings(max_examples=10)
@given(smoothing=st.floats(0.0, 0.999))
def test_smoothing_keeps_its_share_of_the_old_distribution(encoding, smoothing):
    space = space_of([5, 6, 7, 8])
    before = encoding.init(space, 0.7)
    elites, _ = drawn(encoding, space, 5, key=3)
    new = encoding.update(space, before, elites, 0.0)
    blended = encoding.update(space, before, elites, smoothing)
    for old, fitted, found in zip(*map(jax.tree.leaves, (before, new, blended)), strict=True):
        # rounding of float32 numbers of at most 1
        expected = smoothing * np.asarray(old) + (1 - smoothing) * np.asarray(fitted)
        np.testing.assert_allclose(found, expected, atol=1e-6)


def test_frequencies_stay_a_distribution():
    space, rng = space_of([5, 6, 7, 8]), np.random.default_rng(2)
    distribution = Categorical().init(space, 0.7)
    for _ in range(30):
        elites = Plans(
            jnp.asarray(rng.integers(0, 5, (4, 3, 2))),
            jnp.zeros((4, 3, 2, 3)),
        )
        distribution = Categorical().update(space, distribution, elites, 0.3)
    assert np.all(distribution.frequency >= 0)
    # float32: errors of 1e-7 that each update halves at least
    np.testing.assert_allclose(distribution.frequency.sum(axis=-1), 1.0, atol=1e-6)


def test_choices_that_no_elite_made_are_not_drawn_again():
    space = space_of([5, 6, 7, 8])
    elites = Plans(jnp.full((4, 3, 2), 2), jnp.zeros((4, 3, 2, 3)))
    certain = Categorical().update(space, Categorical().init(space, 0.7), elites, 0.0)
    drawn = Categorical().sample(space, certain, jax.random.key(0), 200)
    assert np.all(np.asarray(drawn.choice) == 2)
    assert np.all(np.asarray(drawn.direction) == 0)  # nor is there any spread left


# --- the mean -------------------------------------------------------------------------------------


def test_mean_of_a_categorical_is_the_likeliest_choice_with_the_mean_displacement():
    space = space_of([5, 6, 7], num_actions=1)
    frequency = jnp.array([[[0.1, 0.2, 0.6, 0.1], [0.0, 0.3, 0.2, 0.5]]])
    mean = jnp.arange(6.0).reshape(1, 2, 3) / 10
    distribution = ChoiceAndGaussian(frequency, Gaussian(mean, jnp.ones_like(mean)))
    actions = decoded(Categorical(), space, Categorical().mean(space, distribution))
    np.testing.assert_array_equal(actions.pick, [[7, NONE]])
    np.testing.assert_allclose(actions.displacement, np.asarray(mean) * LIMITS, rtol=1e-6)


def test_mean_of_a_gaussian_index_is_its_mean():
    space = space_of([5, 6, 7], num_actions=1)
    mean = jnp.array([[[0.1, 0.2, 0.3, -0.9], [0.0, 0.0, -0.5, 0.9]]])
    found = GaussianIndex().mean(space, Gaussian(mean, jnp.ones_like(mean)))
    actions = decoded(GaussianIndex(), space, found)
    np.testing.assert_array_equal(actions.pick, [[5, NONE]])
    np.testing.assert_allclose(actions.displacement, np.asarray(mean)[..., :3] * LIMITS, rtol=1e-6)


def test_encodings_are_registered_under_their_names():
    assert {name: encoding.name for name, encoding in ENCODINGS.items()} == {
        "categorical": "categorical",
        "gaussian_index": "gaussian_index",
        "joint": "joint",
    }


def joint_elites():
    """Three of candidate 5, each moved alike, and one of None, in one slot."""
    choice = jnp.array([0, 0, 0, 2])[:, None, None]
    move = jnp.array([[0.1, 0.2, 0.3]] * 3 + [[-0.9, -0.8, -0.7]])[:, None, None]
    return Plans(choice, move)


def test_joint_update_weighs_the_elites_of_a_choice_and_all_elites():
    space = space_of([5, 6], num_actions=1, num_pickers=1)
    encoding = Joint(borrowed=0.5)
    elites = joint_elites()
    choice, move = elites.choice, elites.direction
    found = encoding.update(space, encoding.init(space, 0.7), elites, 0.0)
    np.testing.assert_allclose(found.frequency[0, 0], [0.75, 0.0, 0.25])
    every, moves = np.asarray(move).mean(axis=0)[0, 0], np.asarray(move)[:, 0, 0]
    for option in range(3):
        # The moments of a sample in which all elites together count as half an elite.
        own = np.asarray(choice)[:, 0, 0] == option
        weight = own + 0.5 / 4
        mean = np.average(moves, axis=0, weights=weight)
        spread = np.sqrt(np.average((moves - mean) ** 2, axis=0, weights=weight))
        rounding = {"rtol": 1e-5, "atol": 1e-6}  # float32, of numbers below one
        np.testing.assert_allclose(found.displacement.mean[0, 0, option], mean, **rounding)
        np.testing.assert_allclose(found.displacement.spread[0, 0, option], spread, **rounding)
    np.testing.assert_allclose(found.displacement.mean[0, 0, 1], every, rtol=1e-6)


def test_joint_draws_are_those_of_the_choice_but_for_a_fresh_share():
    space = space_of([5, 6], num_actions=1, num_pickers=1)
    mean = jnp.array([[[[0.5, 0.5, 0.5], [-0.5, -0.5, -0.5], [0.0, 0.0, 0.0]]]])
    distribution = ChoiceAndGaussian(
        jnp.array([[[0.5, 0.5, 0.0]]]), Gaussian(mean, jnp.full_like(mean, 1e-3))
    )
    count, fresh = 20_000, 0.1
    sample = Joint(fresh=fresh).sample(space, distribution, jax.random.key(0), count)
    choice, move = (np.asarray(each)[:, 0, 0] for each in (sample.choice, sample.direction))
    settled = np.abs(move - np.asarray(mean)[0, 0][choice]).max(axis=1) < 0.01
    # Binomial: five deviations.
    slack = 5 * np.sqrt(fresh * (1 - fresh) / count)
    assert abs((~settled).mean() - fresh) < slack
    assert abs((choice == 2).mean() - fresh / 3) < slack  # what no elite chose
    anywhere = move[~settled]
    assert np.abs(anywhere.mean(axis=0)).max() < 5 / np.sqrt(3 * len(anywhere))
    assert anywhere.std(axis=0) == pytest.approx(np.sqrt(1 / 3), abs=0.05)
    settled_alone = Joint(fresh=0.0).sample(space, distribution, jax.random.key(1), 1000)
    assert set(np.asarray(settled_alone.choice).ravel()) == {0, 1}


def test_mean_of_a_joint_is_the_likeliest_choice_with_its_own_mean():
    space = space_of([5, 6], num_actions=1, num_pickers=1)
    mean = jnp.arange(9.0).reshape(1, 1, 3, 3) / 10
    distribution = ChoiceAndGaussian(
        jnp.array([[[0.2, 0.7, 0.1]]]), Gaussian(mean, jnp.ones_like(mean))
    )
    found = Joint().mean(space, distribution)
    assert found.choice.tolist() == [[1]]
    np.testing.assert_array_equal(found.direction, mean[:, :, 1])
