import itertools

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize

from jaxsimp.simplification.ropes.fit import hat_weights
from jaxsimp.simplification.ropes.search import (
    regression_gains,
    ruled_out,
    search,
    search_batch,
    segment_stiffness,
)

SINGLE = 2e-6  # metres: float32 on coordinates below 1 m, summed along chains
COUNTS = st.sampled_from([8, 12])  # few, since each is compiled
seeds = st.integers(0, 2**32 - 1)


def random_goals(rng, count, batch=2):
    """Ropes about 1 m long: random walks with turns of every kind."""
    smooth = np.cumsum(rng.normal(size=(batch, count, 3)), axis=1)
    return np.cumsum(smooth * rng.uniform(0, 1) + rng.normal(size=smooth.shape), axis=1) / count


def fit_error(goal, breakpoints):
    W = hat_weights(len(goal), np.array([breakpoints], dtype=float))[0]
    positions, *_ = np.linalg.lstsq(W, goal, rcond=None)
    return np.sqrt(np.sum((W @ positions - goal) ** 2) / len(goal))


def best_of_all(goal, size):
    """Error and breakpoints of the best fit with breakpoints at particles."""
    last = len(goal) - 1
    inner = itertools.combinations(range(1, last), size - 2)
    return min((fit_error(goal, (0, *each, last)), (0, *each, last)) for each in inner)


@pytest.mark.parametrize("ends", [(1.0, 1.0), (0.5, 0.5)])
def test_gains_grow_the_line_of_weighted_least_squares(ends):
    values = np.random.default_rng(0).normal(size=9)
    gains = regression_gains(9, *ends)
    start, slope, cost = values[0], values[1] - values[0], 0.0
    for time in range(2, 9):
        off = values[time] - start - slope * time
        weights = np.array([ends[0], *np.ones(time - 1), ends[1]])
        expected = np.polyfit(np.arange(time + 1), values[: time + 1], 1, w=np.sqrt(weights))
        residual = values[: time + 1] - np.polyval(expected, np.arange(time + 1))
        last = gains[1, time]
        line = [slope + last[1] * off, start + last[0] * off]
        assert line == pytest.approx(expected, abs=1e-12)  # rounding
        assert cost + last[2] * off**2 == pytest.approx(weights @ residual**2, abs=1e-12)
        between = gains[0, time]
        start, slope = start + between[0] * off, slope + between[1] * off
        cost += between[2] * off**2


def test_stiffness_is_the_sum_over_the_particles_of_a_segment():
    for length, (alpha, beta) in enumerate(segment_stiffness(9).T[1:], start=1):
        along = np.linspace(0, 1, length + 1)
        weights = np.array([0.5, *np.ones(length - 1), 0.5])
        assert alpha == pytest.approx(weights @ (1 - along) ** 2, rel=1e-12)
        assert beta == pytest.approx(weights @ (along * (1 - along)), rel=1e-12, abs=1e-15)


@given(seed=seeds, count=COUNTS)
def test_errors_are_those_of_least_squares_at_the_breakpoints(seed, count):
    goals = random_goals(np.random.default_rng(seed), count)
    found = search_batch(goals, 6)
    for goal, errors, breakpoints in zip(goals, found.errors, found.breakpoints, strict=True):
        for size, error, row in zip(range(2, 7), errors, breakpoints, strict=True):
            assert row[0] == 0
            assert (row[size - 1 :] == count - 1).all()
            assert (np.diff(row[:size]) > 0).all()
            assert error == pytest.approx(fit_error(goal, row[:size]), abs=SINGLE)


@given(seed=seeds, count=COUNTS)
def test_no_fit_is_below_the_bounds(seed, count):
    goals = random_goals(np.random.default_rng(seed), count)
    found = search_batch(goals, 6)
    for goal, bounds, free in zip(goals, found.bounds, found.free_bounds, strict=True):
        for size, bound, free_bound in zip(range(2, 7), bounds, free, strict=True):
            best, breakpoints = best_of_all(goal, size)
            assert bound <= best + SINGLE
            assert free_bound <= best + SINGLE
            assert free_bound <= best_between(goal, breakpoints) + SINGLE


def best_between(goal, breakpoints):
    """Error of the best fit near another with breakpoints anywhere between the ends."""
    last = len(goal) - 1

    def error(inner):
        knots = np.sort(np.clip(inner, 0.01, last - 0.01))
        if (np.diff(knots) < 0.01).any():
            return np.inf
        return fit_error(goal, (0.0, *knots, last))

    if len(breakpoints) == 2:
        return fit_error(goal, breakpoints)
    options = {"maxfev": 150, "xatol": 1e-3}
    return minimize(error, breakpoints[1:-1], method="Nelder-Mead", options=options).fun


def test_breakpoints_between_particles_can_be_better_and_the_free_bound_knows():
    # A V whose corner is halfway between two particles: no fit at particles is exact.
    along = np.arange(10.0)
    goal = np.stack([along, np.abs(along - 4.5), 0 * along], axis=1) / 10
    found = search_batch(goal[None], 3)
    assert fit_error(goal, (0, 4.5, 9)) < 1e-12
    assert found.free_bounds[0, 1] <= SINGLE
    assert found.bounds[0, 1] == pytest.approx(best_of_all(goal, 3)[0], rel=0.2)
    assert found.bounds[0, 1] > 0.001


def test_a_single_segment_is_its_own_bound():
    goals = random_goals(np.random.default_rng(1), 12, batch=5)
    found = search_batch(goals, 3)
    expected = [fit_error(goal, (0, 11)) for goal in goals]
    assert found.errors[:, 0] == pytest.approx(expected, abs=SINGLE)
    assert found.free_bounds[:, 0] == pytest.approx(expected, abs=SINGLE)
    # The bound gives `ROUNDING` of the sum of squares away.
    assert found.bounds[:, 0] == pytest.approx(expected, rel=1e-3)


def test_bounds_are_close_to_the_best_fits_of_noisy_polylines():
    rng = np.random.default_rng(2)
    corners = np.array([[0, 0, 0], [0.3, 0, 0], [0.3, 0.3, 0], [0.6, 0.3, 0]])
    goal = np.stack([np.interp(np.linspace(0, 3, 13), range(4), axis) for axis in corners.T], 1)
    goal += rng.normal(scale=0.002, size=goal.shape)
    found = search_batch(goal[None], 4)
    for size, bound in zip((2, 3), found.bounds[0], strict=False):
        assert bound > 0.9 * best_of_all(goal, size)[0]


@given(seed=seeds, count=COUNTS)
def test_what_is_ruled_out_is_not_there(seed, count):
    goals = random_goals(np.random.default_rng(seed), count)
    found = search_batch(goals, 6)
    best = np.array([[best_of_all(goal, size)[0] for size in range(2, 7)] for goal in goals])
    # Tolerances at and around what the bounds reach.
    for tolerance in np.maximum(found.bounds, found.free_bounds).ravel() + 1e-9:
        assert not (ruled_out(found, float(tolerance)) & (best < tolerance)).any()
    assert ruled_out(found, 1e-9)[:, 0].all()


def test_far_from_the_origin_nothing_changes():
    goals = random_goals(np.random.default_rng(3), 12)
    # In float32 numbers around 1e4 are 1e-3 apart.
    near, far = search_batch(goals, 5), search_batch(goals + np.array([1e4, -1e4, 1e4]), 5)
    assert far.errors == pytest.approx(near.errors, abs=SINGLE)
    assert far.breakpoints.tolist() == near.breakpoints.tolist()


def test_a_new_batch_of_the_same_power_of_two_compiles_nothing():
    search.clear_cache()
    for seed, batch in ((4, 3), (5, 3), (6, 4)):
        search_batch(random_goals(np.random.default_rng(seed), 8, batch), 4)
    assert search._cache_size() == 1


def test_a_batch_is_its_goals_one_by_one():
    goals = random_goals(np.random.default_rng(7), 12, batch=5)
    batch = search_batch(goals, 5)
    for index, goal in enumerate(goals):
        for each, alone in zip(batch, search_batch(goal[None], 5), strict=True):
            assert each[index] == pytest.approx(alone[0], abs=SINGLE)


def test_more_goals_than_a_chunk_and_none_at_all():
    goals = random_goals(np.random.default_rng(8), 8, batch=70)
    found = search_batch(goals, 4)
    assert found.errors[69] == pytest.approx(search_batch(goals[69:], 4).errors[0], abs=SINGLE)
    assert search_batch(goals[:0], 4).breakpoints.shape == (0, 3, 4)


def test_search_keeps_the_dtype_and_two_particles_are_a_segment():
    with jax.enable_x64(True):
        goals = random_goals(np.random.default_rng(9), 8)
        found = search(goals - goals.mean(axis=1, keepdims=True), 3)
        assert found.errors.dtype == np.float64
    pair = search_batch(np.array([[[0.0, 0, 0], [1, 0, 0]]]), 2)
    assert pair.errors.tolist() == [[0.0]]
    assert pair.breakpoints.tolist() == [[[0, 1]]]
