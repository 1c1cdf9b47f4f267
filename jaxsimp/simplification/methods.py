"""Methods of simplification by name, and the functions that call them."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from jaxsimp.bodies import Body
from jaxsimp.bodies.size import LARGEST
from jaxsimp.checks import as_reals, require_choice, require_number, require_shape, told
from jaxsimp.goals import Positions, as_goal
from jaxsimp.simplification.key_points import SMALLEST_TOLERANCE, FitStatus, KeyPoints
from jaxsimp.simplification.ropes.fit import Workspace, why_infeasible
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
    workspace: Workspace | None = None,
) -> list[KeyPoints]:
    """Key points of a batch of goals: the smallest accurate model of each.

    A goal without a model has a status other than `FITS`; the other goals are unaffected.

    Args:
        body: a rope, or a body with triangles.
        goals: goal positions, shape (B, N, 3), metres.
        method: "robust": optimal breakpoints for ropes, edge collapse in goal and rest coordinates
            for surfaces; "paper": evenly spread breakpoints for ropes, quadric edge collapse
            with the Hausdorff distance for surfaces; "meshlab": as "paper", but with MeshLab, the
            paper's tool (an optional extra).
        tolerance: error below which a model fits, metres; the method's own by default.
        max_size: largest number of key points tried; the method's own by default.
        workspace: limits on the model of a rope, metres; none by default. A goal that has no
            model within them has the status `INFEASIBLE`.

    Raises:
        ValueError: if the method is unknown, a goal does not fit the body, a number is out of
            range, or a workspace is given for a surface.
    """
    require_choice("method", method, METHODS)
    if tolerance is not None:
        tolerance = require_number("tolerance", tolerance, SMALLEST_TOLERANCE, LARGEST, "m")
    checked = [as_goal(body, goal) for goal in _each(body, goals)]
    simplify_ropes, simplify_surfaces = METHODS[method]
    if workspace is not None and not isinstance(workspace, Workspace):
        raise ValueError(f"workspace is {told(workspace)}; give a jaxsimp.Workspace")
    if workspace is not None and len(body.faces):
        raise ValueError(
            f"a workspace (lower, upper, above_table, fixed_ends, max_stretch) is given, and "
            f"{body.name} is a surface of {len(body.faces)} triangles; only models of ropes keep "
            f"to a workspace: leave it out"
        )
    if not checked:
        return []
    if len(body.faces):
        return simplify_surfaces(body, np.stack(checked), tolerance, max_size)
    return simplify_ropes(body, np.stack(checked), tolerance, max_size, workspace=workspace)


def _each(body: Body, goals: Sequence[Positions] | np.ndarray) -> list[Positions]:
    """The goals of a batch: an array, or a list of goals."""
    array = as_reals(goals)  # None for goals of several shapes, which `as_goal` names
    if array is not None and array.size:
        wanted = ("B", *body.rest.shape)
        require_shape("goals", array, wanted, "a batch, or call simplify with one goal")
    elif not isinstance(goals, np.ndarray | Sequence) or isinstance(goals, str | bytes):
        raise ValueError(f"goals is {told(goals)}; give an array of shape (B, N, 3)")
    return list(goals)


def simplify(
    body: Body,
    goal: Positions,
    *,
    method: str = "robust",
    tolerance: float | None = None,
    max_size: int | None = None,
    workspace: Workspace | None = None,
) -> KeyPoints:
    """Key points of one goal: its smallest accurate model (section III-A of the paper).

    Args:
        body: a rope, or a body with triangles.
        goal: goal positions, shape (N, 3), metres.
        method: as for `simplify_batch`.
        tolerance: error below which a model fits, metres; the method's own by default.
        max_size: largest number of key points tried; the method's own by default.
        workspace: as for `simplify_batch`.

    Raises:
        ValueError: as for `simplify_batch`, or if no model fits or lies within the workspace.
    """
    goals = as_goal(body, goal)[None]
    (points,) = simplify_batch(
        body, goals, method=method, tolerance=tolerance, max_size=max_size, workspace=workspace
    )
    if points.status == FitStatus.INFEASIBLE:
        raise ValueError(why_infeasible(body, goals[0], workspace or Workspace()))
    if points.status != FitStatus.FITS:
        raise ValueError(
            f"no model of up to {points.sizes[-1]} key points is within the tolerance of "
            f"{points.tolerance:.3g} m: the best is off by {min(points.errors):.3g} m; raise "
            f"tolerance, or max_size above {points.sizes[-1]}"
        )
    return points
