"""The folds of an order of panels, carried out, and how far that is from the goal."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsimp.bodies import Body
from jaxsimp.goals.creases import Creases, Moves, fit_creases, guess_creases
from jaxsimp.goals.folds import Fold, fold
from jaxsimp.goals.orders import Order
from jaxsimp.goals.panels import Panels
from jaxsimp.goals.shapes import Positions, flat

RINGS = 2
"""How far from its panels, in edges, a fold takes along what lies left of the line: a particle near
a crease may be counted to either side."""

ROUNDS = 3
"""Largest number of times that lines are fitted to what they turned over."""
BETTER = 0.98
"""Squared distance from the goal, relative to that before, above which it is not done again."""
MOST_CHOICES = 8
"""Largest number of choices, of whole or part at each fold, that are carried out."""


@dataclass(frozen=True, eq=False)
class Refolding:
    """Folds from a flat start, and what they give.

    Attributes:
        start: the flat body, shape (N, 3), metres.
        folds: in order.
        states: positions after each fold, shape (N, 3), metres.
        off: the end minus the goal, shape (N, 3), metres; 0 for the height of particles at creases,
            which may be counted to either layer.
        at_crease: true for particles with a neighbour in another panel, shape (N,).
        label: index of each particle's panel, shape (N,).
    """

    start: Positions
    folds: tuple[Fold, ...]
    states: tuple[Positions, ...]
    off: Float[np.ndarray, "N 3"]
    at_crease: Bool[np.ndarray, " N"]
    label: Int[np.ndarray, " N"]

    @property
    def end(self) -> Positions:
        """Positions after the last fold, shape (N, 3), metres."""
        return self.states[-1] if self.states else self.start

    @property
    def moves(self) -> list[Bool[np.ndarray, " N"]]:
        """For each fold true for the particles that it turned over, shape (N,)."""
        before = (self.start, *self.states)
        return [(a[:, :2] != b[:, :2]).any(axis=1) for a, b in pairwise(before)]

    @property
    def squared(self) -> float:
        """Sum of the squared distances from the goal, square metres."""
        return float(np.sum(self.off**2))

    @property
    def beside(self) -> float:
        """Largest distance from the goal in the plane, metres; that of creases counts two thirds.

        The ends of creases spring open in settled goals.
        """
        distance = np.linalg.norm(self.off[:, :2], axis=1)
        return float(np.where(self.at_crease, 2 / 3 * distance, distance).max())

    @property
    def heights(self) -> Float[np.ndarray, " _"]:
        """Median height above that in the goal of each panel wider than its creases, metres."""
        own, height = self.label[~self.at_crease], self.off[~self.at_crease, 2]
        found = [float(np.median(height[own == one])) for one in np.unique(own)]
        return np.array(found or [0.0])


def refold(body: Body, goal: Positions, panels: Panels, order: Order) -> Refolding:
    """The folds of an order, fitted to the goal and carried out.

    A fold turns over all that lies left of its line, or its panels alone: of these the choice that
    gives the goal best. The lines are then fitted anew to the particles that they did turn over,
    some of which the panels may count wrongly.
    """
    parts = [step.moved[panels.label] for step in order.steps[::-1]]
    creases = fit_creases(panels, parts, guess_creases(panels, order))
    best = _carried_out(body, goal, panels, creases, parts)
    for _ in range(ROUNDS):
        creases = fit_creases(panels, best.moves, creases)
        after = _carried_out(body, goal, panels, creases, parts)
        if after.squared > BETTER * best.squared:
            break
        best = after
    return best


def _carried_out(
    body: Body, goal: Positions, panels: Panels, creases: Creases, parts: Moves
) -> Refolding:
    start = flat(body, creases.angle)
    start[:, :2] += creases.shift.real, creases.shift.imag
    found: list[_Folded] = [((), (start,))]
    for index, part in enumerate(parts):
        own = _dilated(panels, part)
        found = [longer for one in found for longer in _folded(body, one, creases, index, own)][
            :MOST_CHOICES
        ]
    results = [_compared(panels, goal, one) for one in found]
    return min(results, key=lambda one: one.squared)


_Folded = tuple[tuple[Fold, ...], tuple[Positions, ...]]  # the folds; the start and the states


def _folded(
    body: Body,
    before: _Folded,
    creases: Creases,
    index: int,
    own: Bool[np.ndarray, " N"],
) -> Iterator[_Folded]:
    """One fold more: of all that is left of its line, and of a part if that is not the same."""
    folds, states = before
    positions = states[-1]
    line = creases.lines[index].at(positions[:, 0] + 1j * positions[:, 1])
    point, direction = (np.array([value.real, value.imag]) for value in line)
    left = (positions[:, :2] - point) @ np.array([-direction[1], direction[0]])
    parts = [None, own] if (~own & (left > 0)).any() else [None]
    for part in parts:
        after = fold(body, positions, point, direction, part=part)
        yield (*folds, Fold(point, direction, part)), (*states, after)


def _dilated(panels: Panels, own: Bool[np.ndarray, " N"]) -> Bool[np.ndarray, " N"]:
    """Particles and those within `RINGS` edges of them."""
    own = own.copy()
    for _ in range(RINGS):
        own[panels.edges[own[panels.edges].any(axis=1)]] = True
    return own


def _compared(panels: Panels, goal: Positions, folded: _Folded) -> Refolding:
    folds, (start, *states) = folded
    off = (states[-1] if states else start) - goal
    across = np.diff(panels.label[panels.edges], axis=1)[:, 0] != 0
    at_crease = np.zeros(len(off), dtype=bool)
    at_crease[panels.edges[across]] = True
    off[at_crease, 2] = 0.0
    return Refolding(start, folds, tuple(states), off, at_crease, panels.label)
