"""Folds: parts of a body turned over about lines, one after another, layer upon layer."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from jaxsimp.bodies import Body
from jaxsimp.bodies.garments import Garment
from jaxsimp.bodies.topology import boundary_edges, half_edges
from jaxsimp.checks import as_reals, require_choice, require_rows, require_shape, told
from jaxsimp.goals.shapes import Positions, flat, require_flat


@dataclass(frozen=True, eq=False)
class Fold:
    """A line on the table, and the part of the body to turn over about it.

    Attributes:
        point: x and y of a point on the line, metres.
        direction: x and y of the line's direction; particles to its left are turned over.
        part: true for particles that may be turned over, shape (N,); all by default.
    """

    point: Float[np.ndarray, " 2"]
    direction: Float[np.ndarray, " 2"]
    part: Bool[np.ndarray, " N"] | None = None


def fold_sequence(
    body: Body, folds: Iterable[Fold], positions: Positions | None = None
) -> Positions:
    """Positions after one fold after another, shape (N, 3), metres.

    Args:
        body: the body whose thickness separates the layers.
        folds: in order.
        positions: positions before the folds, shape (N, 3), metres; the body flat by default.

    Raises:
        ValueError: if a fold is no `Fold`, or invalid (see `fold`).
    """
    positions = flat(body) if positions is None else positions
    for one in _require_folds(folds):
        positions = fold(body, positions, one.point, one.direction, part=one.part)
    return positions


def _require_folds(folds: Iterable[Fold]) -> list[Fold]:
    if not np.iterable(folds):
        raise ValueError(f"folds is {told(folds)}; give a list of Fold(point, direction)")
    listed = list(folds)
    for one in listed:
        if not isinstance(one, Fold):
            raise ValueError(f"a fold is {told(one)}; give a list of Fold(point, direction)")
    return listed


def fold(
    body: Body,
    positions: Positions,
    point: Float[np.ndarray, " 2"],
    direction: Float[np.ndarray, " 2"],
    *,
    part: Bool[np.ndarray, " N"] | None = None,
) -> Positions:
    """Fold about a line: turn the particles to its left over onto its right side.

    The folded layers lie in reversed order, the lowest a thickness (twice the radius) above the
    highest particle that they cover, or on the table if they cover nothing. Particles on the line
    form the crease, and rise by a radius.

    Args:
        body: the body whose thickness separates the layers.
        positions: positions before the fold, shape (N, 3), metres.
        point: x and y of a point on the line, metres.
        direction: x and y of the line's direction, of any length above zero.
        part: true for particles that may be turned over, shape (N,), as a sleeve or the upper
            layers; all by default.

    Raises:
        ValueError: if the direction has no length, the line is not finite, `part` is no mask of
            the particles, or the body is not flat at rest and not in `positions` either.
    """
    point, direction = _two("point", point), _two("direction", direction)
    norm = np.linalg.norm(direction)
    if not 0 < norm < np.inf:
        raise ValueError(f"direction is {direction.tolist()}; give a finite vector with a length")
    positions = _check_positions(body, positions)
    part = None if part is None else _check_part(body, part)
    left = np.array([-direction[1], direction[0]]) / norm
    distance = (positions[:, :2] - point) @ left
    # A particle whose distance from the line is only rounding is on the crease.
    side = np.where(np.abs(distance) < 1e-6 * body.size, 0.0, np.sign(distance))
    moves, creases = side > 0, side == 0
    if part is not None:
        moves, creases = moves & part, creases & part
    if not moves.any():
        return positions.copy()
    folded = positions.copy()
    folded[:, :2] -= np.where(moves, 2 * distance, 0.0)[:, None] * left
    lowest = _height_covered(body, folded, moves) + body.radius
    z = positions[:, 2]
    folded[:, 2] = np.select([moves, creases], [lowest + z[moves].max() - z, z + body.radius], z)
    return folded


def _two(name: str, values: object) -> np.ndarray:
    """Finite x and y."""
    reals = as_reals(values)
    if reals is None or reals.shape != (2,) or not np.isfinite(reals).all():
        given = values.tolist() if isinstance(values, np.ndarray) else values
        raise ValueError(f"{name} is {given}; give finite coordinates x and y, in metres")
    return reals


def _check_positions(body: Body, positions: object) -> np.ndarray:
    """Positions of the body that can be folded: it lies flat at rest, or lower than at rest."""
    rows = require_rows("positions", positions, 3)
    require_shape("positions", rows, body.rest.shape, f"one row for each particle of {body.name}")
    if np.ptp(rows[:, 2]) > np.ptp(body.rest[:, 2]) / 2:
        require_flat(body)
    return rows


def _check_part(body: Body, part: object) -> np.ndarray:
    """A mask of the particles."""
    mask, count = np.asarray(part), body.num_particles
    if mask.shape != (count,) or mask.dtype != bool:
        raise ValueError(
            f"part is an array of {mask.dtype}, shape {mask.shape}; give true or false for each of "
            f"{count} particles"
        )
    return mask


def rectangle_folds(body: Body, name: str) -> tuple[Fold, ...]:
    """Folds of a flat rectangular cloth, its sides along x and y, centred.

    - "side": in half, the side at the lower x onto the other.
    - "diagonal": in half along the diagonal from the corner of highest x and lowest y.
    - "quarter": in half along x, then along y.
    - "letter": in thirds along x, the side at the lower x first, the other one on top.
    - "four_corners": each corner of a square to the centre.

    Args:
        body: the cloth.
        name: name of the folds.

    Raises:
        ValueError: if the name is unknown, or the cloth is not square for "four_corners".
    """
    require_choice("fold", name, ("side", "diagonal", "quarter", "letter", "four_corners"))
    x, y = np.ptp(body.rest[:, :2], axis=0) / 2
    side = _fold_about((0.0, 0.0), (0.0, 1.0))
    if name == "side":
        return (side,)
    if name == "diagonal":
        return (_fold_about((0.0, 0.0), (-x, y)),)
    if name == "quarter":
        return side, _fold_about((0.0, 0.0), (1.0, 0.0))
    if name == "letter":
        return _fold_about((-x / 3, 0.0), (0.0, 1.0)), _fold_about((x / 3, 0.0), (0.0, -1.0))
    if not np.isclose(x, y, rtol=0.01):
        raise ValueError(
            f"the {body.name} is {2 * x:.4g} m by {2 * y:.4g} m; only the corners of a square are "
            f"folded to the centre: choose other folds"
        )
    # The corner lies to the left of the line through the middles of its sides.
    return tuple(
        _fold_about((a * x / 2, b * y / 2), (b, -a))
        for a, b in ((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0))
    )


def sleeves_in(shirt: Garment) -> tuple[Fold, Fold]:
    """Folds of both sleeves of a flat T-shirt inwards about the lines of its sides, left first.

    Raises:
        ValueError: if the garment has no sleeves.
    """
    left, right = _places(shirt, "left_armpit", "right_armpit")
    x = shirt.body.rest[:, 0]
    return (
        Fold(left, np.array([0.0, 1.0]), part=x <= left[0]),
        Fold(right, np.array([0.0, -1.0]), part=x >= right[0]),
    )


def leg_over_leg(trousers: Garment) -> tuple[Fold]:
    """Fold of the left leg of flat trousers onto the right one, about the middle line.

    Raises:
        ValueError: if the garment has no legs.
    """
    (crotch,) = _places(trousers, "crotch")
    return (Fold(crotch, np.array([0.0, 1.0])),)


def _height_covered(body: Body, folded: np.ndarray, moves: np.ndarray) -> float:
    """Height of the highest particle that the moved particles cover, metres; 0 for the bare table.

    A particle is covered if, seen from above, it is within 3/4 of the usual edge of a moved
    particle: on a square grid no place is farther than 0.71 from a particle, on equilateral
    triangles 0.58. A moved part does not cover a part that it only borders on, as at the corners
    of a cloth folded to its centre: moved particles on a surface's boundary do not count, if other
    particles moved.
    """
    from scipy.spatial import cKDTree

    inner = moves.copy()
    inner[boundary_edges(body.faces)[0]] = False
    covering, still = folded[inner if inner.any() else moves], folded[~moves]
    if not len(still):
        return 0.0
    distance, _ = cKDTree(covering[:, :2]).query(still[:, :2])
    covered = still[distance <= 0.75 * _usual_edge(body), 2]
    return float(covered.max() + body.radius) if len(covered) else 0.0


def _usual_edge(body: Body) -> float:
    """Median length of the triangles' edges, metres; the spacing of a rope."""
    if not len(body.faces):
        return body.spacing
    first, second = half_edges(body.faces)[0].T
    return float(np.median(np.linalg.norm(body.rest[second] - body.rest[first], axis=1)))


def _fold_about(point: tuple[float, float], direction: tuple[float, float]) -> Fold:
    return Fold(np.array(point), np.array(direction))


def _places(garment: Garment, *names: str) -> list[np.ndarray]:
    """Positions on the table of landmarks of a garment at rest."""
    if not isinstance(garment, Garment):
        raise ValueError(
            f"a {type(garment).__name__} is given; give a jaxsimp.Garment, which names parts of "
            f"its body: that of js.t_shirt or js.trousers, or of an own mesh "
            f"Garment(body, landmarks, mirror, opposite)"
        )
    missing = [name for name in names if name not in garment.landmarks]
    if missing:
        raise ValueError(
            f"the {garment.body.name} has no {missing[0]}; it has "
            f"{', '.join(garment.landmarks) or 'no landmarks'}: add it, or use goals.fold"
        )
    return [garment.body.rest[garment.landmarks[name], :2] for name in names]
