"""Batched convex quadratic programmes, and the backends that solve them.

A problem is: minimise ½ x'Hx + g'x subject to A x = b, lower <= x <= upper and
C_lower <= C x <= C_upper. A batch holds B problems of one shape. Each problem has a status; a
problem that fails does not stop the others.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxsimp.checks import require_shape


class SolverStatus(IntEnum):
    """Result of one problem; `NOT_CONVERGED` includes problems without a lower bound."""

    SOLVED = 0
    INFEASIBLE = 1
    NOT_CONVERGED = 2


@dataclass(frozen=True, eq=False)
class QuadraticProgram:
    """A batch of B problems with n unknowns, m equality and k inequality constraints.

    Attributes:
        H: symmetric positive semidefinite matrices, shape (B, n, n).
        g: linear terms, shape (B, n).
        A: equality constraints, shape (B, m, n), or None.
        b: right-hand sides, shape (B, m), or None; given exactly when `A` is.
        lower: lower bounds, shape (B, n), -inf where there is none, or None.
        upper: upper bounds, shape (B, n), inf where there is none, or None.
        C: inequality constraints, shape (B, k, n), or None.
        C_lower: lower bounds of C x, shape (B, k), -inf where there is none, or None.
        C_upper: upper bounds of C x, shape (B, k), inf where there is none, or None; one of
            the two is given exactly when `C` is.

    Raises:
        ValueError: if shapes disagree, a number is not finite where it must be, or an H is not
            convex. Contradictory constraints raise nothing: their status is `INFEASIBLE`.
    """

    H: Float[np.ndarray, "B n n"]
    g: Float[np.ndarray, "B n"]
    A: Float[np.ndarray, "B m n"] | None = None
    b: Float[np.ndarray, "B m"] | None = None
    lower: Float[np.ndarray, "B n"] | None = None
    upper: Float[np.ndarray, "B n"] | None = None
    C: Float[np.ndarray, "B k n"] | None = None
    C_lower: Float[np.ndarray, "B k"] | None = None
    C_upper: Float[np.ndarray, "B k"] | None = None

    def __post_init__(self) -> None:
        if (self.A is None) != (self.b is None):
            raise ValueError("one of A and b is missing; give both or neither")
        if (self.C is None) != (self.C_lower is None and self.C_upper is None):
            raise ValueError("C or its bounds are missing; give C and C_lower or C_upper, or none")
        _check_shapes(self)
        _check_numbers(self)
        _check_convex(self.H)

    def __len__(self) -> int:
        return len(self.g)


@dataclass(frozen=True, eq=False)
class Solution:
    """Minimisers of a batch.

    Attributes:
        x: minimisers, shape (B, n); NaN exactly in the rows that are not solved.
        status: `SolverStatus` of each problem, shape (B,).
        multipliers: Lagrange multipliers of the inequalities C x, shape (B, k): above zero where
            the upper bound is active, below zero where the lower one is; meaningless where not
            solved.
    """

    x: Float[np.ndarray, "B n"]
    status: Int[np.ndarray, " B"]
    multipliers: Float[np.ndarray, "B k"]

    @property
    def solved(self) -> np.ndarray:
        """True for the problems that are solved, shape (B,)."""
        return self.status == SolverStatus.SOLVED


def solve(problem: QuadraticProgram, backend: str = "proxsuite") -> Solution:
    """Solve every problem of a batch.

    Args:
        problem: the batch.
        backend: "closed_form" (JAX, equalities only), "proxsuite" (proximal augmented
            Lagrangian, Bambade et al. 2022) or "qpsolvers" (the same algorithm, one problem
            per call: a reference).

    Raises:
        ValueError: if the backend is unknown, or cannot handle the constraints.
    """
    if backend not in BACKENDS:
        raise ValueError(f"backend is {backend!r}; choose one of {', '.join(BACKENDS)}")
    solution = BACKENDS[backend](problem)
    status = np.where(_crossed(problem), SolverStatus.INFEASIBLE, solution.status)
    # ProxQP misses some contradictions, such as those of parallel rows with two bounds each.
    for index in np.flatnonzero(status == SolverStatus.NOT_CONVERGED).tolist():
        if _contradictory(problem, index):
            status[index] = SolverStatus.INFEASIBLE
    x = np.where((status == SolverStatus.SOLVED)[:, None], solution.x, np.nan)
    return Solution(x, status, solution.multipliers)


def _contradictory(problem: QuadraticProgram, index: int) -> bool:
    """Whether no point satisfies the constraints of one problem, by linear programming."""
    from scipy.optimize import linprog

    *_, A, b, C, C_lower, C_upper, lower, upper = next(_problems(problem, [index]))
    rows = {}
    if C is not None:
        h = np.concatenate([C_upper, -C_lower])
        rows = {"A_ub": np.concatenate([C, -C])[h < np.inf], "b_ub": h[h < np.inf]}
    bounds = np.stack([lower, upper], axis=1)
    return linprog(np.zeros(len(lower)), A_eq=A, b_eq=b, bounds=bounds, **rows).status == 2


def _closed_form(problem: QuadraticProgram) -> Solution:
    if any(each is not None for each in (problem.lower, problem.upper, problem.C)):
        raise ValueError(
            "the backend 'closed_form' has no inequalities; leave lower, upper and C out, or use "
            "the backend 'proxsuite'"
        )
    size = problem.g.shape[1]
    A = np.zeros((len(problem), 0, size)) if problem.A is None else problem.A
    b = np.zeros((len(problem), 0)) if problem.b is None else problem.b
    x, status = closed_form(*map(jnp.asarray, (problem.H, problem.g, A, b)))
    return Solution(np.asarray(x), np.asarray(status), np.zeros((len(problem), 0)))


@jax.jit
def closed_form(
    H: Float[Array, "B n n"],
    g: Float[Array, "B n"],
    A: Float[Array, "B m n"],
    b: Float[Array, "B m"],
) -> tuple[Float[Array, "B n"], Int[Array, " B"]]:
    """Minimisers without bounds, and their status, by the null-space method.

    Solves the KKT conditions with pseudo-inverses (Nocedal & Wright, "Numerical
    Optimization", section 16.2), so H may be singular and constraints may repeat each other.
    The residuals of the conditions decide the status; rows that are not solved are meaningless.

    Args:
        H: symmetric positive semidefinite, shape (B, n, n).
        g: shape (B, n).
        A: shape (B, m, n); m = 0 for none.
        b: shape (B, m).
    """
    return jax.vmap(_null_space_method)(H, g, A, b)


def _null_space_method(H: Array, g: Array, A: Array, b: Array) -> tuple[Array, Array]:
    tolerance = jnp.sqrt(jnp.finfo(H.dtype).eps)
    tangent = jnp.eye(len(g), dtype=H.dtype)
    start = jnp.zeros_like(g)
    if len(b):
        inverse = jnp.linalg.pinv(A)
        tangent = tangent - inverse @ A
        start = inverse @ b
    reduced = jnp.linalg.pinv(tangent @ H @ tangent, hermitian=True)
    x = start - tangent @ (reduced @ (tangent @ (H @ start + g)))
    slope = jnp.linalg.norm(tangent @ (H @ x + g))
    steep = slope > tolerance * (jnp.linalg.norm(H) * jnp.linalg.norm(x) + jnp.linalg.norm(g))
    gap = jnp.linalg.norm(A @ x - b)
    apart = gap > tolerance * (jnp.linalg.norm(A) * jnp.linalg.norm(x) + jnp.linalg.norm(b))
    failed = steep | ~jnp.isfinite(x).all()
    status = jnp.where(failed, int(SolverStatus.NOT_CONVERGED), int(SolverStatus.SOLVED))
    return x, jnp.where(apart, int(SolverStatus.INFEASIBLE), status)


def _proxsuite(problem: QuadraticProgram) -> Solution:
    from proxsuite import proxqp

    size, num_equal = problem.g.shape[1], 0 if problem.b is None else problem.b.shape[1]
    num_inequal = 0 if problem.C is None else problem.C.shape[1]
    batch = proxqp.dense.VectorQP()
    for H, g, A, b, C, C_lower, C_upper, lower, upper in _problems(problem):
        qp = proxqp.dense.QP(size, num_equal, num_inequal, True)
        for name, value in PROXQP_SETTINGS.items():
            setattr(qp.settings, name, value)
        qp.init(H, g, A, b, C, C_lower, C_upper, lower, upper)
        batch.append(qp)
    proxqp.dense.solve_in_parallel(batch)
    return Solution(
        np.array([qp.results.x for qp in batch]).reshape(-1, size),
        _statuses([qp.results.info.status for qp in batch]),
        np.array([qp.results.z for qp in batch]).reshape(-1, num_inequal + size)[:, :num_inequal],
    )


def _qpsolvers(problem: QuadraticProgram) -> Solution:
    import qpsolvers

    x, codes = np.zeros_like(problem.g), []
    multipliers = np.zeros((len(problem), 0 if problem.C is None else problem.C.shape[1]))
    for index, (H, g, A, b, C, C_lower, C_upper, lower, upper) in enumerate(_problems(problem)):
        G, h = None, None
        if C is not None:
            sides, h = np.concatenate([C, -C]), np.concatenate([C_upper, -C_lower])
            bounded = h < np.inf
            G, h = sides[bounded], h[bounded]
        one = qpsolvers.Problem(H, g, G, h, A, b, lower, upper)
        solution = qpsolvers.solve_problem(one, "proxqp", **PROXQP_SETTINGS)
        codes.append(solution.extras["info"].status)
        if solution.found:
            x[index] = solution.x
            if C is not None:
                z = np.zeros(len(sides))
                z[bounded] = solution.z
                multipliers[index] = z[: len(C)] - z[len(C) :]
    return Solution(x, _statuses(codes), multipliers)


def _statuses(codes: list) -> np.ndarray:
    """ProxQP's status codes as `SolverStatus`, shape (B,)."""
    from proxsuite import proxqp

    ours = {
        proxqp.QPSolverOutput.PROXQP_SOLVED: SolverStatus.SOLVED,
        proxqp.QPSolverOutput.PROXQP_PRIMAL_INFEASIBLE: SolverStatus.INFEASIBLE,
    }
    return np.array([ours.get(code, SolverStatus.NOT_CONVERGED) for code in codes], dtype=int)


def _problems(problem: QuadraticProgram, indices: Iterable[int] | None = None) -> Iterator[tuple]:
    """H, g, A, b, C and its bounds, lower and upper of some problems (by default all), float64.

    Crossed bounds become infinite: ProxQP iterates on them for seconds and does not report them
    as infeasible.
    """
    crossed = _crossed(problem)[:, None]
    lower, upper = _open_bounds(problem.lower, problem.upper, problem.g.shape, crossed)
    C_lower, C_upper = None, None
    if problem.C is not None:
        shape = problem.C.shape[:2]
        C_lower, C_upper = _open_bounds(problem.C_lower, problem.C_upper, shape, crossed)
    arrays = (problem.H, problem.g, problem.A, problem.b, problem.C, C_lower, C_upper, lower, upper)
    for index in range(len(problem)) if indices is None else indices:
        yield tuple(None if each is None else each[index].astype(float) for each in arrays)


def _open_bounds(
    lower: np.ndarray | None, upper: np.ndarray | None, shape: tuple[int, ...], away: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Both bounds as arrays, infinite where a bound is absent and in the problems `away`."""
    infinite = np.full(shape, np.inf)
    return (
        -infinite if lower is None else np.where(away, -np.inf, lower),
        infinite if upper is None else np.where(away, np.inf, upper),
    )


def _crossed(problem: QuadraticProgram) -> np.ndarray:
    """True for problems with a lower bound above its upper bound, shape (B,)."""
    crossed = np.zeros(len(problem), dtype=bool)
    for low, high in ((problem.lower, problem.upper), (problem.C_lower, problem.C_upper)):
        lower = np.array([[-np.inf]]) if low is None else low
        upper = np.array([[np.inf]]) if high is None else high
        empty = (lower > upper) | (lower == np.inf) | (upper == -np.inf)
        crossed |= empty.any(axis=1)
    return crossed


def _check_shapes(problem: QuadraticProgram) -> None:
    batch, size = problem.g.shape
    num_equal = 0 if problem.b is None else problem.b.shape[-1]
    num_inequal = 0 if problem.C is None else problem.C.shape[1]
    expected = {
        "H": (batch, size, size),
        "A": (batch, num_equal, size),
        "b": (batch, num_equal),
        "lower": (batch, size),
        "upper": (batch, size),
        "C": (batch, num_inequal, size),
        "C_lower": (batch, num_inequal),
        "C_upper": (batch, num_inequal),
    }
    for name, shape in expected.items():
        array = getattr(problem, name)
        if array is not None:
            require_shape(name, array, shape, f"as g has shape {problem.g.shape}")


def _check_numbers(problem: QuadraticProgram) -> None:
    for name in ("H", "g", "A", "b", "C", *BOUNDS):
        array = getattr(problem, name)
        if array is None:
            continue
        wrong = np.isnan(array) if name in BOUNDS else ~np.isfinite(array)
        if wrong.any():
            index = int(np.argwhere(wrong)[0, 0])
            raise ValueError(f"{name} of problem {index} is not finite; give finite numbers")


def _check_convex(H: np.ndarray) -> None:
    tolerance = np.sqrt(np.finfo(H.dtype).eps) * np.abs(H).max(axis=(1, 2), initial=0.0)
    skew = np.abs(H - np.swapaxes(H, 1, 2)).max(axis=(1, 2), initial=0.0) > tolerance
    if skew.any():
        raise ValueError(f"H of problem {skew.argmax()} is not symmetric; give (H + H') / 2")
    least = np.linalg.eigvalsh(H).min(axis=1, initial=np.inf)
    if (least < -tolerance).any():
        index = int((least < -tolerance).argmax())
        raise ValueError(
            f"H of problem {index} has the eigenvalue {least[index]:g}; a convex problem has "
            f"none below zero: give a positive semidefinite H"
        )


BOUNDS = ("lower", "upper", "C_lower", "C_upper")
Backend = Callable[[QuadraticProgram], Solution]
BACKENDS: dict[str, Backend] = {
    "closed_form": _closed_form,
    "proxsuite": _proxsuite,
    "qpsolvers": _qpsolvers,
}
# Absolute tolerances, since residuals are in metres; 1e-10 m is far below any goal's accuracy.
# Without the duality gap ProxQP accepts points that are 1e-6 off an active bound.
PROXQP_SETTINGS: dict[str, Any] = {
    "eps_abs": 1e-10,
    "eps_rel": 0.0,
    "check_duality_gap": True,
    "eps_duality_gap_abs": 1e-9,
    "eps_duality_gap_rel": 0.0,
    "max_iter": 500,
}
