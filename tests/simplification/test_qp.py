import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog, minimize

from jaxsimp.simplification.qp import BACKENDS, QuadraticProgram, SolverStatus, closed_form, solve

# ProxQP stops at residuals of 1e-10; the problems below are conditioned to about 1e3.
EXACT = 1e-6
# JAX works in float32 unless told otherwise: 1e-7 by the same condition, and some room.
SINGLE = 2e-3

seeds = st.integers(0, 2**32 - 1)


def random_problem(rng, batch=3, size=4, num_equal=0, box=None):
    roots = rng.normal(size=(batch, size, size))
    bounds = {}
    if box is not None:
        middle = rng.normal(size=(batch, size))
        bounds = {"lower": middle - box, "upper": middle + box}
    return QuadraticProgram(
        H=roots @ np.swapaxes(roots, 1, 2) + 0.1 * np.eye(size),
        g=rng.normal(size=(batch, size)),
        A=rng.normal(size=(batch, num_equal, size)) if num_equal else None,
        b=rng.normal(size=(batch, num_equal)) if num_equal else None,
        **bounds,
    )


def one(H, g, **constraints):
    return QuadraticProgram(
        np.array([H], dtype=float),
        np.array([g], dtype=float),
        **{name: np.array([value], dtype=float) for name, value in constraints.items()},
    )


def feasible(problem, index):
    """Whether a linear solver finds any point within the constraints."""
    size = problem.g.shape[1]
    none = np.full(size, np.inf)
    lower = -none if problem.lower is None else problem.lower[index]
    upper = none if problem.upper is None else problem.upper[index]
    equal = {} if problem.A is None else {"A_eq": problem.A[index], "b_eq": problem.b[index]}
    if (lower > upper).any():
        return False
    return linprog(np.zeros(size), bounds=np.stack([lower, upper], axis=1), **equal).status == 0


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.usefixtures("x64")
@given(seed=seeds)
def test_least_squares_matches_numpy(backend, seed):
    rng = np.random.default_rng(seed)
    M, y = rng.normal(size=(3, 8, 4)), rng.normal(size=(3, 8))
    gradient = -np.einsum("bij,bi->bj", M, y)
    solution = solve(QuadraticProgram(np.swapaxes(M, 1, 2) @ M, gradient), backend)
    expected = [np.linalg.lstsq(m, v, rcond=None)[0] for m, v in zip(M, y, strict=True)]
    assert solution.solved.all()
    assert solution.x == pytest.approx(np.array(expected), abs=EXACT)


@pytest.mark.usefixtures("x64")
@given(seed=seeds, num_equal=st.integers(0, 3))
def test_backends_agree_on_equality_constraints(seed, num_equal):
    problem = random_problem(np.random.default_rng(seed), num_equal=num_equal)
    solutions = [solve(problem, backend) for backend in BACKENDS]
    assert all(solution.solved.all() for solution in solutions)
    size = np.abs(solutions[1].x).max() + 1
    for solution in solutions:
        assert solution.x == pytest.approx(solutions[1].x, abs=EXACT * size * 10)
        if num_equal:
            reached = np.einsum("bmn,bn->bm", problem.A, solution.x)
            assert reached == pytest.approx(problem.b, abs=EXACT * size)


@given(seed=seeds, num_equal=st.integers(0, 1))
def test_box_solutions_satisfy_the_optimality_conditions(seed, num_equal):
    problem = random_problem(np.random.default_rng(seed), num_equal=num_equal, box=2.0)
    solution = solve(problem)
    for index in np.flatnonzero(solution.solved):
        x, lower, upper = solution.x[index], problem.lower[index], problem.upper[index]
        slope = problem.H[index] @ x + problem.g[index]
        free = (x > lower + EXACT) & (x < upper - EXACT)
        if num_equal and free.any():
            row = problem.A[index][0]
            slope = slope - row * (slope[free] @ row[free]) / (row[free] @ row[free])
        assert (x >= lower - EXACT).all()
        assert (x <= upper + EXACT).all()
        if free.any() or not num_equal:
            tolerance = 1e-4  # the multiplier is divided by a row that may be short
            assert slope[free] == pytest.approx(0.0, abs=tolerance)
            assert (slope[x <= lower + EXACT] >= -tolerance).all()
            assert (slope[x >= upper - EXACT] <= tolerance).all()
    assert [s == SolverStatus.SOLVED for s in solution.status] == [
        feasible(problem, i) for i in range(3)
    ]


@given(seed=seeds)
def test_proxsuite_matches_qpsolvers_and_a_loop(seed):
    problem = random_problem(np.random.default_rng(seed), num_equal=1, box=2.0)
    batch, reference = solve(problem), solve(problem, "qpsolvers")
    assert batch.status.tolist() == reference.status.tolist()
    assert batch.x == pytest.approx(reference.x, abs=EXACT, nan_ok=True)
    for i in range(len(problem)):
        names = ("H", "g", "A", "b", "lower", "upper")
        alone = solve(QuadraticProgram(*(getattr(problem, name)[i : i + 1] for name in names)))
        assert alone.status[0] == batch.status[i]
        assert alone.x[0] == pytest.approx(batch.x[i], abs=EXACT, nan_ok=True)


@given(seed=seeds)
@settings(max_examples=10)
def test_float32_is_close_to_float64(seed):
    problem = random_problem(np.random.default_rng(seed), num_equal=1)
    single, double = solve(problem, "closed_form"), solve(problem)
    assert single.solved.all()
    size = np.abs(double.x).max() + 1
    assert single.x == pytest.approx(double.x, abs=SINGLE * size)


def slab_problem(rng, batch=3, size=4, count=5):
    """Random problems with inequalities on both sides, on one, and on none."""
    free = random_problem(rng, batch, size)
    C = rng.normal(size=(batch, count, size))
    # Around the values of C at a random point, so that there is room.
    middle = np.einsum("bkn,bn->bk", C, rng.normal(size=(batch, size)))
    half = rng.uniform(0.05, 1.0, size=(batch, count))
    lower, upper = middle - half, middle + half
    lower[:, 0], upper[:, 1] = -np.inf, np.inf
    lower[:, 2], upper[:, 2] = -np.inf, np.inf
    return QuadraticProgram(free.H, free.g, C=C, C_lower=lower, C_upper=upper)


@pytest.mark.parametrize("backend", ["proxsuite", "qpsolvers"])
@given(seed=seeds)
def test_inequalities_satisfy_the_optimality_conditions(backend, seed):
    problem = slab_problem(np.random.default_rng(seed))
    solution = solve(problem, backend)
    assert solution.solved.all()
    x, z = solution.x, solution.multipliers
    reached = np.einsum("bkn,bn->bk", problem.C, x)
    slope = np.einsum("bmn,bn->bm", problem.H, x) + problem.g
    tolerance = EXACT * (1 + np.abs(z).max())
    assert np.einsum("bkn,bk->bn", problem.C, z) == pytest.approx(-slope, abs=10 * tolerance)
    assert (reached <= problem.C_upper + EXACT).all()
    assert (reached >= problem.C_lower - EXACT).all()
    # A multiplier pulls back from the bound that is reached, and there is none elsewhere.
    assert (z[reached < problem.C_upper - EXACT] <= tolerance).all()
    assert (z[reached > problem.C_lower + EXACT] >= -tolerance).all()


@given(seed=seeds)
def test_inequalities_match_a_nonlinear_solver(seed):
    problem = slab_problem(np.random.default_rng(seed), batch=2)
    solution = solve(problem)
    for index in range(2):
        H, g, C = problem.H[index], problem.g[index], problem.C[index]
        rows = np.concatenate([C, -C])
        bounds = np.concatenate([problem.C_upper[index], -problem.C_lower[index]])
        rows, bounds = rows[np.isfinite(bounds)], bounds[np.isfinite(bounds)]
        found = minimize(
            lambda x, H=H, g=g: 0.5 * x @ H @ x + g @ x,
            np.zeros(4),
            jac=lambda x, H=H, g=g: H @ x + g,
            constraints={"type": "ineq", "fun": lambda x, A=rows, b=bounds: b - A @ x},
            method="SLSQP",
            options={"ftol": 1e-14, "maxiter": 500},
        )
        x = solution.x[index]
        # Both stop at about 1e-9 of the value; points differ by its root.
        assert 0.5 * x @ H @ x + g @ x == pytest.approx(found.fun, rel=1e-6, abs=1e-6)
        assert x == pytest.approx(found.x, abs=1e-3)


@pytest.mark.parametrize("backend", ["proxsuite", "qpsolvers"])
def test_inequalities_work_beside_a_box_and_equalities(backend):
    # The nearest point to (1, 1, 1) with x + y = 1, x <= 0.2 and y + z <= 1.
    problem = one(
        np.eye(3),
        [-1, -1, -1],
        A=[[1, 1, 0]],
        b=[1],
        upper=[0.2, 5, 5],
        C=[[0, 1, 1]],
        C_upper=[1],
    )
    solution = solve(problem, backend)
    assert solution.x[0] == pytest.approx([0.2, 0.8, 0.2], abs=EXACT)
    assert solution.multipliers[0] == pytest.approx([0.8], abs=EXACT)  # 1 - z


@pytest.mark.parametrize("backend", ["proxsuite", "qpsolvers"])
def test_contradictory_inequalities_do_not_disturb_their_neighbours(backend):
    rows = np.broadcast_to(np.array([[1.0, 1.0], [1.0, 1.0]]), (3, 2, 2))
    problem = QuadraticProgram(
        H=np.broadcast_to(np.eye(2), (3, 2, 2)),
        g=np.zeros((3, 2)),
        C=rows,
        C_lower=np.array([[1.0, -9.0], [1.0, -9.0], [1.0, -9.0]]),
        C_upper=np.array([[9.0, 9.0], [9.0, 0.0], [0.0, 9.0]]),  # the third crosses its own
    )
    solution = solve(problem, backend)
    solved, infeasible = SolverStatus.SOLVED, SolverStatus.INFEASIBLE
    assert solution.status.tolist() == [solved, infeasible, infeasible]
    assert solution.x[0] == pytest.approx([0.5, 0.5], abs=EXACT)


def test_a_box_that_holds_the_minimum_changes_nothing_and_one_that_does_not_clips_it():
    wide = solve(one(np.eye(2), [-1, -2], lower=[-5, -5], upper=[5, 5]))
    tight = solve(one(np.eye(2), [-1, -2], lower=[-5, -5], upper=[0.5, 5]))
    assert wide.x[0] == pytest.approx([1, 2], abs=EXACT)
    assert tight.x[0] == pytest.approx([0.5, 2], abs=EXACT)


@pytest.mark.parametrize("backend", ["proxsuite", "qpsolvers"])
def test_infeasible_problems_do_not_disturb_their_neighbours(backend):
    ones = np.ones((4, 1, 2))
    problem = QuadraticProgram(
        H=np.broadcast_to(np.eye(2), (4, 2, 2)),
        g=np.zeros((4, 2)),
        A=ones,
        b=np.array([[1.0], [9.0], [1.0], [-1.0]]),  # the second is out of the box's reach
        lower=np.array([[0.0, 0.0], [0.0, 0.0], [2.0, 0.0], [-1.0, -1.0]]),  # the third crosses
        upper=np.array([[1.0, 1.0], [1.0, 1.0], [1.0, 1.0], [1.0, 1.0]]),
    )
    solution = solve(problem, backend)
    solved, infeasible = SolverStatus.SOLVED, SolverStatus.INFEASIBLE
    assert solution.status.tolist() == [solved, infeasible, infeasible, solved]
    assert solution.x[[0, 3]] == pytest.approx(np.array([[0.5, 0.5], [-0.5, -0.5]]), abs=EXACT)
    assert np.isnan(solution.x[[1, 2]]).all()


@pytest.mark.parametrize("backend", BACKENDS)
def test_contradictory_equalities_are_a_status(backend):
    problem = one(np.eye(2), [0, 0], A=[[1, 1], [1, 1]], b=[0, 1])
    solution = solve(problem, backend)
    assert solution.status.tolist() == [SolverStatus.INFEASIBLE]
    assert np.isnan(solution.x).all()


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_problem_without_a_lower_bound_is_a_status(backend):
    solution = solve(one(np.diag([1, 0]), [0, 1]), backend)
    assert solution.status.tolist() == [SolverStatus.NOT_CONVERGED]
    assert np.isnan(solution.x).all()


@pytest.mark.parametrize("backend", BACKENDS)
def test_singular_matrices_and_repeated_constraints_are_solved(backend):
    problem = one(np.diag([1, 0]), [-1, 0], A=[[0, 1], [0, 2]], b=[3, 6])
    solution = solve(problem, backend)
    assert solution.solved.all()
    assert solution.x[0] == pytest.approx([1, 3], abs=1e-5)  # float32 in the closed form


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_batch_of_none_is_solved(backend):
    solution = solve(QuadraticProgram(np.zeros((0, 2, 2)), np.zeros((0, 2))), backend)
    assert solution.x.shape == (0, 2)
    assert solution.status.shape == (0,)


@pytest.mark.usefixtures("x64")
def test_closed_form_compiles_once_for_a_shape():
    closed_form.clear_cache()
    for value in (1.0, 2.0):
        closed_form(
            jnp.eye(2)[None], jnp.full((1, 2), value), jnp.zeros((1, 0, 2)), jnp.zeros((1, 0))
        )
    assert closed_form._cache_size() == 1


def test_closed_form_refuses_inequalities_by_name():
    with pytest.raises(ValueError, match=r"'closed_form' has no inequalities.* 'proxsuite'"):
        solve(one(np.eye(1), [0], lower=[0]), "closed_form")
    with pytest.raises(ValueError, match=r"'closed_form' has no inequalities"):
        solve(one(np.eye(1), [0], C=[[1]], C_upper=[1]), "closed_form")


def test_unknown_backends_are_refused():
    with pytest.raises(ValueError, match=r"backend is 'magic'; choose one of closed_form"):
        solve(one(np.eye(1), [0]), "magic")


def test_bad_numbers_are_refused():
    with pytest.raises(ValueError, match="g of problem 0 is not finite"):
        one(np.eye(1), [np.nan])
    with pytest.raises(ValueError, match="lower of problem 0 is not finite"):
        one(np.eye(1), [0], lower=[np.nan])
    with pytest.raises(ValueError, match="H of problem 0 is not symmetric"):
        one([[1, 1], [0, 1]], [0, 0])
    with pytest.raises(ValueError, match=r"eigenvalue -1; .* positive semidefinite"):
        one(np.diag([1, -1]), [0, 0])
    with pytest.raises(ValueError, match="give both or neither"):
        one(np.eye(1), [0], A=[[1]])
    for wrong in ({"C": [[1]]}, {"C_upper": [1]}):
        with pytest.raises(ValueError, match="C or its bounds are missing"):
            one(np.eye(1), [0], **wrong)
    with pytest.raises(ValueError, match="C_upper of problem 0 is not finite"):
        one(np.eye(1), [0], C=[[1]], C_upper=[np.nan])


@pytest.mark.usefixtures("unchecked_shapes")
def test_wrong_shapes_are_refused():
    with pytest.raises(ValueError, match=r"H has shape \(1, 3, 3\); give shape \(1, 2, 2\)"):
        one(np.eye(3), [0, 0])
    with pytest.raises(ValueError, match=r"upper has shape \(1, 1\); give shape \(1, 2\)"):
        one(np.eye(2), [0, 0], upper=[1])
