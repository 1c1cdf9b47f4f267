"""The methods of simplification by name, and the doors to them: `simplify`, `simplify_batch`."""

import numpy as np
from jaxtyping import Float

from jaxsimp.bodies import Body
from jaxsimp.goals import Positions, as_goal
from jaxsimp.simplification.key_points import FitStatus, KeyPoints
from jaxsimp.simplification.ropes.optimal import simplify_optimal
from jaxsimp.simplification.ropes.uniform import simplify_uniform
from jaxsimp.simplification.surfaces.meshlab import simplify_meshlab
from jaxsimp.simplification.surfaces.parametric import simplify_parametric
from jaxsimp.simplification.surfaces.quadric import simplify_quadric

METHODS = {
    "robust": (simplify_optimal, simplify_parametric),
    "paper": (simplify_uniform, simplify_quadric),
    "meshlab": (simplify_uniform, simplify_meshlab),
}
"""A method by its name: one function for ropes and one for surfaces."""


def simplify_batch(
    body: Body,
    goals: Float[np.ndarray, "B N 3"],
    *,
    method: str = "robust",
    tolerance: float | None = None,
    max_size: int | None = None,
) -> list[KeyPoints]:
    """Key points of a batch of goals: the smallest accurate model of each.

    That a goal has no model is its status, and does not concern the others.

    Args:
        body: a rope, or a body with triangles.
        goals: goal positions, shape (B, N, 3), metres.
        method: "robust": the best breakpoints for ropes, a collapse that knows rest coordinates
            for surfaces; "paper": evenly spread breakpoints for ropes, quadric edge collapse
            with the Hausdorff distance for surfaces; "meshlab": the same with the paper's own
            tool, an extra.
        tolerance: error below which a model fits, metres; the method's own by default.
        max_size: largest number of key points tried; the method's own by default.

    Raises:
        ValueError: if there is no such method, a goal is not one of this body, or a number is
            out of its range.
    """
    if method not in METHODS:
        raise ValueError(f"method is {method!r}; choose one of {', '.join(METHODS)}")
    checked = [as_goal(body, goal) for goal in goals]
    if not checked:
        return []
    simplify_goals = METHODS[method][len(body.faces) > 0]
    return simplify_goals(body, np.stack(checked), tolerance, max_size)


def simplify(
    body: Body,
    goal: Positions,
    *,
    method: str = "robust",
    tolerance: float | None = None,
    max_size: int | None = None,
) -> KeyPoints:
    """Key points of one goal: its smallest accurate model (section III-A of the paper).

    Args:
        body: a rope, or a body with triangles.
        goal: goal positions, shape (N, 3), metres.
        method: as for `simplify_batch`.
        tolerance: error below which a model fits, metres; the method's own by default.
        max_size: largest number of key points tried; the method's own by default.

    Raises:
        ValueError: as for `simplify_batch`, or if no model fits.
    """
    goals = np.asarray(goal)[None]
    (points,) = simplify_batch(body, goals, method=method, tolerance=tolerance, max_size=max_size)
    if points.status != FitStatus.FITS:
        raise ValueError(
            f"no model of up to {points.sizes[-1]} key points is within the tolerance of "
            f"{points.tolerance:.3g} m: the best is off by {min(points.errors):.3g} m; raise "
            f"tolerance or max_size"
        )
    return points
