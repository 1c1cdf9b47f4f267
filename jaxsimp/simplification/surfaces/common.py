"""Shared by the methods for surfaces: option checks, normals, choice by Hausdorff distance."""

from collections.abc import Iterable, Mapping

import numpy as np
from jaxtyping import Float, Int

from jaxsimp.bodies import Body
from jaxsimp.bodies.size import LARGEST
from jaxsimp.checks import require_count, require_number
from jaxsimp.goals import Positions, as_goal
from jaxsimp.simplification.interpolation import interpolation_weights, model_errors
from jaxsimp.simplification.key_points import (
    SMALLEST_TOLERANCE,
    FitStatus,
    KeyPoints,
    smallest_fit,
)
from jaxsimp.simplification.surfaces.hausdorff import Surface, hausdorff_distance

DEFAULT_MAX_SIZE = 24
MOST_SAMPLES = 200
"""Largest number of samples along a triangle's edge: half a gigabyte for a cloth of 25 by 25 that
is nothing but torn. By default a sample a hundredth of the body's size is enough."""


def check_surfaces(
    body: Body, goals: Float[np.ndarray, "B N 3"], tolerance: float, max_size: int, least: int
) -> Float[np.ndarray, "B N 3"]:
    """Goals as floats, after a check of the arguments of a method for surfaces.

    Args:
        body: a body with triangles.
        goals: goal positions, metres, finite for each particle of this body.
        tolerance: metres, above zero.
        max_size: `least` or more.
        least: size of the method's smallest model.

    Raises:
        ValueError: if an argument is not as stated.
    """
    if len(body.faces) == 0:
        raise ValueError(f"the {body.name} has 0 triangles; give a body with triangles")
    require_number("tolerance", tolerance, SMALLEST_TOLERANCE, LARGEST, "m")
    require_count("max_size", max_size, least)
    checked = np.zeros((len(goals), *body.rest.shape))
    for index, goal in enumerate(goals):
        checked[index] = as_goal(body, goal)
    return checked


def fewest_vertices(
    body: Body,
    goal: Positions,
    meshes: Mapping[int, Int[np.ndarray, "_ 3"]],
    sizes: Iterable[int],
    tolerance: float,
    method: str,
) -> KeyPoints:
    """The smallest mesh that covers the goal, of meshes with vertices among the particles.

    The error is the Hausdorff distance, surface to surface, from samples at a spacing of a tenth of
    the tolerance, or an eighth of the body's spacing if that is more; it may be below the exact
    distance by 0.58 of the sample spacing. In a goal with triangles torn to a multiple of the
    body's size samples are wider apart, `MOST_SAMPLES` along the longest edge.

    Args:
        body: a body with triangles.
        goal: goal positions, shape (N, 3), metres.
        meshes: triangles in particle ids by number of vertices; read one by one as `sizes` yields.
        sizes: numbers of vertices in ascending order.
        tolerance: Hausdorff distance below which a mesh fits, metres.
        method: name of the method that made the meshes.

    Returns:
        The first mesh that fits; otherwise the best mesh, with the status `NO_FIT`. Without any
        mesh, no key points and an infinite error.
    """
    original = Surface(goal, body.faces)
    corners = goal[body.faces]
    longest = float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max())
    sampling = max(tolerance / 10, body.spacing / 8, longest / MOST_SAMPLES)

    def error(size: int) -> float:
        return hausdorff_distance(original, Surface(goal, meshes[size]), sampling)

    size, errors = smallest_fit(error, sizes, tolerance)
    if not errors:
        return no_model(body, tolerance, method)
    best = min(errors, key=errors.__getitem__) if size is None else size
    particles, elements = np.unique(meshes[best], return_inverse=True)
    elements = elements.reshape(-1, 3)
    weights = interpolation_weights(body.rest, particles, elements)
    largest, mean = model_errors(goal, weights, goal[particles])
    return KeyPoints(
        particles=particles,
        positions=goal[particles],
        elements=elements,
        num_particles=body.num_particles,
        method=method,
        sizes=tuple(errors),
        errors=tuple(errors.values()),
        tolerance=tolerance,
        max_error=largest,
        rms_error=mean,
        status=FitStatus.NO_FIT if size is None else FitStatus.FITS,
    )


def no_model(body: Body, tolerance: float, method: str) -> KeyPoints:
    """The result of a method without any model: no key points, and an infinite error.

    Args:
        body: a body with triangles.
        tolerance: error below which a model would fit, metres.
        method: name of the method.
    """
    return KeyPoints(
        particles=np.zeros(0, dtype=int),
        positions=np.zeros((0, 3)),
        elements=np.zeros((0, 3), dtype=int),
        num_particles=body.num_particles,
        method=method,
        sizes=(0,),
        errors=(np.inf,),
        tolerance=tolerance,
        max_error=np.inf,
        rms_error=np.inf,
        status=FitStatus.NO_FIT,
    )


def rest_normals(
    rest: Float[np.ndarray, "N 3"], faces: Int[np.ndarray, "F 3"]
) -> Float[np.ndarray, "F 3"]:
    """Normals of triangles at rest, of length equal to the triangles' areas, shape (F, 3).

    Args:
        rest: rest coordinates, shape (N, 3), metres.
        faces: vertex ids of the triangles, shape (F, 3).
    """
    first, second = np.moveaxis(rest[faces[:, 1:]] - rest[faces[:, :1]], 1, 0)
    return np.cross(first, second) / 2
