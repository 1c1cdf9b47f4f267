"""Goals with known key points: folds and polylines, sharp or rounded, with noise.

The key points of a fold are the corners of the outline, and the intersections of fold lines with
the outline and each other; those of a polyline are its ends and corners.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from jaxsimp.bodies import Body
from jaxsimp.goals import Positions
from jaxsimp.simplification import KeyPoints


class Line(NamedTuple):
    """A fold line: the part on its left is turned over onto the part on its right.

    Attributes:
        point: x and y of a point on the line, in half extents of the cloth.
        direction: x and y of its direction, in half extents.
        height: height of the crease, in gaps of layers: halfway between the layers that it joins.
    """

    point: tuple[float, float]
    direction: tuple[float, float]
    height: float = 1.0


class IdealFold(NamedTuple):
    """A fold of a rectangular cloth.

    Attributes:
        lines: fold lines in the order of folding, each in the position of the cloth at that time.
        points: key points besides the four corners, in half extents of the cloth at rest.
    """

    lines: tuple[Line, ...]
    points: tuple[tuple[float, float], ...]


CORNERS = ((-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0))
THIRD = 1 / 3
FOLDS = {
    "flat": IdealFold((), ()),
    "side, x": IdealFold((Line((0, 0), (0, 1)),), ((0, -1), (0, 1))),
    "side, y": IdealFold((Line((0, 0), (1, 0)),), ((-1, 0), (1, 0))),
    "diagonal": IdealFold((Line((0, 0), (1, 1)),), ()),
    "other diagonal": IdealFold((Line((0, 0), (1, -1)),), ()),
    "letter": IdealFold(
        (Line((-THIRD, 0), (0, 1)), Line((THIRD, 0), (0, -1), height=1.5)),
        ((-THIRD, -1), (-THIRD, 1), (THIRD, -1), (THIRD, 1)),
    ),
    "quarter": IdealFold(
        (Line((0, 0), (0, 1)), Line((0, 0), (1, 0), height=2.0)),
        ((0, -1), (0, 1), (0, 0), (-1, 0), (1, 0)),
    ),
    "four corners": IdealFold(
        (
            Line((1, 0), (1, -1)),
            Line((0, 1), (1, 1)),
            Line((-1, 0), (-1, 1)),
            Line((0, -1), (-1, -1)),
        ),
        ((1, 0), (0, 1), (-1, 0), (0, -1)),
    ),
    "side, off centre": IdealFold((Line((-0.3, 0), (0, 1)),), ((-0.3, -1), (-0.3, 1))),
    "corner": IdealFold((Line((1, 0.2), (0.8, -0.8)),), ((1, 0.2), (0.2, 1))),
    "diagonal, off centre": IdealFold((Line((1, -0.3), (1, -1)),), ((1, -0.3), (-0.3, 1))),
    "through a corner": IdealFold((Line((-1, -1), (2, 0.8)),), ((1, -0.2),)),
}


@dataclass(frozen=True, eq=False)
class IdealGoal:
    """A goal and its true key points.

    Attributes:
        name: name of the fold or polyline.
        body: the cloth.
        goal: goal positions, shape (N, 3), metres.
        true_points: rest coordinates of the true key points, shape (K, 3), metres.
    """

    name: str
    body: Body
    goal: Float[np.ndarray, "N 3"]
    true_points: Float[np.ndarray, "K 3"]


def ideal_goal(body: Body, name: str, *, gap: float = 0.004, rounding: float = 0.0) -> IdealGoal:
    """A folded cloth with its key points.

    Args:
        body: a rectangular cloth.
        name: one of `FOLDS`.
        gap: distance of adjacent layers, metres.
        rounding: lateral radius of the creases, metres; 0 for sharp ones.
    """
    half = np.ptp(body.rest, axis=0) / 2
    goal = body.rest + np.array([0.0, 0.0, gap / 2])
    for positions in partial_folds(body, name, gap=gap, rounding=rounding):
        goal = positions
    true_points = half * np.array([(x, y, 0.0) for x, y in CORNERS + FOLDS[name].points])
    return IdealGoal(name, body, goal, true_points)


def partial_folds(
    body: Body, name: str, *, gap: float = 0.004, rounding: float = 0.0
) -> Iterator[Float[np.ndarray, "N 3"]]:
    """Positions of a cloth after each line of a fold; for the arguments see `ideal_goal`."""
    half = np.ptp(body.rest, axis=0) / 2
    positions = body.rest + np.array([0.0, 0.0, gap / 2])
    for line in FOLDS[name].lines:
        point, direction = half[:2] * line.point, half[:2] * line.direction
        positions = rounded_fold(positions, point, direction, line.height * gap, rounding)
        yield positions


def rounded_fold(
    positions: Positions,
    point: Float[np.ndarray, " 2"],
    direction: Float[np.ndarray, " 2"],
    height: float,
    rounding: float,
) -> Positions:
    """Fold about a line, with a crease that is half an ellipse, shape (N, 3).

    The crease takes a strip about the line, pi times its radius wide; particles outside of it lie
    as after a sharp fold. Heights are mirrored too.

    Args:
        positions: positions to fold, shape (N, 3), metres.
        point: x and y of a point on the line, metres.
        direction: x and y of the line's direction.
        height: height of the line, metres: halfway between the layers that it joins.
        rounding: lateral radius of the crease, metres; 0 for a sharp one.
    """
    left = np.array([-direction[1], direction[0]]) / np.linalg.norm(direction)
    distance = (positions[:, :2] - point) @ left
    distance[np.abs(distance) < 1e-9] = 0.0
    # The turn goes from 0 to pi over the strip of the crease; a sharp crease has no strip.
    strip = np.pi * rounding / 2
    if rounding > 0:
        angle = np.clip(distance / rounding + np.pi / 2, 0.0, np.pi)
    else:
        angle = np.pi / 2 * (1 + np.sign(distance))
    across = np.where(angle < np.pi, np.minimum(distance, -strip), -distance)
    across += np.where(angle < np.pi, rounding * np.sin(angle), 0.0)
    folded = positions.copy()
    folded[:, :2] += (across - distance)[:, None] * left
    folded[:, 2] += (height - positions[:, 2]) * (1 - np.cos(angle))
    return folded


LINES: dict[str, tuple[tuple[float, float], ...]] = {
    "straight": ((0, 0), (1, 0)),
    "V": ((-1, 0), (0, 1), (1, 0)),
    "L, legs 5 to 1": ((0, 5), (0, 0), (1, 0)),
    "U, angular": ((0, 2), (0, 0), (1, 0), (1, 2)),
    "triangle 3 4 5": ((0, 0), (4, 0), (0, 3), (0, 0)),
    "crossed triangle": ((1, 1.5), (-1, -1), (1, -1), (-1, 1.5)),
    "M": ((-1, -1), (-1, 1), (0, 0), (1, 1), (1, -1)),
    "M, unequal": ((-1, -1), (-0.7, 1), (0, -0.2), (1, 1), (1.2, -0.8)),
    "zigzag": ((0, 0), (1, 1), (2, 0), (3, 1), (4, 0), (5, 1)),
}
"""Corners of polylines for ropes, of any size; the corners are the key points."""


def ideal_line(body: Body, name: str, *, rounding: float = 0.0) -> IdealGoal:
    """A rope along a polyline as long as the rope, with its key points.

    Args:
        body: a rope.
        name: one of `LINES`.
        rounding: length of the turn on either side of a corner, metres; 0 for sharp corners.
    """
    corners = np.array(LINES[name], dtype=float)
    lengths = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    length = np.ptp(body.rest[:, 0])
    corners *= length / lengths.sum()
    ends = np.concatenate([[0.0], np.cumsum(lengths)]) * length / lengths.sum()
    along = body.rest[:, 0] - body.rest[0, 0]
    # A moving average of the sharp line rounds its corners, and does not change the rest.
    offsets = np.linspace(-rounding, rounding, 11)
    shifted = np.clip(along[:, None] + offsets, 0.0, length)
    goal = np.full(body.rest.shape, body.radius)
    for axis in range(2):
        goal[:, axis] = np.interp(shifted, ends, corners[:, axis]).mean(axis=1)
    true_points = body.rest[0] + ends[:, None] * np.array([1.0, 0.0, 0.0])
    return IdealGoal(name, body, goal, true_points)


def _white(ideal: IdealGoal, rng: np.random.Generator) -> np.ndarray:
    return rng.normal(size=ideal.goal.shape)


def _in_plane(ideal: IdealGoal, rng: np.random.Generator) -> np.ndarray:
    return rng.normal(size=ideal.goal.shape) * [1.0, 1.0, 0.0]


def _out_of_plane(ideal: IdealGoal, rng: np.random.Generator) -> np.ndarray:
    return rng.normal(size=ideal.goal.shape) * [0.0, 0.0, 1.0]


def _smooth(ideal: IdealGoal, rng: np.random.Generator) -> np.ndarray:
    """Random waves, no shorter than a third of the body."""
    waves = rng.normal(scale=2 * np.pi / ideal.body.size, size=(12, 3))
    phases = ideal.body.rest @ waves.T + rng.uniform(0, 2 * np.pi, size=12)
    return np.sin(phases) @ rng.normal(scale=np.sqrt(2 / 12), size=(12, 3))


def _wrinkles(ideal: IdealGoal, rng: np.random.Generator) -> np.ndarray:
    """One upright wave of five to ten crests."""
    turn = rng.uniform(0, 2 * np.pi)
    number = 2 * np.pi * rng.uniform(5, 10) / ideal.body.size
    along = ideal.body.rest[:, :2] @ [np.cos(turn), np.sin(turn)]
    height = np.sqrt(2) * np.sin(number * along + rng.uniform(0, 2 * np.pi))
    return height[:, None] * np.array([0.0, 0.0, 1.0])


def _outliers(ideal: IdealGoal, rng: np.random.Generator) -> np.ndarray:
    """White noise of a quarter of the level; 1 particle in 50 is off by 4 times the level."""
    noise = rng.normal(size=ideal.goal.shape) / 4
    far = rng.random(len(noise)) < 0.02
    off = rng.normal(size=noise.shape)
    off *= 4 / np.linalg.norm(off, axis=1, keepdims=True)
    return np.where(far[:, None], off, noise)


NOISES = {
    "white": _white,
    "in plane": _in_plane,
    "out of plane": _out_of_plane,
    "smooth": _smooth,
    "wrinkles": _wrinkles,
    "outliers": _outliers,
}


def add_noise(ideal: IdealGoal, kind: str, level: float, seed: int) -> IdealGoal:
    """The goal with noise; its key points are the same.

    Args:
        ideal: a goal.
        kind: one of `NOISES`.
        level: standard deviation along each noisy axis, metres; for outliers see `_outliers`.
        seed: seed of the noise.
    """
    noise = NOISES[kind](ideal, np.random.default_rng(seed))
    return IdealGoal(ideal.name, ideal.body, ideal.goal + level * noise, ideal.true_points)


def is_right(key_points: KeyPoints, ideal: IdealGoal, spacings: float = 1.5) -> bool:
    """Whether there are as many key points as true ones, each near its own at rest.

    Args:
        key_points: key points found.
        ideal: the goal with its true points.
        spacings: largest distance of a key point from the true one, in spacings of the body.
    """
    if len(key_points) != len(ideal.true_points):
        return False
    tree = cKDTree(ideal.body.rest[key_points.particles])
    distance, nearest = tree.query(ideal.true_points)
    one_each = len(set(nearest.tolist())) == len(ideal.true_points)
    return one_each and bool(distance.max() <= spacings * ideal.body.spacing)
