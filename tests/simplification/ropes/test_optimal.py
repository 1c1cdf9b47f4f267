import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxsimp import bodies, goals
from jaxsimp.simplification import FitStatus, Workspace, simplify, simplify_batch, simplify_optimal
from jaxsimp.simplification.key_points import SIZES_BEYOND
from jaxsimp.simplification.ropes.branch import settle
from jaxsimp.simplification.ropes.fit import hat_weights
from jaxsimp.simplification.ropes.search import regression_gains, search, segment_stiffness

ROPE = bodies.rope(length=1.0)  # 41 particles
EXACT = 1e-9  # metres: float64, and least squares that square the condition
KEPT = 2e-6  # metres: constraints, to ProxQP's residuals and `LENGTH_TOLERANCE`
COUNTS = st.sampled_from([8, 11, 13])  # few, since each is compiled
MOST = 6
seeds = st.integers(0, 2**32 - 1)


def small_rope(count):
    return bodies.rope(num_particles=count, length=1.0)


def random_goal(rng, count):
    """A polyline with noise, or a random walk, about 1 m long."""
    if rng.uniform() < 0.3:
        return np.cumsum(rng.normal(size=(count, 3)), axis=0) / count
    size = rng.integers(2, 6)
    corners = np.cumsum(rng.normal(size=(size, 3)), axis=0) / size
    along = np.concatenate([[0], np.sort(rng.uniform(size=size - 2)), [1]])
    goal = [np.interp(np.linspace(0, 1, count), along, axis) for axis in corners.T]
    return np.stack(goal, axis=1) + rng.normal(scale=rng.choice([0, 0.004]), size=(count, 3))


def fit_error(goal, breakpoints):
    W = hat_weights(len(goal), np.array([breakpoints]))[0]
    positions, *_ = np.linalg.lstsq(W, goal, rcond=None)
    return np.sqrt(np.sum((W @ positions - goal) ** 2) / len(goal))


def best_error(goal, size):
    """Error of the best fit of all with breakpoints at particles."""
    last = len(goal) - 1
    inner = itertools.combinations(range(1, last), size - 2)
    return min(fit_error(goal, (0, *each, last)) for each in inner)


def same(first, second):
    assert first.particles.tolist() == second.particles.tolist()
    assert first.positions == pytest.approx(second.positions, abs=EXACT, nan_ok=True)
    assert first.errors == pytest.approx(second.errors, abs=EXACT)
    assert (first.sizes, first.status) == (second.sizes, second.status)
    assert first.certified == second.certified


@given(seed=seeds, count=COUNTS)
def test_models_equal_exhaustive_search(seed, count):
    rng = np.random.default_rng(seed)
    batch = np.stack([random_goal(rng, count) for _ in range(2)])
    tolerance = float(rng.choice([0.002, 0.006, 0.015, 0.05]))
    models = simplify_optimal(small_rope(count), batch, tolerance, MOST)
    for goal, model in zip(batch, models, strict=True):
        errors = {size: best_error(goal, size) for size in range(2, MOST + 1)}
        size = next((size for size in errors if errors[size] < tolerance), None)
        assert model.certified
        assert (model.status == FitStatus.FITS) == (size is not None)
        assert len(model) == (size or MOST)
        for each, error in zip(model.sizes, model.errors, strict=True):
            assert error >= errors[each] - EXACT
        if size is not None:
            assert model.error == pytest.approx(errors[size], abs=EXACT)
            assert model.rms_error == pytest.approx(errors[size], abs=EXACT)
            assert fit_error(goal, model.particles) == pytest.approx(errors[size], abs=EXACT)
            assert model.sizes == tuple(range(2, min(size + SIZES_BEYOND, MOST) + 1))


def settle_from_nothing(goal, tolerance, node_limit):
    """Branch and bound with the poorest of fits to start from, and nothing proven."""
    count = len(goal)
    breakpoints = np.full((1, MOST - 1, MOST), count - 1)
    for size in range(2, MOST + 1):
        breakpoints[0, size - 2, : size - 1] = np.arange(size - 1)
    found = settle(
        goal[None],
        breakpoints,
        np.zeros((1, MOST - 1), dtype=bool),
        count * tolerance**2,
        regression_gains(count, 0.5, 0.5),
        segment_stiffness(count),
        node_limit,
    )
    return *found, breakpoints


def test_branch_and_bound_that_gives_up_proves_nothing():
    goal = np.random.default_rng(0).normal(size=(13, 3))
    places, certified, *_ = settle_from_nothing(goal, 0.1, 10**6)
    assert (places[0], certified[0]) == (MOST - 1, True)  # nothing fits
    places, certified, *_ = settle_from_nothing(goal, 0.1, 3)
    assert (places[0], certified[0]) == (MOST - 1, False)


@given(seed=seeds, count=COUNTS)
def test_branch_and_bound_alone_is_exact(seed, count):
    rng = np.random.default_rng(seed)
    goal = random_goal(rng, count)
    goal -= goal.mean(axis=0)
    tolerance = float(rng.choice([0.002, 0.015, 0.05]))
    places, certified, costs, breakpoints = settle_from_nothing(goal, tolerance, 10**6)
    errors = [best_error(goal, size) for size in range(2, MOST + 1)]
    fits = [error < tolerance for error in errors]
    assert certified.tolist() == [True]
    assert places[0] == (fits.index(True) if any(fits) else MOST - 1)
    if any(fits):
        assert np.sqrt(costs[0, places[0]] / count) == pytest.approx(errors[places[0]], abs=EXACT)
        chosen = breakpoints[0, places[0], : places[0] + 2]
        assert fit_error(goal, chosen) == pytest.approx(errors[places[0]], abs=EXACT)


@pytest.mark.parametrize(
    ("corners", "particles"),
    [
        ([[0, 0], [0.5, 0], [0.25, np.sqrt(3) / 4]], [0, 20, 40]),  # V
        ([[0, 0], [0.825, 0], [0.825, 0.175]], [0, 33, 40]),  # L of legs .825 and .175
        ([[0, 0], [1, 3], [2, 2], [4, 4], [4.5, 0]], None),  # an M of unequal legs
        ([[0, 0], [4, 0], [4, 3], [0, 0]], None),  # the triangle of sides 3, 4 and 5
    ],
)
def test_known_shapes_give_their_corners(corners, particles):
    corners = np.array(corners, dtype=float)
    lengths = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    corners /= lengths.sum()
    if particles is None:  # put corners at the nearest particles
        ends = np.concatenate([[0], np.cumsum(lengths)]) / lengths.sum()
        particles = np.round(40 * ends).astype(int).tolist()
        goal = np.zeros((41, 3))
        goal[:, :2] = np.stack(
            [np.interp(np.arange(41), particles, axis) for axis in corners.T], axis=1
        )
    else:
        goal = goals.polyline(ROPE, corners)
    model = simplify(ROPE, goal)
    assert model.particles.tolist() == particles
    assert model.positions[:, :2] == pytest.approx(corners, abs=EXACT)
    assert model.error < EXACT
    assert model.certified
    assert model.tolerance == pytest.approx(0.015)
    assert model.elements.tolist() == [[i, i + 1] for i in range(len(particles) - 1)]
    assert model.sizes == tuple(range(2, len(particles) + SIZES_BEYOND + 1))


@given(seed=seeds)
def test_corners_of_perfect_polylines_come_out_exactly(seed):
    rng = np.random.default_rng(seed)
    size = int(rng.integers(2, 8))
    particles = np.sort(rng.choice(np.arange(1, 40), size - 2, replace=False))
    particles = np.array([0, *particles, 40])
    corners = 0.3 * rng.normal(size=(size, 3))  # in general position: no three in a line
    goal = np.stack([np.interp(np.arange(41), particles, axis) for axis in corners.T], axis=1)
    # 10 m away float32 would be off by more than the tolerance.
    (model,) = simplify_optimal(ROPE, goal[None] + np.array([10.0, -10.0, 10.0]), 1e-6)
    assert model.particles.tolist() == particles.tolist()
    assert model.certified


@given(seed=seeds)
def test_a_batch_is_its_goals_one_by_one(seed):
    rng = np.random.default_rng(seed)
    batch = np.stack([random_goal(rng, 41) for _ in range(3)])
    models = simplify_optimal(ROPE, batch)
    assert all(model.certified for model in models)
    for goal, model in zip(batch, models, strict=True):
        same(model, simplify_optimal(ROPE, goal[None])[0])


def test_the_same_batch_gives_the_same_bits():
    batch = np.stack([random_goal(np.random.default_rng(0), 41) for _ in range(4)])
    for first, second in zip(*(simplify_optimal(ROPE, batch) for _ in range(2)), strict=True):
        assert first.errors == second.errors
        assert np.array_equal(first.positions, second.positions)


def test_equal_fits_give_the_first_one():
    # A symmetric arch: the corner of a fit with 3 may be left or right of its top.
    along = np.arange(8.0)
    goal = np.stack([along / 10, 1 - ((along - 3.5) / 3.5) ** 2, 0 * along], axis=1)
    (model,) = simplify_optimal(small_rope(8), goal[None], 0.5, 3)
    (mirrored,) = simplify_optimal(small_rope(8), goal[None, ::-1], 0.5, 3)
    assert len(model) == 2
    (model,) = simplify_optimal(small_rope(8), goal[None], 0.2, 3)
    (mirrored,) = simplify_optimal(small_rope(8), goal[None, ::-1], 0.2, 3)
    assert model.particles.tolist() == mirrored.particles.tolist() == [0, 3, 7]


def test_a_goal_that_nothing_fits_is_a_status_and_leaves_the_others_alone():
    rng = np.random.default_rng(1)
    batch = np.stack([random_goal(rng, 41), 0.3 * rng.normal(size=(41, 3)), random_goal(rng, 41)])
    models = simplify_batch(ROPE, batch, tolerance=0.03, max_size=6)
    assert [model.status for model in models] == [FitStatus.FITS, FitStatus.NO_FIT, FitStatus.FITS]
    assert models[1].sizes == (2, 3, 4, 5, 6)
    assert len(models[1]) == 6
    assert models[1].certified
    same(models[2], simplify_batch(ROPE, batch[2:], tolerance=0.03, max_size=6)[0])
    with pytest.raises(
        ValueError, match=r"up to 6 key points .* 0\.03 m: the best is off by 0\.\d"
    ):
        simplify(ROPE, batch[1], tolerance=0.03, max_size=6)


def test_too_few_nodes_give_a_model_that_is_not_certified():
    rng = np.random.default_rng(2)
    goal = np.cumsum(rng.normal(scale=0.03, size=(1, 41, 3)), axis=1)
    (model,) = simplify_optimal(ROPE, goal, 0.03, node_limit=5)
    (best,) = simplify_optimal(ROPE, goal, 0.03)
    assert best.certified
    assert not model.certified
    assert model.status == FitStatus.FITS
    assert model.error < model.tolerance
    assert len(model) >= len(best)


def test_certified_means_that_no_smaller_model_fits():
    batch = np.stack([random_goal(np.random.default_rng(seed), 13) for seed in range(20)])
    models = simplify_optimal(small_rope(13), batch, 0.01, node_limit=30)
    assert {model.certified for model in models} == {True, False}
    for goal, model in zip(batch, models, strict=True):
        if model.certified and len(model) > 2:
            assert best_error(goal, len(model) - 1) >= 0.01


def test_nothing_recompiles_for_a_new_batch_of_the_same_shape():
    search.clear_cache()
    for seed in (3, 4):
        rng = np.random.default_rng(seed)
        simplify_optimal(ROPE, np.stack([random_goal(rng, 41) for _ in range(4)]))
    assert search._cache_size() == 1
    assert len(settle.signatures) == 1


def test_a_workspace_is_kept_and_costs_something():
    rng = np.random.default_rng(5)
    batch = np.stack([random_goal(rng, 41) for _ in range(4)])
    lower, upper = (-0.3, -0.3, -1.0), (0.3, 0.3, 1.0)
    workspace = Workspace(lower, upper, above_table=True, max_stretch=0.0)
    models = simplify_optimal(ROPE, batch, 0.3, workspace=workspace)
    for model, free in zip(models, simplify_optimal(ROPE, batch, 0.3), strict=True):
        assert model.status == FitStatus.FITS
        assert (model.positions >= (-0.3 - KEPT, -0.3 - KEPT, ROPE.radius - KEPT)).all()
        assert (model.positions <= np.array(upper) + KEPT).all()
        lengths = np.linalg.norm(np.diff(model.positions, axis=0), axis=1)
        assert (lengths <= np.diff(model.particles) / 40 + KEPT).all()
        assert len(model) >= len(free)
        if len(model) == len(free):
            assert model.error >= free.error - KEPT
        assert model.certified == (len(model) == len(free))


def test_contradictory_constraints_are_a_status_and_leave_the_others_alone():
    straight = goals.straight(ROPE, 1.2)  # longer than the rope may be
    bent = goals.polyline(ROPE, np.array([[0, 0], [0.4, 0], [0.4, 0.6]]))
    workspace = Workspace(fixed_ends=True, max_stretch=0.05)
    models = simplify_optimal(ROPE, np.stack([bent, straight, bent]), workspace=workspace)
    assert [model.status for model in models] == [
        FitStatus.FITS,
        FitStatus.INFEASIBLE,
        FitStatus.FITS,
    ]
    assert len(models[1]) == 0
    assert not models[1].mask.any()
    (alone,) = simplify_optimal(ROPE, bent[None], workspace=workspace)
    for model in (models[0], models[2]):
        same(model, alone)
        assert model.particles.tolist() == [0, 16, 40]
        assert model.positions[[0, -1]] == pytest.approx(bent[[0, -1]], abs=KEPT)


def test_a_model_that_only_constraints_forbid_is_not_proven_away():
    pulled = goals.straight(ROPE, 3.0)[None]
    (free,) = simplify_optimal(ROPE, pulled, max_size=4)
    (held,) = simplify_optimal(ROPE, pulled, max_size=4, workspace=Workspace(max_stretch=0.0))
    assert (len(free), free.status, free.certified) == (2, FitStatus.FITS, True)
    assert (len(held), held.status, held.certified) == (4, FitStatus.NO_FIT, False)


def test_the_smallest_rope_and_an_empty_batch():
    pair = small_rope(2)
    (model,) = simplify_optimal(pair, np.array([[[0.0, 0, 0], [1, 0, 0]]]))
    assert model.particles.tolist() == [0, 1]
    assert simplify_optimal(ROPE, np.zeros((0, 41, 3))) == []


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tolerance": 0.0}, r"tolerance is 0.0; give a number from 1e-09 to 5 m"),
        ({"max_size": 0}, "max_size is 0; give a whole number of at least 2"),
    ],
)
def test_bad_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        simplify_optimal(ROPE, goals.straight(ROPE)[None], **options)
