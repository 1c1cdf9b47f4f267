"""Outlines of sheets in the plane, turned, mirrored and moved onto each other."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Complex, Float

from jaxsimp.bodies.topology import Faces, boundary_edges

SAMPLES = 240
"""Points of an outline that are compared."""
TURNS, STEPS = 24, 24
"""Turns to start from, and steps of each: the first half moves points to the nearest points of the
other outline, which converges from afar, the second half to the lines there, which converges fast.
"""


@dataclass(frozen=True, eq=False)
class Sheet:
    """A surface in the plane: points x + iy, and triangles."""

    points: Complex[np.ndarray, " V"]
    faces: Faces

    def outline(self) -> tuple[Complex[np.ndarray, " S"], Complex[np.ndarray, " S"]]:
        """Points along all boundaries, evenly spaced, and the direction of the boundary there."""
        starts, ends = self.points[boundary_edges(self.faces)[0].T]
        length = np.abs(ends - starts)
        arc = np.concatenate([[0.0], np.cumsum(length)])
        at = (np.arange(SAMPLES) + 0.5) / SAMPLES * arc[-1]
        edge = np.searchsorted(arc, at) - 1
        along = (ends - starts)[edge] / length[edge]
        return starts[edge] + (at - arc[edge]) * along, along

    def middle(self) -> complex:
        """Centre of the area."""
        area, (a, b, c) = self.areas(), self.points[self.faces.T]
        return complex((area * (a + b + c)).sum() / (3 * area.sum()))

    def areas(self) -> Float[np.ndarray, " F"]:
        """Areas of the triangles, below zero for those that face down."""
        a, b, c = self.points[self.faces.T]
        return ((b - a).conj() * (c - a)).imag / 2


def fit_outlines(rest: Sheet, sheet: Sheet, alike: float) -> list[Complex[np.ndarray, " N"]]:
    """Places of a body in a layout, for each way in which the outlines fit; the best one first.

    Args:
        rest: the body at rest.
        sheet: the layout.
        alike: misfit above the least of fits that are as good, metres.
    """
    fits = []
    for mirrored in (False, True):
        own = Sheet(rest.points.conj() if mirrored else rest.points, rest.faces)
        fits += list(_fits(own, sheet))
    fits.sort(key=lambda fit: fit[0])
    ways: list[np.ndarray] = []
    for misfit, place in fits:
        apart = [np.abs(place - other).max() > 10 * alike for other in ways]
        if misfit <= fits[0][0] + alike and all(apart):
            ways.append(place)
    return ways


def _fits(own: Sheet, sheet: Sheet) -> Iterator[tuple[float, Complex[np.ndarray, " N"]]]:
    """From each turn: misfit of the outlines, and the body's place."""
    inner, outer = own.outline(), sheet.outline()
    here, there = _tree(inner[0]), _tree(outer[0])
    for angle in 2 * np.pi * np.arange(TURNS) / TURNS:
        turn = complex(np.exp(1j * angle))
        shift = sheet.middle() - turn * own.middle()
        for step in range(STEPS):
            near, to = _query(there, turn * inner[0] + shift)
            back, away = _query(here, (outer[0] - shift) / turn)
            first = np.concatenate([inner[0], inner[0][away]])
            second = np.concatenate([outer[0][to], outer[0]])
            along = np.concatenate([outer[1][to], outer[1]])
            if step < STEPS // 2:
                turn, shift = _to_points(first, second)
            else:
                turn, shift = _to_lines(turn, shift, first, second, along)
        misfit = np.sqrt(np.mean(np.concatenate([near, abs(turn) * back]) ** 2))
        yield float(misfit), turn * own.points + shift


def _tree(points: np.ndarray) -> Any:
    from scipy.spatial import cKDTree

    return cKDTree(np.stack([points.real, points.imag], axis=1))


def _query(tree: Any, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return tree.query(np.stack([points.real, points.imag], axis=1))


def _to_points(first: np.ndarray, second: np.ndarray) -> tuple[complex, complex]:
    """Turn and shift that lay the first points nearest to the second ones."""
    middle, target = first.mean(), second.mean()
    along = complex(np.vdot(first - middle, second - target))
    turn = along / abs(along)
    return turn, complex(target - turn * middle)


def _to_lines(
    turn: complex, shift: complex, first: np.ndarray, second: np.ndarray, along: np.ndarray
) -> tuple[complex, complex]:
    """Turn, with a change of size, and shift, a step nearer to the lines through second points."""
    now, normal = turn * first + shift, 1j * along
    # The change is a factor 1 + a + ib and a shift c + id; its distance from the lines is linear.
    change = normal.conj()[:, None] * np.stack([now, 1j * now, 0 * now + 1, 0 * now + 1j], axis=1)
    away = (normal.conj() * (now - second)).real
    a, b, c, d = np.linalg.lstsq(change.real, -away)[0]
    factor = 1 + complex(a, b)
    return factor * turn, factor * shift + complex(c, d)


def in_space(points: Complex[np.ndarray, " V"]) -> Float[np.ndarray, "V 3"]:
    """Points of the plane as x, y and z = 0, shape (V, 3)."""
    return np.stack([points.real, points.imag, np.zeros(len(points))], axis=1)


def outside(points: np.ndarray, sheet: Sheet) -> float:
    """Largest distance of points from a surface in the plane."""
    import igl

    squared, _, _ = igl.point_mesh_squared_distance(
        in_space(points), in_space(sheet.points), sheet.faces
    )
    return float(np.sqrt(squared.max()))
