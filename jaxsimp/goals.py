"""Goals: where every particle of a body should end.

A goal is an array of positions, shape (N, 3), metres, z up, the table at z = 0. The
functions here make the goals of the paper; `check_goal` is the door through which any
other goal enters.
"""

import numpy as np
from jaxtyping import Float

from jaxsimp.body import Body

Positions = Float[np.ndarray, "N 3"]


def flat(body: Body, angle: float = 0.0) -> Positions:
    """The body at rest, flat on the table and turned by `angle` about z, shape (N, 3).

    Args:
        body: any body.
        angle: rotation about the vertical through the origin, radians.
    """
    return turn(body.rest + np.array([0.0, 0.0, body.radius]), angle)


def turn(positions: Positions, angle: float) -> Positions:
    """Positions turned about the vertical through the origin, shape (N, 3).

    Args:
        positions: shape (N, 3), metres.
        angle: counter-clockwise seen from above, radians.
    """
    cos, sin = np.cos(angle), np.sin(angle)
    return positions @ np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])


def polyline(body: Body, corners: Float[np.ndarray, "M 2"]) -> Positions:
    """A rope laid along a polyline on the table, shape (N, 3).

    Particles are spread evenly over the length of the polyline, which need not equal the
    rest length: a shorter line is a slack rope.

    Args:
        body: a rope.
        corners: x and y of the corners in order, at least two, metres.

    Raises:
        ValueError: if the polyline has fewer than two corners or no length.
    """
    corners = np.asarray(corners, dtype=float)
    if corners.ndim != 2 or corners.shape[0] < 2 or corners.shape[1] != 2:
        raise ValueError(f"corners has shape {corners.shape}; (M, 2) with M of 2 or more is needed")
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    if not 0 < arc[-1] < np.inf:
        raise ValueError(f"the polyline is {arc[-1]:g} m long; give corners that are apart")
    along = np.linspace(0.0, arc[-1], body.num_particles)
    xy = [np.interp(along, arc, corners[:, axis]) for axis in range(2)]
    return np.stack([*xy, np.full(body.num_particles, body.radius)], axis=1)


def straight(body: Body, length: float | None = None) -> Positions:
    """A straight rope along x, centred, shape (N, 3).

    Args:
        body: a rope.
        length: distance of the ends, metres; the rest length by default.
    """
    half = (body.size if length is None else length) / 2
    return polyline(body, np.array([[-half, 0.0], [half, 0.0]]))


def fold(
    body: Body,
    positions: Positions,
    point: Float[np.ndarray, " 2"],
    direction: Float[np.ndarray, " 2"],
) -> Positions:
    """Fold about a line: what lies to its left is turned over onto what lies to its right.

    The folded layers rest on the highest of the others, a thickness (twice the radius) higher;
    particles on the line form the crease, a radius higher than they were.

    Args:
        body: the body whose thickness separates the layers.
        positions: what is folded, shape (N, 3), metres.
        point: x and y of a point on the line, metres.
        direction: x and y of the line's direction; its length does not matter.

    Raises:
        ValueError: if the direction has no length, or the line is not finite.
    """
    direction = np.asarray(direction, dtype=float)
    norm = np.linalg.norm(direction)
    if not 0 < norm < np.inf:
        raise ValueError(f"direction is {direction.tolist()}; give a finite vector with a length")
    point = np.asarray(point, dtype=float)
    if not np.isfinite(point).all():
        raise ValueError(f"point is {point.tolist()}; give finite coordinates in metres")
    left = np.array([-direction[1], direction[0]]) / norm
    distance = (positions[:, :2] - point) @ left
    # A particle nearer to the line than rounding can tell is on the crease.
    side = np.where(np.abs(distance) < 1e-6 * body.size, 0.0, np.sign(distance))
    folded = positions.copy()
    folded[:, :2] -= np.where(side > 0, 2 * distance, 0.0)[:, None] * left
    z = positions[:, 2]
    top = z[side <= 0].max(initial=body.radius) + body.radius
    folded[:, 2] = np.select([side > 0, side == 0], [2 * top - z, z + body.radius], z)
    return folded


def check_goal(body: Body, goal: Positions) -> Positions:
    """The goal as a float array, if it can be one for this body.

    Raises:
        ValueError: if the shape is not (N, 3), or a coordinate is not finite.
    """
    goal = np.asarray(goal, dtype=float)
    if goal.shape != body.rest.shape:
        raise ValueError(
            f"the goal has shape {goal.shape}; {body.rest.shape} is needed, "
            f"one row of x, y, z for each particle of the {body.name}"
        )
    bad = np.flatnonzero(~np.isfinite(goal).all(axis=1))
    if bad.size:
        raise ValueError(
            f"the goal of particle {bad[0]} is {goal[bad[0]].tolist()} "
            f"({bad.size} such particles); give finite coordinates in metres"
        )
    return goal
