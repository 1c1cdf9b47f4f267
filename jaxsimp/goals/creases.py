"""Lines of folds, and where the flat body starts, fitted to all particles of a goal together.

Points are complex numbers, x + iy.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Complex, Float

from jaxsimp.goals.orders import Order
from jaxsimp.goals.panels import Panels

OUTLIER = 0.02
"""Distance from which a particle pulls less on the lines, relative to the body's size: particles of
parts too small for a panel are far from where their panel says."""
EXACT = 1e-9
"""Noise of goals without any, relative to the body's size."""
NEAR_ROW = 0.4
"""Distance of a line from particles that may be its row, in edges."""
LEAST_ROW = 4
STRAIGHT = 1e-6
"""Width of a row, relative to the body's size: as of a crease in `jaxsimp.goals.folds`."""
AS_LIKELY = 16.0
"""Most that a row may add to the squared misfit, in variances: by chance it adds more once in 3000
times."""

Moves = Sequence[Bool[np.ndarray, " N"]]
Place = Complex[np.ndarray, " N"]


@dataclass(frozen=True)
class Line:
    """A line on the table: by a point and its direction, or through two particles.

    Attributes:
        point: a point on it, metres.
        direction: its direction.
        row: ids of two particles on it, which then define it.
    """

    point: complex
    direction: complex
    row: tuple[int, int] | None = None

    def at(self, place: Place) -> tuple[complex, complex]:
        """Point and direction, with the particles at a place."""
        if self.row is None:
            return self.point, self.direction
        first, second = place[list(self.row)]
        return complex(first + second) / 2, complex((second - first) / abs(second - first))


@dataclass(frozen=True)
class Creases:
    """A flat start and lines, in order of the folds.

    Attributes:
        angle: angle by which the body at rest is turned, radians.
        shift: by which it is then moved, metres.
        lines: line of each fold.
    """

    angle: float
    shift: complex
    lines: tuple[Line, ...]

    def stages(self, rest: Place, moves: Moves) -> Iterator[Place]:
        """The particles at the start, and after each fold.

        Args:
            rest: the particles at rest, shape (N,), metres.
            moves: for each fold true for the particles that it turns over, shape (N,).
        """
        place = np.exp(1j * self.angle) * rest + self.shift
        yield place
        for line, own in zip(self.lines, moves, strict=True):
            point, direction = line.at(place)
            place = np.where(own, point + direction**2 * (place - point).conj(), place)
            yield place

    def changed(self, values: Float[np.ndarray, " V"], scale: float) -> "Creases":
        """Lines turned about their points and moved to the left, after a change of the start."""
        lines = []
        for line, (angle, offset) in zip(self.lines, values[3:].reshape(-1, 2), strict=True):
            direction = line.direction * complex(np.exp(1j * angle))
            point = line.point + 1j * direction * scale * float(offset)
            lines.append(replace(line, point=point, direction=direction))
        shift = self.shift + scale * complex(values[1], values[2])
        return Creases(self.angle + float(values[0]), shift, tuple(lines))

    def on_row(self, index: int, row: tuple[int, int]) -> "Creases":
        """The same with one line through two particles."""
        lines = list(self.lines)
        lines[index] = replace(lines[index], row=row)
        return replace(self, lines=tuple(lines))


def fit_creases(panels: Panels, moves: Moves, first: Creases) -> Creases:
    """Start and lines that carry the particles from rest to the goal.

    Least squares with a bounded pull of outliers. Folds of a grid often lie on a row of particles,
    which form the crease; beside it by noise, a line would send each of them to one side or the
    other. Lines are therefore put on rows where this hardly adds to the misfit.

    Args:
        panels: the panels of the goal.
        moves: for each fold true for the particles that it turns over, shape (N,).
        first: a first guess.
    """
    best, least = _fitted(panels, moves, first)
    variance = max(least / (2 * len(panels.rest)), EXACT**2)
    for index in range(len(moves)):
        for row in _rows(panels, moves, best, index):
            found, misfit = _fitted(panels, moves, best.on_row(index, row))
            if misfit - least < AS_LIKELY * variance:
                best, least = found, misfit
                break
    return best


def guess_creases(panels: Panels, order: Order) -> Creases:
    """Start and lines as panels have them: the start of the largest, points near the middle."""
    middle, largest = complex(panels.goal.mean()), int(panels.counts.argmax())
    lines = []
    for step in order.steps[::-1]:
        along = ((middle - step.point) * step.direction.conjugate()).real
        lines.append(Line(complex(step.point + along * step.direction), step.direction))
    turn, shift = order.maps.turn[largest], order.maps.shift[largest]
    return Creases(float(np.angle(turn)), complex(shift), tuple(lines))


def _fitted(panels: Panels, moves: Moves, first: Creases) -> tuple[Creases, float]:
    """The creases nearest to the goal, and the squared misfit, relative to the body's size."""
    from scipy.optimize import least_squares

    scale = float(np.abs(panels.rest).max())

    def misfit(values: Float[np.ndarray, " V"]) -> Float[np.ndarray, " _"]:
        *_, place = first.changed(values, scale).stages(panels.rest, moves)
        off = (place - panels.goal) / scale
        return np.concatenate([off.real, off.imag])

    count = 3 + 2 * len(first.lines)
    # By matrix-free steps: a decomposition of so tall a matrix waits for threads on a busy machine.
    found = least_squares(
        misfit, np.zeros(count), loss="soft_l1", f_scale=OUTLIER, tr_solver="lsmr"
    )
    return first.changed(found.x, scale), 2 * float(found.cost)


def _rows(panels: Panels, moves: Moves, creases: Creases, index: int) -> Iterator[tuple[int, int]]:
    """Ends of rows of particles near a line, in the direction of the line, the longest row first.

    All particles near the line of a layer, which earlier folds moved alike, are in one row.
    """
    place = list(creases.stages(panels.rest, moves))[index]
    point, direction = creases.lines[index].at(place)
    away = (place - point) * direction.conjugate()
    near = np.flatnonzero(np.abs(away.imag) < NEAR_ROW * panels.edge)
    history = np.zeros(len(place), dtype=int)
    for number, own in enumerate(moves[:index]):
        history += own << number
    layers = [near[history[near] == one] for one in np.unique(history[near])]
    for row in sorted(layers, key=len, reverse=True):
        if len(row) >= LEAST_ROW and _is_straight(panels.rest[row]):
            along = away.real[row]
            yield int(row[along.argmin()]), int(row[along.argmax()])


def _is_straight(points: Place) -> bool:
    away = points - points.mean()
    direction = np.sqrt(np.sum(away**2))  # the principal axis
    width = np.abs((away * direction.conjugate()).imag).max() / max(abs(direction), 1e-300)
    return bool(width < STRAIGHT * np.abs(away).max())
