"""Ropes: the smallest piecewise-linear fit of all, with the best particles as breakpoints.

Equation 3 of the paper without its evenly spread breakpoints. Dynamic programmes find good fits
of every size for a batch of goals, and lower bounds on the errors of all fits (search.py).
Branch and bound proves the remaining cases (branch.py). Least squares, or a quadratic programme
in a workspace, give the positions (fit.py).
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsimp.bodies import Body
from jaxsimp.simplification.key_points import SIZES_BEYOND, KeyPoints
from jaxsimp.simplification.ropes.fit import Workspace, feasible, fit_free, fit_within, limits_of
from jaxsimp.simplification.ropes.models import (
    NO_SIZE,
    check_ropes,
    errors_by_size,
    rope_models,
    with_infeasible,
)
from jaxsimp.simplification.ropes.search import (
    regression_gains,
    ruled_out,
    search_batch,
    segment_stiffness,
)

NODE_LIMIT = 1_000_000
"""Largest number of chains evaluated for one goal and size: about 10 ms."""


def simplify_optimal(
    body: Body,
    goals: Float[np.ndarray, "B N 3"],
    tolerance: float | None = None,
    max_size: int | None = None,
    *,
    workspace: Workspace | None = None,
    node_limit: int = NODE_LIMIT,
) -> list[KeyPoints]:
    """Key points of ropes: the fewest breakpoints at particles that fit the goal, the best ones.

    The error of a fit is the root mean square distance between particles and fit, sqrt(E / N)
    of equation 3. Where a model is certified, no choice of fewer particles as breakpoints has a
    fit below the tolerance, and no other choice of as many has a better one. Errors of other
    sizes are those of good fits, which may not be optimal.

    In a workspace, breakpoints are those of the best free fits, and positions and errors are
    within the constraints. A certified model then means that no fit with fewer breakpoints, free
    or not, is below the tolerance.

    Args:
        body: a rope.
        goals: goal positions, shape (B, N, 3), metres.
        tolerance: error below which a fit is accepted, metres; 0.015 of the rope's length
            by default.
        max_size: largest number of key points tried, 12 by default; at most N.
        workspace: limits on the model; none by default.
        node_limit: largest number of chains that branch and bound evaluates for one goal and size.
            Where more are needed, the model is the best found, and not certified.

    Returns:
        One model per goal: the last one tried where none fits.

    Raises:
        ValueError: if the body has triangles, a goal does not fit the body, the tolerance is
            not above zero, or `max_size` is below 2.
    """
    method = "optimal breakpoints"
    goals, tolerance, sizes = check_ropes(body, goals, tolerance, max_size, 12)
    limits = limits_of(body, workspace or Workspace())
    possible = feasible(goals, limits)
    goals = goals[possible]
    columns, certified, errors, breakpoints = _settle(goals, tolerance, sizes[-1], node_limit)

    def particles(size: int, indices: np.ndarray) -> np.ndarray:
        return breakpoints[indices, size - 2, :size]

    def model(size: int, indices: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        at = particles(size, indices)
        if limits.is_free:
            return at, at, fit_free(goals[indices], at)
        return at, at, fit_within(goals[indices], at, limits)[0]

    def error(size: int, indices: np.ndarray) -> np.ndarray:
        return fit_within(goals[indices], particles(size, indices), limits)[1]

    if not limits.is_free:
        free = columns
        errors, columns = errors_by_size(error, sizes, tolerance, len(goals))
        certified &= columns == free
    models = rope_models(
        goals, sizes, errors, columns, model, certified, tolerance=tolerance, method=method
    )
    return with_infeasible(models, possible, body.num_particles, tolerance=tolerance, method=method)


def _settle(
    goals: np.ndarray, tolerance: float, max_size: int, node_limit: int
) -> tuple[
    Int[np.ndarray, " B"],
    Bool[np.ndarray, " B"],
    Float[np.ndarray, "B M"],
    Int[np.ndarray, "B M M+1"],
]:
    """The smallest free fits: columns of sizes, certificates, errors and breakpoints by size.

    Errors are NaN for sizes more than `SIZES_BEYOND` larger than the smallest fit.
    """
    from jaxsimp.simplification.ropes.branch import settle  # numba takes a while to import

    count = goals.shape[1]
    search = search_batch(goals, max_size)
    breakpoints = np.array(search.breakpoints, dtype=np.int64)
    places, certified, costs = settle(
        goals - goals.mean(axis=1, keepdims=True),
        breakpoints,
        ruled_out(search, tolerance),
        count * tolerance**2,
        regression_gains(count, 0.5, 0.5),
        segment_stiffness(count),
        node_limit,
    )
    beyond = np.arange(max_size - 1)[None, :] > places[:, None] + SIZES_BEYOND
    errors = np.where(beyond, np.nan, np.sqrt(costs / count))
    return np.where(places == max_size - 1, NO_SIZE, places), certified, errors, breakpoints
