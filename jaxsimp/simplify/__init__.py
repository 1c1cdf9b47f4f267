"""Simplification: a goal configuration to the key points that matter for it."""

from typing import Any

from jaxsimp.body import Body
from jaxsimp.goals import Positions, check_goal
from jaxsimp.simplify.cloth_meshlab import simplify_meshlab
from jaxsimp.simplify.cloth_parametric import simplify_parametric
from jaxsimp.simplify.cloth_quadric import simplify_quadric
from jaxsimp.simplify.keypoints import KeyPoints
from jaxsimp.simplify.rope_uniform import simplify_uniform

__all__ = ["KeyPoints", "simplify", "simplify_quadric", "simplify_uniform"]

# A method is one function for ropes and one for surfaces.
METHODS = {
    "robust": (simplify_uniform, simplify_parametric),
    "paper": (simplify_uniform, simplify_quadric),
    "meshlab": (simplify_uniform, simplify_meshlab),
}


def simplify(
    body: Body,
    goal: Positions,
    *,
    method: str = "paper",
    tolerance: float | None = None,
    max_size: int | None = None,
) -> KeyPoints:
    """Key points of a goal: the smallest accurate model of it (section III-A of the paper).

    Args:
        body: a rope, or a body with triangles.
        goal: goal positions, shape (N, 3), metres.
        method: "paper": evenly spread breakpoints for ropes, quadric edge collapse with the
            Hausdorff distance for surfaces.
        tolerance: error below which a model fits, metres; the method's own by default.
        max_size: largest number of key points tried; the method's own by default.

    Raises:
        ValueError: if there is no such method, the goal is not one of this body, a number is
            out of its range, or no model fits.
    """
    if method not in METHODS:
        raise ValueError(f"method is {method!r}; choose one of {', '.join(METHODS)}")
    if len(body.faces):
        return METHODS[method][1](body, check_goal(body, goal)[None], tolerance, max_size)[0]
    options: dict[str, Any] = {} if max_size is None else {"max_size": max_size}
    return simplify_uniform(body, goal, tolerance=tolerance, **options)
