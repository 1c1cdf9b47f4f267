"""Surfaces: the fewest triangles, in rest coordinates, that map every particle to its goal.

Rest-aware collapse. A quadric edge collapse in goal and rest coordinates together leaves about
two dozen vertices, all of them particles. Then vertices are removed one by one; the others move
to neighbouring particles, and edges flip, while this improves a least-squares fit of the model to
all particles. The fit averages over noise; layers that coincide in the goal are far apart at
rest, so the fit does not confuse them.
"""

import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import Float, Int

from jaxsimp.bodies import Body
from jaxsimp.bodies.topology import boundary_edges, half_edges, inner_edges, neighbours, rim
from jaxsimp.goals import Positions
from jaxsimp.simplification.key_points import FitStatus, KeyPoints, smallest_fit
from jaxsimp.simplification.surfaces.common import (
    DEFAULT_MAX_SIZE,
    check_surfaces,
    no_model,
    rest_normals,
)
from jaxsimp.simplification.surfaces.model import Sheet, SurfaceModel

METHOD = "rest-aware collapse"
MIN_SIZE = 3  # one triangle
START_SIZE = 24  # least number of vertices after the collapse
TOLERANCE = 0.1  # as a fraction of the side of a square of the body's area
# Removals whose largest distance is below this part of the tolerance are compared by their mean
# square distance alone: the largest of many small distances is noise.
ENOUGH = 0.5
BOUNDARY_WEIGHT = 10.0  # times the squared length of a boundary edge; a triangle weighs its area
LONGEST_MOVE = 1 / 6  # as a fraction of the particles along a side


def simplify_parametric(
    body: Body,
    goals: Float[np.ndarray, "B N 3"],
    tolerance: float | None = None,
    max_size: int | None = None,
) -> list[KeyPoints]:
    """Key points of goals of a surface: the fewest whose model is near every particle.

    The error of a model is the largest distance of a particle's goal from the piecewise-linear
    interpolation, at the particle's rest coordinates, of the key points' positions. These are a
    least-squares fit to all particles, weighted by their area, and not the goals of the key
    particles: a fit averages over noise. No model is proven to be the smallest.

    Works for any manifold with or without boundary, planar at rest or not. Goals are independent
    and run in threads. The first call compiles for about half a minute; numba keeps the compiled
    code on disk.

    Args:
        body: a body with triangles; particles of no triangle are ignored.
        goals: goal positions, shape (B, N, 3), metres.
        tolerance: error below which a model fits, metres; by default a tenth of the side of a
            square of the body's area.
        max_size: largest number of key points tried; 24 by default.

    Returns:
        Key points of each goal: the best of the models tried, with the status `NO_FIT`, where no
        model of up to `max_size` key points fits.

    Raises:
        ValueError: if the body has no triangles, a goal does not fit the body, the tolerance
            is not above zero, or `max_size` is below 3.
    """
    scale = float(np.sqrt(np.linalg.norm(rest_normals(body.rest, body.faces), axis=1).sum()))
    tolerance = TOLERANCE * scale if tolerance is None else tolerance
    max_size = DEFAULT_MAX_SIZE if max_size is None else max_size
    goals = check_surfaces(body, goals, tolerance, max_size, MIN_SIZE)

    def one(goal: np.ndarray) -> KeyPoints:
        sheet = _sheet(body, goal, scale)
        models = _models(sheet, body.faces, max(max_size, START_SIZE), tolerance / scale)
        models = {size: model for size, model in models.items() if size <= max_size}
        return _smallest(body, goal, sheet, models, scale, tolerance)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return list(pool.map(one, goals))


def _sheet(body: Body, goal: Positions, scale: float) -> Sheet:
    """Body and goal as input of the compiled functions, in units of `scale`."""
    count, faces = body.num_particles, body.faces
    normals = rest_normals(body.rest / scale, faces)
    area, facing = np.zeros(count), np.zeros((count, 3))
    np.add.at(area, faces, np.linalg.norm(normals, axis=1, keepdims=True) / 3)
    np.add.at(facing, faces, normals[:, None])
    first, other = neighbours(half_edges(faces)[0], count)
    used = area > 0
    return Sheet(
        rest=(body.rest - body.rest[used].mean(axis=0)) / scale,
        facing=facing,
        goal=(goal - goal[used].mean(axis=0)) / scale,
        area=area / area.sum(),
        first=first,
        other=other,
        rim=rim(faces, count),
    )


def _models(
    sheet: Sheet, faces: Int[np.ndarray, "F 3"], size: int, tolerance: float
) -> dict[int, SurfaceModel]:
    """Models by size, from that of the collapsed mesh (`size` where possible) down."""
    from jaxsimp.simplification.surfaces import collapse, fit, refine

    points = np.concatenate([sheet.goal, sheet.rest], axis=1)
    quadrics = _quadrics(points, faces, _outline(sheet.rest, faces))
    triangles, owner = collapse.decimate(
        points, quadrics, sheet.rest, sheet.facing, np.array(faces, dtype=np.int64), size
    )
    vertices, local = np.unique(triangles, return_inverse=True)
    model = fit.start(sheet, vertices, local.reshape(-1, 3), owner)
    steps = _steps(len(sheet.rest))
    near = np.ones(len(model.vertices), dtype=bool)
    models: dict[int, SurfaceModel] = {}
    while True:
        model = refine.improve(sheet, model, near, steps)
        models[len(model.vertices)] = model
        smaller, gone = refine.remove(sheet, model, ENOUGH * tolerance)
        if gone < 0:
            return models
        near = fit.neighbours(model.triangles, gone) > 0
        model, near = _without_gaps(smaller), np.delete(near, gone)


def _without_gaps(model: SurfaceModel) -> SurfaceModel:
    """The model without the rows of removed vertices and triangles."""
    vertices, triangles = model.vertices >= 0, model.triangles[:, 0] >= 0
    # An index of -1, which refers to nothing, reads the -1 at the end.
    vertex_number = np.append(np.cumsum(vertices) - 1, -1)
    triangle_number = np.append(np.cumsum(triangles) - 1, -1)
    return model._replace(
        vertices=model.vertices[vertices],
        triangles=vertex_number[model.triangles[triangles]],
        owner=triangle_number[model.owner],
        sums=model.sums[triangles],
    )


def _outline(
    rest: Float[np.ndarray, "N 3"], faces: Int[np.ndarray, "F 3"]
) -> Int[np.ndarray, "E 3"]:
    """Edges of the body's outline at rest, and the third vertex of their triangles, shape (E, 3).

    Besides the boundary these are edges where the body turns back on itself, as a flat shirt
    does at its sides, with two triangles at each.
    """
    edges, owner = boundary_edges(faces)
    apex = faces[owner].sum(axis=1) - edges.sum(axis=1)
    inner, apexes, pairs = inner_edges(faces)
    normals = rest_normals(rest, faces)[pairs]
    back = np.sum(normals[:, 0] * normals[:, 1], axis=1) < 0
    return np.concatenate(
        [np.column_stack([edges, apex])]
        + [np.column_stack([inner[back], apexes[back, side]]) for side in (0, 1)]
    )


def _quadrics(
    points: Float[np.ndarray, "N 6"],
    faces: Int[np.ndarray, "F 3"],
    outline: Int[np.ndarray, "E 3"],
) -> Float[np.ndarray, "N 7 7"]:
    """Squared distances from the planes of each vertex's triangles and from its outline.

    Functions of a point in homogeneous coordinates. A triangle's plane is weighted by its area. An
    edge of the outline adds the distance from it within the plane of its triangle.
    """
    quadrics = np.zeros((len(points), 7, 7))
    along, across, area = _frames(points[faces])
    off = np.eye(6) - along[:, :, None] * along[:, None] - across[:, :, None] * across[:, None]
    _add_quadrics(quadrics, points, faces, off * area[:, None, None])
    _, across, _ = _frames(points[outline])
    squared = np.sum((points[outline[:, 1]] - points[outline[:, 0]]) ** 2, axis=1)
    off = across[:, :, None] * across[:, None] * (BOUNDARY_WEIGHT * squared)[:, None, None]
    _add_quadrics(quadrics, points, outline[:, :2], off)
    return quadrics


def _frames(
    corners: Float[np.ndarray, "M 3 D"],
) -> tuple[Float[np.ndarray, "M D"], Float[np.ndarray, "M D"], Float[np.ndarray, " M"]]:
    """Orthonormal directions along and across the first edge of triangles, and their areas."""
    edge, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    tiny = np.finfo(float).tiny
    length = np.linalg.norm(edge, axis=1, keepdims=True)
    along = edge / np.maximum(length, tiny)
    rise = other - np.sum(other * along, axis=1, keepdims=True) * along
    height = np.linalg.norm(rise, axis=1, keepdims=True)
    return along, rise / np.maximum(height, tiny), (length * height)[:, 0] / 2


def _add_quadrics(
    quadrics: Float[np.ndarray, "N 7 7"],
    points: Float[np.ndarray, "N 6"],
    simplices: Int[np.ndarray, "M _"],
    matrices: Float[np.ndarray, "M 6 6"],
) -> None:
    """Add (x - p)' A (x - p) to every vertex of each simplex, p its first vertex."""
    origin = points[simplices[:, 0]]
    whole = np.zeros((len(simplices), 7, 7))
    offset = -np.einsum("mij,mj->mi", matrices, origin)
    whole[:, :6, :6] = matrices
    whole[:, :6, 6] = whole[:, 6, :6] = offset
    whole[:, 6, 6] = -np.sum(offset * origin, axis=1)
    for vertices in simplices.T:
        np.add.at(quadrics, vertices, whole)


def _steps(num_particles: int) -> Int[np.ndarray, " L"]:
    """Lengths of moves, in particles, longest first: powers of two."""
    longest = max(1.0, LONGEST_MOVE * np.sqrt(num_particles))
    return 2 ** np.arange(int(np.log2(longest)), -1, -1)


def _smallest(
    body: Body,
    goal: Positions,
    sheet: Sheet,
    models: dict[int, SurfaceModel],
    scale: float,
    tolerance: float,
) -> KeyPoints:
    """The smallest model that fits, or the best if none fits."""
    from jaxsimp.simplification.surfaces.fit import distances, fit

    def error(size: int) -> float:
        positions, _ = fit(models[size])
        return float(scale * distances(sheet, models[size], positions).max())

    size, errors = smallest_fit(error, sorted(models), tolerance)
    if not errors:
        return no_model(body, tolerance, METHOD)
    best = min(errors, key=errors.__getitem__) if size is None else size
    model = models[best]
    positions, _ = fit(model)
    off = scale * distances(sheet, model, positions)[model.owner >= 0]
    order = np.argsort(model.vertices)
    used = sheet.area > 0
    return KeyPoints(
        particles=model.vertices[order],
        positions=scale * positions[order] + goal[used].mean(axis=0),
        elements=np.argsort(order)[model.triangles],
        num_particles=body.num_particles,
        method=METHOD,
        sizes=tuple(errors),
        errors=tuple(errors.values()),
        tolerance=tolerance,
        max_error=float(off.max()),
        rms_error=float(np.sqrt(np.mean(off**2))),
        status=FitStatus.NO_FIT if size is None else FitStatus.FITS,
    )
