"""Orders in which the panels of a folded goal unfold, fold by fold, to one flat sheet.

A crease joins neighbours of opposite facing. An unfolding cuts all creases on one line, takes what
is then apart, lies on one side of the line and on top, and reflects it about the line. The search
goes through all such orders, the likeliest first: most creases, then fewest particles. Orders of
the same unfoldings lead to the same sheet and count once.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Int

from jaxsimp.bodies.topology import connected_pieces
from jaxsimp.goals.panels import Isometries, Panels

ON_LINE = 0.05
"""How far a crease may be from the line on which it is cut, relative to the extent at rest."""
BESIDE = 0.03
"""Largest fraction of the particles of what unfolds that may lie on the other side of the line."""
MOST_STATES = 1000
"""Largest number of partly unfolded states looked at."""
MOST_FOLDS = 8
"""Largest number of folds in an order."""
MOST_ORDERS = 16
"""Largest number of orders returned."""


@dataclass(frozen=True, eq=False)
class Step:
    """One unfolding: a line on the table, and the panels reflected about it.

    Attributes:
        point: x + iy of a point on the line, metres.
        direction: x + iy of the line's direction; before the fold the panels are on its left.
        moved: true for the panels that are reflected, shape (P,).
        creases: indices of the creases that are cut.
    """

    point: complex
    direction: complex
    moved: Bool[np.ndarray, " P"]
    creases: frozenset[int]

    @property
    def name(self) -> tuple[frozenset[int], frozenset[int]]:
        """The panels moved and the creases cut, to compare steps."""
        return frozenset(np.flatnonzero(self.moved).tolist()), self.creases


@dataclass(frozen=True, eq=False)
class Sheet:
    """Panels, partly unfolded.

    Attributes:
        panels: the panels of the goal.
        maps: isometries from rest to the present place.
        above: 1 where the first panel lies above the second, -1 where below, 0 where not known.
    """

    panels: Panels
    maps: Isometries
    above: Int[np.ndarray, "P P"]

    @cached_property
    def joints(self) -> list[tuple[int, int, complex]]:
        """Neighbouring panels of opposite facing in the goal, and the middle of their border."""
        return _joints(self.panels)

    def creases(self) -> list[int]:
        """Indices of the joints that are folded, those of the largest panels first."""
        counts, mirrored = self.panels.counts, self.maps.mirrored
        folded = [i for i, (p, q, _) in enumerate(self.joints) if mirrored[p] != mirrored[q]]
        return sorted(folded, key=lambda i: -min(counts[list(self.joints[i][:2])]))

    def unfolded(self, step: Step) -> "Sheet":
        """The sheet after an unfolding."""
        maps = self.maps.reflected(step.moved, step.point, step.direction)
        inside = np.outer(step.moved, step.moved)
        apart = step.moved[:, None] ^ step.moved[None]
        above = np.where(inside, -self.above, np.where(apart, 0, self.above))
        after = replace(self, maps=maps, above=above)
        after.__dict__["joints"] = self.joints
        return after


@dataclass(frozen=True, eq=False)
class Order:
    """An order of unfoldings that ends flat.

    Attributes:
        steps: in the order of unfolding, the last fold first.
        maps: isometries from rest to the flat sheet, nearly the same for all panels.
    """

    steps: tuple[Step, ...]
    maps: Isometries

    @property
    def faces_up(self) -> bool:
        """Whether the flat sheet lies as the body does at rest."""
        return not self.maps.mirrored.any()


def unfoldings(panels: Panels, above: Int[np.ndarray, "P P"]) -> list[Order]:
    """Orders in which the panels unfold, the likeliest first; none if there is no such order."""
    orders: list[Order] = []
    seen: set[frozenset[object]] = set()
    stack: list[tuple[Sheet, tuple[Step, ...]]] = [(Sheet(panels, panels.maps, above), ())]
    while stack and len(seen) < MOST_STATES and len(orders) < MOST_ORDERS:
        sheet, steps = stack.pop()
        state = frozenset(step.name for step in steps)
        if state in seen:
            continue
        seen.add(state)
        if not sheet.creases():
            orders.append(Order(steps, sheet.maps))
        if len(steps) == MOST_FOLDS:
            continue
        found = list(_candidates(sheet))
        stack += [(sheet.unfolded(step), (*steps, step)) for step in found[::-1]]
    return orders


def _joints(panels: Panels) -> list[tuple[int, int, complex]]:
    ends = np.sort(panels.label[panels.edges], axis=1)
    pairs, where = np.unique(ends, axis=0, return_inverse=True)
    found = []
    for index, (first, second) in enumerate(pairs.tolist()):
        if panels.maps.mirrored[first] == panels.maps.mirrored[second]:
            continue
        border = panels.edges[where.ravel() == index]
        middle = complex(panels.rest[border].mean())
        spread = np.abs(panels.rest[border] - middle).max() + panels.edge
        place = complex(panels.maps(first, np.array([middle]))[0])
        point, _, glide = panels.maps.mirror_line(first, second, place)
        if max(abs(point - place), glide) <= spread + panels.tolerance:
            found.append((first, second, middle))
    return found


def _candidates(sheet: Sheet) -> Iterator[Step]:
    """Possible unfoldings, the likeliest first."""
    counts = sheet.panels.counts
    found = [step for line in _lines(sheet) for step in _steps(sheet, *line)]
    yield from sorted(found, key=lambda step: (-len(step.creases), counts[step.moved].sum()))


def _lines(sheet: Sheet) -> Iterator[tuple[complex, complex, list[int]]]:
    """Lines on which creases lie: point, direction, and the creases."""
    left = sheet.creases()
    while left:
        first, second, middle = sheet.joints[left[0]]
        place = complex(sheet.maps(first, np.array([middle]))[0])
        point, direction, _ = sheet.maps.mirror_line(first, second, place)
        own = [i for i in left if i == left[0] or _lies_on(sheet, i, point, direction)]
        left = [i for i in left if i not in own]
        yield point, direction, own


def _lies_on(sheet: Sheet, joint: int, point: complex, direction: complex) -> bool:
    """Whether the reflection about a line carries one panel of a joint to its continuation."""
    first, second, _ = sheet.joints[joint]
    panels = sheet.panels
    smaller = first if panels.counts[first] < panels.counts[second] else second
    rest = panels.rest[panels.label == smaller]
    image = point + direction**2 * (sheet.maps(first, rest) - point).conj()
    limit = ON_LINE * max(np.ptp(panels.rest.real), np.ptp(panels.rest.imag))
    return bool(np.abs(image - sheet.maps(second, rest)).max() < limit)


def _steps(sheet: Sheet, point: complex, direction: complex, cut: list[int]) -> Iterator[Step]:
    """What may unfold about a line: a piece, or all pieces but one."""
    count = len(sheet.maps.turn)
    kept = [joint[:2] for i, joint in enumerate(sheet.joints) if i not in cut]
    pairs = np.array(kept, dtype=int).reshape(-1, 2)
    number, piece = connected_pieces(pairs, count)
    moves = [piece == one for one in range(number)]
    if number > 2:
        moves += [piece != one for one in range(number)]
    for moved in moves:
        creases = [i for i in cut if moved[sheet.joints[i][0]] != moved[sheet.joints[i][1]]]
        side = _side(sheet, moved, point, direction)
        if creases and side and (sheet.above[moved][:, ~moved] >= 0).all():
            yield Step(point, side * direction, moved, frozenset(creases))


def _side(sheet: Sheet, moved: np.ndarray, point: complex, direction: complex) -> int:
    """-1 if the panels lie left of a line, 1 if right, 0 if on both sides."""
    panels = sheet.panels
    own = moved[panels.label]
    place = sheet.maps(panels.label[own], panels.rest[own])
    left = ((place - point) * direction.conjugate()).imag
    sides = [np.mean(side * left > panels.tolerance) for side in (1, -1)]
    if min(sides) > BESIDE:
        return 0
    return -1 if sides[0] > sides[1] else 1
