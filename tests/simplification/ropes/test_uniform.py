import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jaxsimp import bodies, goals
from jaxsimp.simplification import FitStatus, Workspace, simplify, simplify_batch, simplify_uniform
from jaxsimp.simplification.key_points import SIZES_BEYOND
from jaxsimp.simplification.ropes.fit import Limits, fit_within
from jaxsimp.simplification.ropes.uniform import (
    breakpoint_particles,
    fit_rope,
    interpolation_matrix,
    uniform_breakpoints,
)

ROPE = bodies.rope()  # 41 particles, 0.5 m
SINGLE = 1e-6  # metres: float32 on coordinates below 1 m, and some room
DOUBLE = 1e-12
EXACT = 1e-7  # metres: ProxQP stops at residuals of 1e-10

seeds = st.integers(0, 2**32 - 1)
SIZES = st.sampled_from([2, 3, 5, 8])  # few, since each is compiled


def one(goal, *arguments, **options):
    """Key points of a batch of one."""
    (points,) = simplify_uniform(ROPE, goal[None], *arguments, **options)
    return points


def random_goals(rng, batch=3, count=41):
    return np.cumsum(rng.normal(scale=0.01, size=(batch, count, 3)), axis=1)


def corner_goal(rng, size, count):
    """A rope with evenly spread random corners, shape (count, 3)."""
    corners = rng.uniform(-0.5, 0.5, size=(size, 3))
    along = np.linspace(0, size - 1, count)
    return np.stack([np.interp(along, np.arange(size), axis) for axis in corners.T], 1), corners


@pytest.mark.usefixtures("x64")
@given(seed=seeds, size=SIZES)
def test_fit_matches_numpy_least_squares(seed, size):
    goal = random_goals(np.random.default_rng(seed))
    positions, errors = fit_rope(goal, size)
    for p, q, error in zip(goal, positions, errors, strict=True):
        expected, *_ = np.linalg.lstsq(interpolation_matrix(41, size), p, rcond=None)
        squared = np.sum((interpolation_matrix(41, size) @ expected - p) ** 2)  # equation 3
        assert np.asarray(q) == pytest.approx(expected, abs=DOUBLE)
        assert float(error) == pytest.approx(np.sqrt(squared / 41), abs=DOUBLE)


@pytest.mark.parametrize(("count", "size"), [(41, 2), (41, 7), (10, 10), (11, 10), (2, 2)])
def test_interpolation_matrix_matches_numpy_interp(count, size):
    along, knots = np.linspace(0, 1, count), np.linspace(0, 1, size)
    expected = np.stack([np.interp(along, knots, row) for row in np.eye(size)], axis=1)
    W = interpolation_matrix(count, size)
    assert np.allclose(W, expected, rtol=0.0, atol=1e-14)  # rounding
    assert np.linalg.matrix_rank(W) == size  # the fit is unique


@given(seed=seeds, size=SIZES, count=st.sampled_from([9, 41]))
def test_evenly_spread_corners_are_fitted_exactly(seed, size, count):
    goal, corners = corner_goal(np.random.default_rng(seed), size, count)
    positions, errors = fit_rope(goal[None], size)
    # With nearly as many corners as particles some are held by few: rounding grows.
    assert np.asarray(positions[0]) == pytest.approx(corners, abs=20 * SINGLE)
    assert float(errors[0]) <= SINGLE


@given(seed=seeds, size=SIZES)
def test_error_does_not_change_when_the_goal_moves(seed, size):
    rng = np.random.default_rng(seed)
    goal = random_goals(rng, batch=1)
    moved = goal @ Rotation.random(rng=rng).as_matrix().T + rng.normal(size=3)
    errors = [float(fit_rope(g, size)[1][0]) for g in (goal, moved)]
    assert errors[1] == pytest.approx(errors[0], abs=SINGLE)


@given(seed=seeds, size=SIZES)
def test_a_batch_is_its_goals_one_by_one(seed, size):
    batch = random_goals(np.random.default_rng(seed))
    positions, errors = fit_rope(batch, size)
    for index, goal in enumerate(batch):
        alone, error = fit_rope(goal[None], size)
        assert np.asarray(alone[0]) == pytest.approx(np.asarray(positions[index]), abs=SINGLE)
        assert float(error[0]) == pytest.approx(float(errors[index]), abs=SINGLE)


def test_fit_commutes_with_vmap_and_keeps_the_dtype():
    batch = random_goals(np.random.default_rng(0)).astype(np.float32)
    positions, _ = fit_rope(batch, 4)
    mapped = jax.vmap(lambda goal: fit_rope(goal[None], 4)[0][0])(batch)
    assert np.asarray(mapped) == pytest.approx(np.asarray(positions), abs=SINGLE)
    assert positions.dtype == np.float32
    with jax.enable_x64(True):
        assert fit_rope(batch.astype(float), 4)[0].dtype == np.float64


def test_a_straight_rope_needs_its_ends():
    points = one(goals.straight(ROPE))
    assert points.particles.tolist() == [0, 40]
    assert points.elements.tolist() == [[0, 1]]
    assert points.positions == pytest.approx(goals.straight(ROPE)[[0, 40]], abs=SINGLE)
    assert points.tolerance == pytest.approx(0.015 * 0.5)


@pytest.mark.parametrize(
    ("corners", "particles"),
    [
        ([[0, 0], [0.25, 0], [0.125, 0.2165]], [0, 20, 40]),  # the paper's fold, of two legs
        ([[0, 0], [1, 1], [2, 0], [3, 1], [4, 0]], [0, 10, 20, 30, 40]),  # M
        ([[0, 0], [1, 0], [0.5, 0.8660254], [0, 0]], [0, 13, 27, 40]),  # triangle
    ],
)
def test_polylines_of_equal_legs_give_their_corners(corners, particles):
    corners = np.array(corners, dtype=float)
    corners *= 0.5 / np.linalg.norm(np.diff(corners, axis=0), axis=1).sum()
    goal = goals.polyline(ROPE, corners)
    points = one(goal)
    assert points.particles.tolist() == particles
    assert points.sizes == tuple(range(2, len(particles) + 1 + SIZES_BEYOND))
    assert points.positions[:, :2] == pytest.approx(corners, abs=10 * SINGLE)
    before = points.errors[: points.sizes.index(len(particles))]
    assert points.error < points.tolerance <= min(before)


def test_every_size_is_tried_since_errors_are_not_monotone():
    goal = goals.polyline(ROPE, np.array([[0, 0], [0.25, 0], [0.25, 0.25]]))
    errors = [float(fit_rope(goal[None], size)[1][0]) for size in (3, 4, 5)]
    assert errors[0] < SINGLE
    assert errors[2] < SINGLE
    assert errors[1] > 1e-3
    points = one(goal, tolerance=1e-4)
    assert points.sizes == (2, 3, 4, 5, 6)
    assert len(points) == 3


def test_far_from_the_origin_float32_is_as_good():
    goal = goals.polyline(ROPE, np.array([[0, 0], [0.25, 0], [0.25, 0.25]]))
    goal = goal + np.array([40.0, -40.0, 0])
    points = one(goal, tolerance=1e-6)  # float32 at 40 m steps by 4e-6 m
    assert len(points) == 3


@pytest.mark.parametrize(("count", "size"), [(41, 4), (41, 6), (10, 4), (7, 7), (1000, 20)])
def test_key_particles_are_the_nearest_by_id(count, size):
    ids = breakpoint_particles(count, size)
    exact = np.linspace(0, count - 1, size)
    assert ids[0] == 0
    assert ids[-1] == count - 1
    assert (np.diff(ids) > 0).all()
    assert np.abs(ids - exact).max() <= 0.5 + 1e-9


def test_without_constraints_the_programme_is_the_closed_form():
    batch = random_goals(np.random.default_rng(2))
    breakpoints = np.tile(uniform_breakpoints(41, 6), (3, 1))
    positions, errors, _ = fit_within(batch, breakpoints, Limits())
    expected, expected_errors = fit_rope(batch, 6)
    assert positions == pytest.approx(np.asarray(expected), abs=SINGLE)
    assert errors == pytest.approx(np.asarray(expected_errors), abs=SINGLE)


def test_constraints_reach_the_key_points():
    goal = goals.straight(ROPE)
    goal[:, 2] -= 0.01
    low = one(goal, 0.02)
    high = one(goal, 0.02, workspace=Workspace(above_table=True))
    assert low.positions[:, 2].max() < 0
    assert high.positions[:, 2] == pytest.approx(ROPE.radius, abs=EXACT)
    box = Workspace((-0.24, -1.0, -1.0), (0.24, 1.0, 1.0))
    assert np.abs(one(goal, 0.02, workspace=box).positions[:, 0]).max() <= 0.24 + EXACT
    bent = goals.polyline(ROPE, np.array([[0, 0], [0.3, 0], [0.3, 0.2]]))
    fixed = one(bent, workspace=Workspace(fixed_ends=True))
    assert fixed.positions[[0, -1]] == pytest.approx(bent[[0, -1]], abs=EXACT)
    short = one(1.1 * goal, 0.03, workspace=Workspace(max_stretch=0.0))
    assert np.ptp(short.positions[:, 0]) == pytest.approx(0.5, abs=2e-6)  # LENGTH_TOLERANCE


def test_failures_are_a_status_and_leave_the_others_alone():
    rng = np.random.default_rng(4)
    low = goals.straight(ROPE)
    low[0, 2] = -0.1
    bent = goals.polyline(ROPE, np.array([[0, 0], [0.25, 0], [0.25, 0.25]]))
    wild = rng.uniform(0.1, 0.5, size=(41, 3))
    workspace = Workspace(above_table=True, fixed_ends=True)
    models = simplify_uniform(ROPE, np.stack([bent, low, wild, bent]), workspace=workspace)
    assert [model.status for model in models] == [
        FitStatus.FITS,
        FitStatus.INFEASIBLE,
        FitStatus.NO_FIT,
        FitStatus.FITS,
    ]
    assert len(models[1]) == 0
    assert models[2].sizes == tuple(range(2, 21))
    assert not any(model.certified for model in models)
    alone = one(bent, workspace=workspace)
    for model in (models[0], models[3]):
        assert model.particles.tolist() == alone.particles.tolist() == [0, 20, 40]
        assert model.positions == pytest.approx(alone.positions, abs=EXACT)


@given(seed=seeds)
def test_models_of_a_batch_are_those_of_its_goals(seed):
    batch = 3 * random_goals(np.random.default_rng(seed))
    for goal, model in zip(batch, simplify_uniform(ROPE, batch, max_size=6), strict=True):
        alone = one(goal, max_size=6)
        assert model.sizes == alone.sizes
        assert model.particles.tolist() == alone.particles.tolist()
        assert model.positions == pytest.approx(alone.positions, abs=10 * SINGLE)
        assert model.errors == pytest.approx(alone.errors, abs=SINGLE)


def test_nothing_recompiles_for_a_new_batch_of_the_same_shape():
    fit_rope.clear_cache()
    for seed in (5, 6):
        batch = random_goals(np.random.default_rng(seed), batch=4)
        simplify_uniform(ROPE, batch, 1e-9, 4)
    simplify_uniform(ROPE, batch[:3], 1e-9, 4)
    assert fit_rope._cache_size() == 3  # sizes 2, 3 and 4


def test_no_fit_names_the_best_error_the_tolerance_and_the_remedy():
    goal = random_goals(np.random.default_rng(4), batch=1)[0]
    message = r"up to 3 key points .* tolerance of 1e-09 m: .* off by 0\.\d+ m; raise tolerance"
    with pytest.raises(ValueError, match=message):
        simplify(ROPE, goal, method="paper", tolerance=1e-9, max_size=3)


def test_more_key_points_than_particles_are_never_tried():
    small = bodies.rope(num_particles=4, length=0.3)
    goal = 0.1 * np.random.default_rng(5).normal(size=(4, 3))
    (points,) = simplify_uniform(small, goal[None], 1e-3, 50)
    assert points.particles.tolist() == [0, 1, 2, 3]


def test_the_entry_takes_a_rope():
    goal = goals.straight(ROPE)
    assert simplify(ROPE, goal, method="paper").method == "uniform breakpoints"
    assert simplify(ROPE, goal).method == "optimal breakpoints"
    assert simplify(ROPE, goal, tolerance=0.1, max_size=2).tolerance == 0.1
    assert [len(each) for each in simplify_batch(ROPE, goal[None])] == [2]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tolerance": 0.0}, r"tolerance is 0.0; give a number from 1e-09 to 5 m"),
        ({"tolerance": float("nan")}, "tolerance is nan"),
        ({"max_size": 1}, "max_size is 1; give a whole number of at least 2"),
    ],
)
def test_bad_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        one(goals.straight(ROPE), **options)


def test_bad_arguments_are_refused():
    cloth = bodies.cloth((3, 3))
    with pytest.raises(ValueError, match=r"8 triangles; give a rope"):
        simplify_uniform(cloth, goals.flat(cloth)[None])
    goal = goals.straight(ROPE)
    goal[7] = np.nan
    with pytest.raises(ValueError, match=r"particle 7 is .* finite"):
        simplify(ROPE, goal)
    with pytest.raises(ValueError, match=r"the goal has shape \(40, 3\)"):
        simplify(ROPE, goals.straight(ROPE)[:40])
    with pytest.raises(ValueError, match="method is 'best'; choose from robust"):
        simplify(ROPE, goals.straight(ROPE), method="best")
    with pytest.raises(ValueError, match="size is 42; a rope of 41 particles has 2 to 41"):
        interpolation_matrix(41, 42)
