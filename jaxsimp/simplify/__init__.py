"""Simplification: a goal configuration to the key points that matter for it."""

from jaxsimp.body import Body
from jaxsimp.goals import Positions
from jaxsimp.simplify.cloth_quadric import simplify_quadric
from jaxsimp.simplify.keypoints import KeyPoints
from jaxsimp.simplify.rope_uniform import simplify_uniform

__all__ = ["METHODS", "KeyPoints", "simplify", "simplify_quadric", "simplify_uniform"]

# A method is one function for ropes and one for surfaces.
METHODS = {"paper": (simplify_uniform, simplify_quadric)}


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
    simplify_body = METHODS[method][len(body.faces) > 0]
    options = {} if max_size is None else {"max_size": max_size}
    return simplify_body(body, goal, tolerance=tolerance, **options)
