import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from jaxsimp import bodies
from jaxsimp.simplification.qp import SolverStatus
from jaxsimp.simplification.ropes import fit as rope_fit
from jaxsimp.simplification.ropes.fit import (
    Limits,
    Workspace,
    feasible,
    fit_free,
    fit_within,
    hat_weights,
    limits_of,
)

ROPE = bodies.rope(length=1.0)  # 41 particles
DOUBLE = 1e-12
EXACT = 1e-7  # metres: ProxQP stops at residuals of 1e-10
LONG = 2e-6  # metres: `LENGTH_TOLERANCE`, and room

seeds = st.integers(0, 2**32 - 1)
SIZES = st.sampled_from([2, 3, 5, 8])


def random_goals(rng, batch=3):
    """Smooth ropes with noise, some of them longer than they are at rest."""
    turns = np.cumsum(rng.normal(scale=0.6, size=(batch, 40, 3)), axis=1)
    steps = turns / np.linalg.norm(turns, axis=2, keepdims=True) * rng.uniform(0.8, 1.3) / 40
    goals = np.cumsum(np.concatenate([np.zeros((batch, 1, 3)), steps], axis=1), axis=1)
    return goals + rng.normal(scale=0.003, size=goals.shape)


def random_breakpoints(rng, size, batch=3):
    inner = [np.sort(rng.choice(np.arange(1, 40), size - 2, replace=False)) for _ in range(batch)]
    return np.array([[0, *each, 40] for each in inner])


def error_of(goal, breakpoints, positions):
    fitted = hat_weights(len(goal), breakpoints[None])[0] @ positions
    return np.sqrt(np.sum((fitted - goal) ** 2) / len(goal))


@given(seed=seeds, size=SIZES, whole=st.booleans())
def test_weights_match_numpy_interp(seed, size, whole):
    rng = np.random.default_rng(seed)
    breakpoints = random_breakpoints(rng, size).astype(float)
    if not whole:
        breakpoints[:, 1:-1] += rng.uniform(-0.4, 0.4, size=(3, size - 2))
    for W, knots in zip(hat_weights(41, breakpoints), breakpoints, strict=True):
        expected = [np.interp(np.arange(41), knots, row) for row in np.eye(size)]
        assert np.allclose(W.T, expected, rtol=0.0, atol=DOUBLE)


@given(seed=seeds, size=SIZES)
def test_free_fits_are_least_squares_anywhere_in_space(seed, size):
    rng = np.random.default_rng(seed)
    goals, breakpoints = random_goals(rng), random_breakpoints(rng, size)
    far = np.array([10.0, -10.0, 10.0])
    positions, moved = fit_free(goals, breakpoints), fit_free(goals + far, breakpoints)
    for goal, knots, q in zip(goals, breakpoints, positions, strict=True):
        expected, *_ = np.linalg.lstsq(hat_weights(41, knots[None])[0], goal, rcond=None)
        assert q == pytest.approx(expected, abs=DOUBLE)
    assert moved - far == pytest.approx(positions, abs=10 * DOUBLE)


@given(seed=seeds, size=SIZES)
def test_without_limits_the_programme_is_least_squares(seed, size):
    rng = np.random.default_rng(seed)
    goals, breakpoints = random_goals(rng), random_breakpoints(rng, size)
    assert Limits().is_free
    positions, errors, status = fit_within(goals, breakpoints, Limits())
    assert (status == SolverStatus.SOLVED).all()
    assert positions == pytest.approx(fit_free(goals, breakpoints), abs=EXACT)
    each = zip(goals, breakpoints, positions, strict=True)
    assert errors == pytest.approx([error_of(*one) for one in each], abs=DOUBLE)


@given(seed=seeds, size=SIZES)
def test_a_box_is_kept_and_costs_something(seed, size):
    rng = np.random.default_rng(seed)
    goals, breakpoints = random_goals(rng), random_breakpoints(rng, size)
    lower, upper = np.array([-0.02, -np.inf, 0.004]), np.array([0.02, 0.03, np.inf])
    positions, errors, status = fit_within(goals, breakpoints, Limits(lower, upper))
    assert (status == SolverStatus.SOLVED).all()
    assert (positions >= lower - EXACT).all()
    assert (positions <= upper + EXACT).all()
    free = fit_within(goals, breakpoints, Limits())[1]
    assert (errors >= free - EXACT).all()
    # No nearby point of the box is better: the programme is convex, so none is.
    for _ in range(20):
        other = np.clip(positions + rng.normal(scale=1e-3, size=positions.shape), lower, upper)
        for goal, knots, q, error in zip(goals, breakpoints, other, errors, strict=True):
            assert error_of(goal, knots, q) >= error - EXACT


@pytest.mark.parametrize("backend", ["closed_form", "proxsuite", "qpsolvers"])
@pytest.mark.usefixtures("x64")
def test_fixed_ends_are_kept_and_backends_agree(backend):
    rng = np.random.default_rng(1)
    goals, breakpoints = random_goals(rng), random_breakpoints(rng, 5)
    limits = Limits(fixed_ends=True)
    positions, errors, status = fit_within(goals, breakpoints, limits, backend)
    assert (status == SolverStatus.SOLVED).all()
    assert positions[:, [0, -1]] == pytest.approx(goals[:, [0, -1]], abs=EXACT)
    # Oracle: least squares for the inner breakpoints, the ends' share taken off.
    for W, goal, q, error in zip(
        hat_weights(41, breakpoints), goals, positions, errors, strict=True
    ):
        rest = goal - W[:, [0, -1]] @ goal[[0, -1]]
        inner, *_ = np.linalg.lstsq(W[:, 1:-1], rest, rcond=None)
        assert q[1:-1] == pytest.approx(inner, abs=EXACT)
        expected = np.sqrt(np.sum((W[:, 1:-1] @ inner - rest) ** 2) / 41)
        assert error == pytest.approx(expected, abs=EXACT)


# SciPy before 1.16: SLSQP leaves bounds by rounding, and clips.
@pytest.mark.filterwarnings("ignore:Values in x were outside bounds:RuntimeWarning")
@given(
    seed=seeds,
    size=st.sampled_from([2, 4, 6]),
    workspace=st.sampled_from(
        [
            Workspace(max_stretch=0.0),
            Workspace(max_stretch=0.05, fixed_ends=True),
            Workspace((-0.1, -0.1, -0.1), (0.2, 0.2, 0.2), max_stretch=0.0),
        ]
    ),
)
@settings(max_examples=15)
def test_lengths_are_kept_and_the_fit_is_that_of_a_nonlinear_solver(seed, size, workspace):
    rng = np.random.default_rng(seed)
    goals, breakpoints = random_goals(rng, 2), random_breakpoints(rng, size, 2)
    limits = limits_of(ROPE, workspace)
    positions, errors, status = fit_within(goals, breakpoints, limits)
    possible = feasible(goals, limits)
    assert (status[possible] == SolverStatus.SOLVED).all()
    assert (status[~possible] == SolverStatus.INFEASIBLE).all()
    for index in np.flatnonzero(possible):
        longest = np.diff(limits.reach[breakpoints[index]])
        lengths = np.linalg.norm(np.diff(positions[index], axis=0), axis=1)
        assert (lengths <= longest + LONG).all()
        expected = slsqp(goals[index], breakpoints[index], longest, limits, positions[index], rng)
        # SLSQP stops at 1e-12 of the squared error; the minimum is flat.
        assert errors[index] <= expected + 1e-5
        assert errors[index] >= expected - 1e-4


def slsqp(goal, breakpoints, longest, limits, near, rng):
    """Error of the best fit found by sequential quadratic programming with |v|² <= L²."""
    W, size = hat_weights(41, breakpoints[None])[0], len(breakpoints)

    def residual(x):
        return W @ x.reshape(size, 3) - goal

    def room(x):
        return longest**2 - np.sum(np.diff(x.reshape(size, 3), axis=0) ** 2, axis=1)

    constraints = [{"type": "ineq", "fun": room}]
    if limits.fixed_ends:
        ends = goal[[0, -1]].ravel()
        constraints.append({"type": "eq", "fun": lambda x: np.concatenate([x[:3], x[-3:]]) - ends})
    found = minimize(
        lambda x: np.sum(residual(x) ** 2),
        (near + rng.normal(scale=0.01, size=near.shape)).ravel(),
        jac=lambda x: 2 * (W.T @ residual(x)).ravel(),
        bounds=list(zip(np.tile(limits.lower, size), np.tile(limits.upper, size), strict=True)),
        constraints=constraints,
        method="SLSQP",
        options={"ftol": 1e-12, "maxiter": 300},
    )
    return np.sqrt(found.fun / len(goal))


def test_rounds_go_on_until_directions_stay(monkeypatch):
    rng = np.random.default_rng(5)
    goals, breakpoints = random_goals(rng, 30), random_breakpoints(rng, 6, 30)
    limits = limits_of(ROPE, Workspace(max_stretch=0.0))
    positions = fit_within(goals, breakpoints, limits)[0]
    monkeypatch.setattr(rope_fit, "LENGTH_TOLERANCE", 1e-8)
    finer = fit_within(goals, breakpoints, limits)[0]
    # Newton's last step is far below the tolerance of 1e-6 that ends it.
    assert positions == pytest.approx(finer, abs=1e-5)


def test_a_fit_that_a_stiffness_held_is_not_settled_though_it_is_short():
    turned, longest = np.array([[[0.5, 0.01, 0.0]]]), np.ones((1, 1))
    for stiffness, expected in ((1.0, True), (0.0, False)):
        cuts = rope_fit._Cuts(np.array([[[1.0, 0.0, 0.0]]]), longest, np.full((1, 1), stiffness))
        assert rope_fit._unsettled(turned, longest, cuts).tolist() == [expected]


def test_a_length_that_does_not_bind_changes_nothing():
    rng = np.random.default_rng(2)
    goals, breakpoints = random_goals(rng), random_breakpoints(rng, 5)
    limits = limits_of(ROPE, Workspace(max_stretch=3.0))
    positions, _, _ = fit_within(goals, breakpoints, limits)
    assert positions == pytest.approx(fit_free(goals, breakpoints), abs=EXACT)


def test_a_rope_pulled_to_three_times_its_length_is_laid_straight_at_its_own():
    goal = np.linspace([-1.5, 0, 0], [1.5, 0, 0], 41) + np.array([0, 0, 0.1])
    limits = limits_of(ROPE, Workspace(max_stretch=0.0))
    positions, _, status = fit_within(goal[None], np.array([[0, 10, 25, 40]]), limits)
    assert status.tolist() == [SolverStatus.SOLVED]
    expected = np.array([[-0.5, 0, 0.1], [-0.25, 0, 0.1], [0.125, 0, 0.1], [0.5, 0, 0.1]])
    assert positions[0] == pytest.approx(expected, abs=LONG)


def test_an_infeasible_goal_is_a_status_and_leaves_the_others_alone():
    rng = np.random.default_rng(3)
    goals, breakpoints = random_goals(rng), random_breakpoints(rng, 4)
    goals[:, :, 2] = 0.1 + 0.01 * goals[:, :, 2]
    goals[1, 0, 2] = -0.05  # an end below the table
    limits = limits_of(ROPE, Workspace(above_table=True, fixed_ends=True, max_stretch=0.3))
    positions, errors, status = fit_within(goals, breakpoints, limits)
    assert feasible(goals, limits).tolist() == [True, False, True]
    assert status.tolist() == [SolverStatus.SOLVED, SolverStatus.INFEASIBLE, SolverStatus.SOLVED]
    assert np.isnan(positions[1]).all()
    assert errors[1] == np.inf
    alone, *_ = fit_within(goals[2:], breakpoints[2:], limits)
    assert positions[2] == pytest.approx(alone[0], abs=EXACT)


def test_nothing_is_feasible_in_an_empty_box_nor_between_ends_too_far_apart():
    goals = np.linspace([[0, 0, 0.1]], [[1.04, 0, 0.1]], 41, axis=1)
    low = limits_of(ROPE, Workspace(upper=(1.0, 1.0, 0.001), above_table=True))
    assert not feasible(goals, low).any()
    for stretch, expected in ((0.05, True), (0.03, False), (None, True)):
        limits = limits_of(ROPE, Workspace(fixed_ends=True, max_stretch=stretch))
        assert feasible(goals, limits).tolist() == [expected]
        # What is called feasible is, with any number of breakpoints.
        for size in (2, 5):
            status = fit_within(goals, np.linspace(0, 40, size)[None], limits)[2]
            assert (status == SolverStatus.SOLVED).tolist() == [expected]


def test_a_fit_that_does_not_settle_is_a_status(monkeypatch):
    monkeypatch.setattr(rope_fit, "MAX_ROUNDS", 2)
    rng = np.random.default_rng(4)
    goals, breakpoints = 3 * random_goals(rng), random_breakpoints(rng, 5)
    positions, errors, status = fit_within(
        goals, breakpoints, limits_of(ROPE, Workspace(max_stretch=0.0))
    )
    assert (status == SolverStatus.NOT_CONVERGED).all()
    assert np.isnan(positions).all()
    assert np.isinf(errors).all()


def test_wrong_workspaces_are_refused():
    with pytest.raises(ValueError, match=r"from \(0\.0, 0\.0, 1\.0\) to .* an upper bound above"):
        Workspace(lower=(0.0, 0.0, 1.0), upper=(1.0, 1.0, 0.0))
    with pytest.raises(
        ValueError, match=r"lower is \(nan, 0\.0, 0\.0\); give x, y and z in metres"
    ):
        Workspace(lower=(float("nan"), 0.0, 0.0))
    with pytest.raises(
        ValueError, match=r"max_stretch is -0\.1; give a number from 0 to 10 of the"
    ):
        Workspace(max_stretch=-0.1)
    assert not limits_of(ROPE, Workspace(above_table=True)).is_free
    assert limits_of(ROPE, Workspace()).is_free
