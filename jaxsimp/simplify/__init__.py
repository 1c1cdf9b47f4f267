"""Simplification: a goal configuration to the key points that matter for it."""

import numpy as np
from jaxtyping import Float

from jaxsimp.body import Body
from jaxsimp.goals import Positions, as_goal
from jaxsimp.simplify.cloth_quadric import simplify_quadric
from jaxsimp.simplify.keypoints import KeyPoints, Status
from jaxsimp.simplify.rope_fit import Workspace
from jaxsimp.simplify.rope_optimal import simplify_optimal
from jaxsimp.simplify.rope_uniform import simplify_uniform

__all__ = [
    "METHODS",
    "KeyPoints",
    "Status",
    "Workspace",
    "simplify",
    "simplify_batch",
    "simplify_optimal",
    "simplify_quadric",
    "simplify_uniform",
]

# A method is one function for ropes and one for surfaces.
METHODS = {
    "robust": (simplify_optimal, simplify_quadric),
    "paper": (simplify_uniform, simplify_quadric),
}


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
        method: "robust": the best breakpoints for ropes; "paper": evenly spread breakpoints for
            ropes, quadric edge collapse with the Hausdorff distance for surfaces.
        tolerance: error below which a model fits, metres; the method's own by default.
        max_size: largest number of key points tried; the method's own by default.

    Raises:
        ValueError: if there is no such method, a goal is not one of this body, or a number is
            out of its range.
    """
    if method not in METHODS:
        raise ValueError(f"method is {method!r}; choose one of {', '.join(METHODS)}")
    if len(body.faces):
        options = {} if max_size is None else {"max_size": max_size}
        return [simplify_quadric(body, goal, tolerance=tolerance, **options) for goal in goals]
    return METHODS[method][0](body, goals, tolerance, max_size)


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
    goals = as_goal(body, goal)[None]
    (points,) = simplify_batch(body, goals, method=method, tolerance=tolerance, max_size=max_size)
    if points.status != Status.FITS:
        raise ValueError(
            f"no model of up to {points.sizes[-1]} key points is within the tolerance of "
            f"{points.tolerance:.3g} m: the best is off by {min(points.errors):.3g} m; raise "
            f"tolerance or max_size"
        )
    return points
