"""Shapes to draw: surfaces of obstacles, outlines of bodies."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.interpolate import CubicSpline

from jaxsimp.bodies import Body
from jaxsimp.bodies.topology import boundary_edges
from jaxsimp.dynamics import Obstacle
from jaxsimp.goals import Positions

FAR = 10.0
"""Distance from which the surfaces of obstacles are looked at, metres."""
SMOOTHED, SIDES, CAP = 4, 12, 5
"""Rings of a tube from particle to particle, sides of a ring, and rings of a round end."""
CELLS = 12
"""Lines that are drawn on a cloth, over its size."""
THINNEST = 0.005
"""Least radius of a rope in a picture, as a fraction of its length: so that it is seen."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles to draw.

    Attributes:
        points: shape (V, 3), metres.
        normals: normals of the points, of any length, shape (V, 3).
        faces: shape (F, 3).
        is_solid: whether its inside is never seen.
        rest: rest coordinates along x and y of a sheet's points, shape (V, 2); else None.
    """

    points: Float[np.ndarray, "V 3"]
    normals: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]
    is_solid: bool = True
    rest: Float[np.ndarray, "V 2"] | None = None


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


def obstacle_mesh(obstacle: Obstacle, limits: Float[np.ndarray, "2 3"]) -> Mesh:
    """The surface of an obstacle.

    Args:
        obstacle: the obstacle.
        limits: lowest and highest corner of what is shown; of a half-space the part around it is
            drawn.
    """
    if np.isinf(obstacle.size()[1]):
        points, normals = project(obstacle, _patch(obstacle, limits))
    else:
        points, normals = surface_grid(obstacle, 96, 49)
    return _grid_mesh(points, normals)


def body_mesh(body: Body, positions: Positions) -> Mesh:
    """The triangles of a sheet, with smooth normals; a tube along a rope."""
    if not len(body.faces):
        return tube(positions, shown_radius(body))
    faces = shown_faces(body)
    a, b, c = np.moveaxis(positions[faces], 1, 0)
    normals = np.zeros_like(positions)
    for corner in faces.T:
        np.add.at(normals, corner, np.cross(b - a, c - a))
    return Mesh(positions, normals, faces, is_solid=False, rest=body.rest[:, :2])


def tube(line: Positions, radius: float) -> Mesh:
    """A tube with round ends along a line, smoothed by a spline."""
    count = len(line)
    spine = CubicSpline(np.arange(count), line)(
        np.linspace(0, count - 1, SMOOTHED * (count - 1) + 1)
    )
    along = np.gradient(spine, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True) + 1e-12
    # Quarter circles at both ends; `lean` is the part of the normal along the tube.
    angle = np.linspace(0, np.pi / 2, CAP)
    lean = np.concatenate([-np.sin(angle[::-1]), np.zeros(len(spine) - 2), np.sin(angle)])
    ring = np.concatenate([np.zeros(CAP - 1, int), np.arange(len(spine)), np.full(CAP - 1, -1)])
    middle, along = spine[ring], along[ring]
    side, other = _frames(along)
    turn = np.linspace(0, 2 * np.pi, SIDES + 1)[None, :, None]
    out = np.cos(turn) * side[:, None] + np.sin(turn) * other[:, None]
    flat = np.sqrt(1 - lean**2)[:, None, None]
    normals = flat * out + (lean[:, None] * along)[:, None]
    points = middle[:, None] + radius * normals
    return _grid_mesh(np.moveaxis(points, 2, 0), np.moveaxis(normals, 2, 0))


def _frames(along: Positions) -> tuple[Positions, Positions]:
    """Two unit vectors square to each direction, turned as little as possible from one to next."""
    sides = []
    side = np.eye(3)[np.abs(along[0]).argmin()]
    for way in along:
        side = side - (side @ way) * way
        side = side / (np.linalg.norm(side) + 1e-12)
        sides.append(side)
    found = np.array(sides)
    return found, np.cross(along, found)


def cone(tip: Float[np.ndarray, "3"], height: float) -> Mesh:
    """A gripper above what it holds: a cone that stands on its tip."""
    turn = np.linspace(0, 2 * np.pi, 25)
    around = np.stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)])
    up = np.array([0.0, 0.0, 1.0])[:, None]
    rim = tip[:, None] + height * (0.22 * around + up)
    top = np.tile(tip[:, None] + height * up, len(turn))
    tips = np.tile(tip[:, None], len(turn))
    slope, flat = around - 0.22 * up, np.tile(up, len(turn))
    points = np.stack([tips, rim, rim, top], axis=1)
    return _grid_mesh(points, np.stack([slope, slope, flat, flat], axis=1))


def _grid_mesh(points: Float[np.ndarray, "3 U A"], normals: Float[np.ndarray, "3 U A"]) -> Mesh:
    """Triangles between the points of a grid."""
    count_up, count_around = points.shape[1:]
    first = (np.arange(count_up - 1)[:, None] * count_around + np.arange(count_around - 1)).ravel()
    second, below = first + 1, first + count_around
    faces = np.concatenate(
        [np.stack([first, below, second], axis=1), np.stack([second, below, below + 1], axis=1)]
    )
    return Mesh(points.reshape(3, -1).T, normals.reshape(3, -1).T, faces)


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
