"""A body flat on the table, and ropes laid along lines, letters and a triangle."""

import numpy as np
from jaxtyping import Float

from jaxsimp.bodies import Body
from jaxsimp.bodies.size import LARGEST
from jaxsimp.checks import require_choice, require_number, require_rows, require_shape

Positions = Float[np.ndarray, "N 3"]
BUMPS = 0.05
"""Largest height of a flat body, besides two of its thickness, relative to its size."""


def flat(body: Body, angle: float = 0.0) -> Positions:
    """The body at rest, flat on the table and turned by `angle` about z, shape (N, 3).

    Args:
        body: a body that is flat at rest, of one layer or two.
        angle: rotation about the vertical through the origin, radians.

    Raises:
        ValueError: if the body is not flat at rest, or the angle no number.
    """
    require_flat(body)
    return turn(body.rest + np.array([0.0, 0.0, body.radius]), angle)


def require_flat(body: Body) -> None:
    """Raise a `ValueError` for a body that is not flat at rest."""
    height = float(np.ptp(body.rest[:, 2]))
    if height > 2 * body.material.thickness + BUMPS * body.size:
        raise ValueError(
            f"the {body.name} is {height:.3g} m high at rest, and does not lie flat. Press "
            f"it flat (jaxsimp.press, --press), or let it fall flat in a simulation "
            f"(jaxsimp.settle) and go on from those positions; as it stands it is at body.rest + "
            f"[0, 0, body.radius]"
        )


def require_rope(body: Body) -> None:
    """Raise a `ValueError` for a body with triangles."""
    if len(body.faces):
        raise ValueError(
            f"the {body.name} has {len(body.faces)} triangles; only a rope is laid along a line: "
            f"see goals.fold for sheets"
        )


def turn(positions: Positions, angle: float) -> Positions:
    """Positions turned about the vertical through the origin, shape (N, 3).

    Args:
        positions: shape (N, 3), metres.
        angle: counter-clockwise seen from above, radians.

    Raises:
        ValueError: if an array or a number is none.
    """
    angle = require_number("angle", angle, -1e6, 1e6, "radians")
    positions = require_rows("positions", positions, 3)
    cos, sin = np.cos(angle), np.sin(angle)
    return positions @ np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])


def polyline(body: Body, corners: Float[np.ndarray, "M 2"]) -> Positions:
    """A rope laid along a polyline on the table, shape (N, 3).

    Particles are evenly spaced over the length of the polyline, which may differ from the rest
    length: a shorter line is a slack rope.

    Args:
        body: a rope.
        corners: x and y of the corners in order, at least two, metres.

    Raises:
        ValueError: if the body is no rope, or the polyline has fewer than two corners or no length.
    """
    require_rope(body)
    corners = require_rows("corners", corners, 2)
    if len(corners) < 2:
        raise ValueError(f"corners has {len(corners)} rows; give at least 2, of x and y")
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    if not 0 < arc[-1] < np.inf:
        raise ValueError(
            f"the polyline is {arc[-1]:g} m long; give at least two corners that are apart"
        )
    along = np.linspace(0.0, arc[-1], body.num_particles)
    xy = [np.interp(along, arc, corners[:, axis]) for axis in range(2)]
    return np.stack([*xy, np.full(body.num_particles, body.radius)], axis=1)


def straight(body: Body, length: float | None = None) -> Positions:
    """A straight rope along x, centred, shape (N, 3).

    Args:
        body: a rope.
        length: distance of the ends, metres; the rest length by default.

    Raises:
        ValueError: if the body is no rope, or the length none.
    """
    length = body.size if length is None else require_number("length", length, 1e-3, LARGEST, "m")
    half = length / 2
    return polyline(body, np.array([[-half, 0.0], [half, 0.0]]))


def letter(body: Body, name: str, slack: float = 0.0) -> Positions:
    """A rope laid as a letter: "C", "M", "O", "S" or "U", upright along y, centred.

    Bows are arcs of circles. An O is open by 10 degrees at its top.

    Args:
        body: a rope.
        name: name of the letter.
        slack: fraction of the rest length by which the letter is shorter than the rope, below 1.

    Raises:
        ValueError: if the body is no rope, the letter is unknown, or the slack is not from 0 to
            below 1.
    """
    require_choice("letter", name, _LETTERS)
    return _laid_along(body, _LETTERS[name](), slack)


def crossed_triangle(body: Body, slack: float = 0.0, tail: float = 0.5) -> Positions:
    """A rope laid as an equilateral triangle whose two ends cross at the top and continue.

    Args:
        body: a rope.
        slack: fraction of the rest length by which the line is shorter than the rope, below 1.
        tail: length of an end beyond the crossing, as a multiple of the triangle's side.

    Raises:
        ValueError: if the body is no rope, the slack is not from 0 to below 1, or the tail not
            above zero.
    """
    tail = require_number("tail", tail, 1e-3, 1e3, "times the triangle's side")
    left, right, top = np.array([[-0.5, 0.0], [0.5, 0.0], [0.0, np.sqrt(3) / 2]])
    ends = [top + tail * (top - corner) for corner in (right, left)]
    line = np.stack([ends[0], right, left, ends[1]])
    return lift_crossings(body, _laid_along(body, line, slack))


def lift_crossings(body: Body, positions: Positions) -> Positions:
    """A rope on the table, its later particles lifted over earlier ones where it crosses itself.

    At the crossing the upper part is a thickness (twice the radius) above the lower; it descends
    to its own height within two particle spacings on either side.

    Args:
        body: a rope.
        positions: shape (N, 3), metres.

    Raises:
        ValueError: if the body is no rope, or the positions are not those of its particles.
    """
    require_rope(body)
    positions = require_rows("positions", positions, 3)
    require_shape("positions", positions, body.rest.shape, "one row for each particle of the rope")
    lifted = positions.copy()
    index = np.arange(len(positions))
    steps = np.diff(positions[:, :2], axis=0)
    for second in range(2, len(steps)):
        away = positions[second, :2] - positions[: second - 1, :2]
        first_step, second_step = steps[: second - 1], steps[second]
        # Fractions of both steps at which their lines cross; parallel lines do not. A crossing at
        # a particle is found at least once for any rounding.
        area = _cross_product(first_step, second_step)
        lengths = np.linalg.norm(first_step, axis=1) * np.linalg.norm(second_step)
        parallel = np.abs(area) <= 1e-9 * lengths
        area = np.where(parallel, 1.0, area)
        on_first = _cross_product(away, second_step) / area
        on_second = _cross_product(away, first_step) / area
        both = np.stack([on_first, on_second])
        crosses = ((both > -1e-9) & (both < 1 + 1e-9)).all(axis=0) & ~parallel
        for first in np.flatnonzero(crosses):
            share = on_first[first]
            below = (1 - share) * lifted[first, 2] + share * lifted[first + 1, 2]
            # Full height at the ends of the upper step, zero three particles away.
            apart = np.abs(index - second - on_second[first])
            weight = np.clip((3 - apart) / 2, 0.0, 1.0)
            height = positions[:, 2] + weight * (below + 2 * body.radius - positions[:, 2])
            later = index > first + 1
            lifted[later, 2] = np.maximum(lifted[later, 2], height[later])
    return lifted


def _laid_along(body: Body, line: np.ndarray, slack: float) -> Positions:
    """A rope along a line of any size, scaled to the rope's length and centred."""
    require_rope(body)
    slack = require_number("slack", slack, 0.0, 0.999, "of the rest length")
    length = np.linalg.norm(np.diff(line, axis=0), axis=1).sum()
    # Rest lengths between neighbours: a rope at rest may be curved.
    rest_length = np.linalg.norm(np.diff(body.rest, axis=0), axis=1).sum()
    middle = (line.min(axis=0) + line.max(axis=0)) / 2
    return polyline(body, (line - middle) * ((1 - slack) * rest_length / length))


def _arc(centre: tuple[float, float], radius: float, start: float, end: float) -> np.ndarray:
    """Points of an arc from one angle to another, degrees, half a degree apart."""
    angle = np.deg2rad(np.linspace(start, end, 1 + int(2 * abs(end - start))))
    return np.array(centre) + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _s() -> np.ndarray:
    upper = _arc((0.0, 1.0), 1.0, 0.0, 270.0)
    return np.concatenate([upper, _arc((0.0, -1.0), 1.0, 90.0, -180.0)[1:]])


def _u() -> np.ndarray:
    bow = _arc((0.0, 0.0), 1.0, 180.0, 360.0)
    return np.concatenate([[[-1.0, 2.0]], bow, [[1.0, 2.0]]])


_LETTERS = {
    "C": lambda: _arc((0.0, 0.0), 1.0, 45.0, 315.0),
    "M": lambda: np.array([[-1.0, -1.0], [-1.0, 1.0], [0.0, 0.0], [1.0, 1.0], [1.0, -1.0]]),
    "O": lambda: _arc((0.0, 0.0), 1.0, 95.0, 445.0),
    "S": _s,
    "U": _u,
}


def _cross_product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
