"""Shapes to draw: surfaces of obstacles, outlines of bodies."""

import numpy as np
from jaxtyping import Float, Int

from jaxsimp.bodies import Body
from jaxsimp.bodies.topology import boundary_edges
from jaxsimp.dynamics import Obstacle

FAR = 10.0
"""Distance from which the surfaces of obstacles are looked at, metres."""
THINNEST = 0.005
"""Least radius of a rope in a picture, as a fraction of its length: so that it is seen."""


def surface_grid(
    obstacle: Obstacle, num_around: int, num_up: int
) -> tuple[Float[np.ndarray, "3 U A"], Float[np.ndarray, "3 U A"]]:
    """Points on the surface of a finite obstacle and its normals there.

    They are the nearest to points far away all around.
    """
    azimuth, polar = np.meshgrid(
        np.linspace(0, 2 * np.pi, num_around), np.linspace(0, np.pi, num_up)
    )
    flat = np.sin(polar)
    around = FAR * np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.cos(polar)])
    return project(obstacle, around)


def project(
    obstacle: Obstacle, points: Float[np.ndarray, "3 U A"]
) -> tuple[Float[np.ndarray, "3 U A"], Float[np.ndarray, "3 U A"]]:
    """The nearest points of a surface, and its outward normals there."""
    found, parts = obstacle.distance(*points)
    distance = np.asarray(found)[None]
    normal = np.stack([np.asarray(part) * np.ones_like(distance[0]) for part in parts])
    return points - distance * normal, normal


def obstacle_mesh(
    obstacle: Obstacle, limits: Float[np.ndarray, "2 3"]
) -> tuple[Float[np.ndarray, "V 3"], Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]]:
    """Vertices, normals and triangles of an obstacle's surface.

    Args:
        obstacle: the obstacle.
        limits: lowest and highest corner of what is shown; of a half-space the part around it is
            drawn.
    """
    if np.isinf(obstacle.size()[1]):
        points, normals = project(obstacle, _patch(obstacle, limits))
    else:
        points, normals = surface_grid(obstacle, 96, 49)
    count_up, count_around = points.shape[1:]
    first = (np.arange(count_up - 1)[:, None] * count_around + np.arange(count_around - 1)).ravel()
    second, below = first + 1, first + count_around
    faces = np.concatenate(
        [np.stack([first, below, second], axis=1), np.stack([second, below, below + 1], axis=1)]
    )
    return points.reshape(3, -1).T, normals.reshape(3, -1).T, faces


def _patch(obstacle: Obstacle, limits: Float[np.ndarray, "2 3"]) -> Float[np.ndarray, "3 2 2"]:
    """The corners of a square along a half-space, around the middle of what is shown."""
    middle = limits.mean(axis=0)
    _, normal = project(obstacle, middle.reshape(3, 1, 1))
    out = normal.ravel()
    side = np.cross(out, np.eye(3)[np.abs(out).argmin()])
    half = np.linalg.norm(np.diff(limits, axis=0)) * side / np.linalg.norm(side)
    other = np.cross(out, half)
    rows = [
        [middle - half - other, middle - half + other],
        [middle + half - other, middle + half + other],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def shown_faces(body: Body) -> Int[np.ndarray, "F 3"]:
    """The triangles of a body, turned so that the front of a sheet at rest is its top."""
    if not len(body.faces):
        return body.faces
    a, b, c = np.moveaxis(body.rest[body.faces], 1, 0)
    faces_down = np.cross(b - a, c - a)[:, 2].sum() < 0
    return body.faces[:, ::-1] if faces_down else body.faces


def outline(body: Body) -> Int[np.ndarray, "E 2"]:
    """The edges of a sheet's boundary; none for a rope, or a closed surface."""
    return boundary_edges(body.faces)[0] if len(body.faces) else np.zeros((0, 2), dtype=int)


def shown_radius(body: Body) -> float:
    """Radius at which a rope is drawn, metres."""
    return max(body.radius, THINNEST * body.size)
