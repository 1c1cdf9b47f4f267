"""Ropes: the best positions of given breakpoints, free or in a workspace (equation 3).

A fit is p ≈ W q, with the hat functions of the breakpoints in W: least squares without a
workspace, a quadratic programme in q with one.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsimp.bodies import Body
from jaxsimp.checks import as_reals, require_number, told
from jaxsimp.simplification import qp

Bound = tuple[float, float, float]


@dataclass(frozen=True)
class Workspace:
    """Limits on the model of a rope.

    Attributes:
        lower: lowest x, y, z, metres.
        upper: highest x, y, z, metres.
        above_table: keep the model at least the rope's radius above z = 0.
        fixed_ends: keep the model's ends at the ends of the goal.
        max_stretch: largest elongation of a segment, relative to its rest length; None for no
            limit. Least squares alone stretch a segment by up to a quarter. With fixed ends
            allow some, such as 0.05: a taut goal with noise is longer than the rope.

    Raises:
        ValueError: if a bound is not three numbers or leaves no room, `lower` is above `upper`,
            `max_stretch` is no number from 0 to 10, or another limit is not true or false.
    """

    lower: Bound = (-np.inf,) * 3
    upper: Bound = (np.inf,) * 3
    above_table: bool = False
    fixed_ends: bool = False
    max_stretch: float | None = None

    def __post_init__(self) -> None:
        for name, never in (("lower", np.inf), ("upper", -np.inf)):
            bound = as_reals(getattr(self, name))
            if bound is None or bound.shape != (3,) or np.any(np.isnan(bound) | (bound == never)):
                raise ValueError(
                    f"{name} is {told(getattr(self, name))}; give x, y and z in metres, -inf or "
                    f"inf for no limit"
                )
        for name in ("above_table", "fixed_ends"):
            if not isinstance(getattr(self, name), bool):
                raise ValueError(f"{name} is {told(getattr(self, name))}; give True or False")
        if not np.all(np.less_equal(self.lower, self.upper)):
            raise ValueError(
                f"the workspace is from {self.lower} to {self.upper}; give an upper bound above "
                f"the lower one on each axis"
            )
        if self.max_stretch is not None:
            require_number("max_stretch", self.max_stretch, 0.0, 10.0, "of the rest length")


@dataclass(frozen=True, eq=False)
class Limits:
    """The limits that a workspace sets for one rope.

    Attributes:
        lower: lowest x, y, z, shape (3,), metres.
        upper: highest x, y, z, shape (3,), metres.
        fixed_ends: whether the model's ends are the goal's.
        reach: largest length of the model from the first particle to each, shape (N,), metres;
            None for no limit.
    """

    lower: Float[np.ndarray, " 3"] = field(default_factory=lambda: np.full(3, -np.inf))
    upper: Float[np.ndarray, " 3"] = field(default_factory=lambda: np.full(3, np.inf))
    fixed_ends: bool = False
    reach: Float[np.ndarray, " N"] | None = None

    @property
    def is_free(self) -> bool:
        """Whether there is no limit."""
        boxed = np.isfinite([self.lower, self.upper]).any()
        return not (boxed or self.fixed_ends or self.reach is not None)


def limits_of(body: Body, workspace: Workspace) -> Limits:
    """The limits that a workspace sets for the model of this rope."""
    lower, upper = np.array([workspace.lower, workspace.upper], dtype=float)
    if workspace.above_table:
        lower[2] = max(lower[2], body.radius)
    reach = None
    if workspace.max_stretch is not None:
        steps = np.linalg.norm(np.diff(body.rest, axis=0), axis=1)
        reach = (1 + workspace.max_stretch) * np.concatenate([[0.0], np.cumsum(steps)])
    return Limits(lower, upper, workspace.fixed_ends, reach)


def feasible(goals: Float[np.ndarray, "B N 3"], limits: Limits) -> Bool[np.ndarray, " B"]:
    """Whether any model of a goal is within the limits, shape (B,).

    The answer does not depend on the breakpoints: without fixed ends all of them may coincide;
    with fixed ends they may lie on the line between the ends, as far along it as along the rope.

    Args:
        goals: shape (B, N, 3), metres.
        limits: limits on the model.
    """
    possible = np.full(len(goals), (limits.lower <= limits.upper).all())
    if limits.fixed_ends:
        ends = goals[:, [0, -1]]
        possible &= ((ends >= limits.lower) & (ends <= limits.upper)).all(axis=(1, 2))
        if limits.reach is not None:
            possible &= np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) <= limits.reach[-1]
    return possible


def why_infeasible(body: Body, goal: Float[np.ndarray, "N 3"], workspace: Workspace) -> str:
    """Message for a goal that is not `feasible`: the limit that excludes a model, and a remedy.

    Args:
        body: a rope.
        goal: shape (N, 3), metres.
        workspace: limits on the model.
    """
    limits = limits_of(body, workspace)
    if (limits.lower > limits.upper).any():
        return (
            f"no model is within the workspace: it ends at z = {limits.upper[2]:.3g} m, and the "
            f"model keeps {limits.lower[2]:.3g} m above the table; raise upper, or leave "
            f"above_table out"
        )
    ends = goal[[0, -1]]
    outside = ((ends < limits.lower) | (ends > limits.upper)).any(axis=1)
    if outside.any():
        end, name = ends[outside.argmax()], ("first", "last")[outside.argmax()]
        return (
            f"no model of the goal is within the workspace: its {name} particle is at "
            f"{_metres(end)}, outside {_metres(limits.lower)} to {_metres(limits.upper)}; move "
            f"the goal, widen lower and upper, or leave fixed_ends out"
        )
    reach = np.inf if limits.reach is None else limits.reach[-1]
    return (
        f"no model of the goal is within the workspace: its ends are "
        f"{np.linalg.norm(ends[1] - ends[0]):.3g} m apart, and the model is {reach:.3g} m long at "
        f"most; raise max_stretch, or leave fixed_ends out"
    )


def _metres(point: Float[np.ndarray, " 3"]) -> str:
    return f"({', '.join(f'{value:.3g}' for value in point)}) m"


def hat_weights(
    num_particles: int, breakpoints: Float[np.ndarray, "B K"] | Int[np.ndarray, "B K"]
) -> Float[np.ndarray, "B N K"]:
    """Weights W of piecewise-linear interpolation: particles = W positions, shape (B, N, K).

    Args:
        num_particles: number of particles, `N`.
        breakpoints: ascending, in particles from 0 to N - 1, shape (B, K).
    """
    before, width = breakpoints[:, None, :-1], np.diff(breakpoints)[:, None]
    risen = np.clip((np.arange(num_particles)[None, :, None] - before) / width, 0.0, 1.0)
    edge = np.ones_like(risen[:, :, :1])
    return np.concatenate([edge, risen], axis=2) - np.concatenate([risen, 0.0 * edge], axis=2)


def fit_free(
    goals: Float[np.ndarray, "B N 3"], breakpoints: Int[np.ndarray, "B K"]
) -> Float[np.ndarray, "B K 3"]:
    """Best positions of breakpoints at particles, shape (B, K, 3), metres.

    With breakpoints at particles, W contains the rows of the unit matrix, so its normal matrix
    has no eigenvalue below one and is well conditioned to solve with.

    Args:
        goals: shape (B, N, 3), metres.
        breakpoints: ascending, from 0 to N - 1, shape (B, K).
    """
    W = hat_weights(goals.shape[1], breakpoints)
    Wt = np.swapaxes(W, 1, 2)
    centre = goals.mean(axis=1, keepdims=True)
    return np.linalg.solve(Wt @ W, Wt @ (goals - centre)) + centre


MAX_ROUNDS = 30  # a rope pulled to three times its length needs 10
LENGTH_TOLERANCE = 1e-6
"""Excess length allowed for a segment, relative to its largest length."""


class _Cuts(NamedTuple):
    """Largest lengths of segments along directions.

    Attributes:
        directions: unit vectors, shape (B, K - 1, 3).
        longest: largest lengths, shape (B, K - 1), metres.
        stiffness: stiffness against rotation away from the directions, shape (B, K - 1).
    """

    directions: np.ndarray
    longest: np.ndarray
    stiffness: np.ndarray


def fit_within(
    goals: Float[np.ndarray, "B N 3"],
    breakpoints: Float[np.ndarray, "B K"] | Int[np.ndarray, "B K"],
    limits: Limits,
    backend: str = "proxsuite",
) -> tuple[Float[np.ndarray, "B K 3"], Float[np.ndarray, " B"], Int[np.ndarray, " B"]]:
    """Best positions of breakpoints within limits, for a batch of goals (equation 3).

    Every point of a fit is between two breakpoints, so a box that holds the breakpoints holds
    the whole fit. Without a largest length the axes are independent, with one programme each.
    Each round replaces the largest length of a segment, |v| <= L, by d·v <= L along its direction
    d in the previous fit, until d no longer changes: the optimality conditions are then those of
    |v| <= L, and the fit is optimal. Newton's method needs few rounds: the multiplier z of the
    length adds a stiffness z / L against rotation away from d. Without that stiffness the rounds
    circle around the fit where a goal is much longer than the rope.

    Args:
        goals: shape (B, N, 3), metres.
        breakpoints: ascending, in particles from 0 to N - 1, shape (B, K).
        limits: limits on the model.
        backend: as for `qp.solve`.

    Returns:
        Positions of the breakpoints, shape (B, K, 3), root mean square distances between
        particles and fit, shape (B,), both in metres, and a `qp.SolverStatus` per goal, shape (B,).
        Where it is not `SOLVED` the positions are NaN and the distance is infinite.

    Raises:
        ValueError: if a number is not finite, or the backend cannot handle the limits.
    """
    W = hat_weights(goals.shape[1], breakpoints)
    status = np.where(feasible(goals, limits), qp.SolverStatus.SOLVED, qp.SolverStatus.INFEASIBLE)
    positions = np.full((len(goals), breakpoints.shape[1], 3), np.nan)
    todo = np.flatnonzero(status == qp.SolverStatus.SOLVED)
    longest = None
    if limits.reach is not None:
        longest = np.diff(np.interp(breakpoints, np.arange(goals.shape[1]), limits.reach))
    cuts: _Cuts | None = None
    for _ in range(MAX_ROUNDS):
        if not todo.size:
            break
        positions[todo], status[todo], held = _solve(goals[todo], W[todo], limits, cuts, backend)
        if longest is None:
            break
        segments = np.diff(positions[todo], axis=1)
        again = _unsettled(segments, longest[todo], cuts)
        todo, segments, held = todo[again], segments[again], held[again]
        lengths = np.linalg.norm(segments, axis=2, keepdims=True)
        directions = segments / np.maximum(lengths, np.finfo(float).tiny)
        cuts = _Cuts(directions, longest[todo], np.maximum(held, 0.0) / longest[todo])
    else:
        positions[todo], status[todo] = np.nan, qp.SolverStatus.NOT_CONVERGED
    squared = np.sum((W @ positions - goals) ** 2, axis=2)
    error = np.sqrt(squared.mean(axis=1))
    return positions, np.where(status == qp.SolverStatus.SOLVED, error, np.inf), status


def _solve(
    goals: np.ndarray,
    W: np.ndarray,
    limits: Limits,
    cuts: _Cuts | None,
    backend: str,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, status and multipliers of the segments' lengths, of one round of `fit_within`.

    Args:
        goals: shape (B, N, 3), metres.
        W: weights, shape (B, N, K).
        limits: limits on the model, without its length.
        cuts: limits on the segments' lengths.
        backend: as for `qp.solve`.

    Returns:
        Shapes (B, K, 3), NaN where not solved, (B,) and (B, K - 1).
    """
    batch, _, size = W.shape
    # One programme for each axis, or one for all three axes.
    coupled = cuts is not None
    num_programmes = batch if coupled else 3 * batch
    centre = goals.mean(axis=1, keepdims=True)
    centred = np.swapaxes(goals - centre, 1, 2).astype(float)

    def for_axes(matrices: np.ndarray) -> np.ndarray:
        return np.kron(np.eye(3), matrices) if coupled else np.repeat(matrices, 3, axis=0)

    def flat(vectors: np.ndarray) -> np.ndarray:
        return vectors.reshape(num_programmes, -1)

    def bound(limit: np.ndarray) -> np.ndarray | None:
        shifted = (limit - centre[:, 0])[:, :, None]
        return None if np.isinf(limit).all() else flat(np.repeat(shifted, size, axis=2))

    ends = np.broadcast_to(np.eye(size)[[0, -1]], (batch, 2, size))
    H = for_axes(np.swapaxes(W, 1, 2) @ W)
    problem = qp.QuadraticProgram(
        H=H if cuts is None else H + _turning(cuts),
        g=flat(-centred @ W),
        A=for_axes(ends) if limits.fixed_ends else None,
        b=flat(centred[:, :, [0, -1]]) if limits.fixed_ends else None,
        lower=bound(limits.lower),
        upper=bound(limits.upper),
        C=None if cuts is None else _components(cuts.directions[:, :, None])[:, :, 0],
        C_upper=None if cuts is None else cuts.longest,
    )
    solution = qp.solve(problem, backend)
    positions = np.swapaxes(solution.x.reshape(batch, 3, size), 1, 2) + centre
    # A goal is solved if all its programmes are, and infeasible if one of them is.
    status = solution.status.reshape(batch, -1)
    infeasible = (status == qp.SolverStatus.INFEASIBLE).any(axis=1)
    status = np.where(infeasible, qp.SolverStatus.INFEASIBLE, status.max(axis=1))
    solved = status == qp.SolverStatus.SOLVED
    held = np.zeros((batch, size - 1)) if cuts is None else solution.multipliers
    return np.where(solved[:, None, None], positions, np.nan), status, held


def _unsettled(
    segments: np.ndarray, longest: np.ndarray, cuts: _Cuts | None
) -> Bool[np.ndarray, " B"]:
    """Whether a fit has a segment that is too long, or that rotated against its stiffness."""
    room = LENGTH_TOLERANCE * longest
    # Comparisons with NaN are false: goals that are not solved are not tried again.
    wrong = np.linalg.norm(segments, axis=2) > longest + room
    if cuts is not None:
        along = np.sum(segments * cuts.directions, axis=2, keepdims=True)
        turned = np.linalg.norm(segments - along * cuts.directions, axis=2)
        wrong |= (cuts.stiffness > 0) & (turned > room)
    return wrong.any(axis=1)


def _turning(cuts: _Cuts) -> Float[np.ndarray, "B n n"]:
    """Hessian of the stiffness against rotation."""
    d = cuts.directions
    across = np.eye(3) - d[..., :, None] * d[..., None, :]
    rows = _components(across)
    # `across` is a projection, so it equals its square.
    return np.einsum("bjxm,bj,bjxn->bmn", rows, cuts.stiffness, rows)


def _components(vectors: Float[np.ndarray, "B J M 3"]) -> Float[np.ndarray, "B J M n"]:
    """Rows that map x, y, z of all breakpoints to components of segments along vectors.

    Args:
        vectors: M vectors for each of J = K - 1 segments, shape (B, J, M, 3).
    """
    batch, count, number, _ = vectors.shape
    differences = np.diff(np.eye(count + 1), axis=0)
    rows = np.einsum("bjma,jk->bjmak", vectors, differences)
    return rows.reshape(batch, count, number, -1)
