"""Panels of a folded goal: regions that one planar isometry carries from rest to the table.

Points are complex numbers, x + iy. An isometry is `z -> turn * z + shift`, or with the conjugate
of `z` where the panel is mirrored, that is lies face down; `turn` has the absolute value 1.
Nothing here looks at heights but `layer_order`.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from jaxsimp.bodies import Body
from jaxsimp.bodies.topology import distinct_edges, half_edges

NOISE_FACTOR = 5.0
"""Distance from a panel's isometry within which it grows, at least, in standard deviations of the
noise: one particle in 10^5 is farther away."""
LEAST_PARTICLES = 4
THINNEST = 0.3
"""Least standard deviation across a panel's particles, in short edges: one row has no facing."""
ROUNDS = 10
"""Rounds of labels and fits in turn; a handful suffice."""
SURE = 3.0
"""Height difference of two panels that counts, in standard errors."""
COVERS = 0.75
"""Distance within which a particle covers another, in edges; as in `jaxsimp.goals.folds`."""


@dataclass(frozen=True, eq=False)
class Isometries:
    """Isometries of the plane, one a panel.

    Attributes:
        turn: shape (P,), of absolute value 1.
        shift: shape (P,), metres.
        mirrored: true where it mirrors, shape (P,).
    """

    turn: Complex[np.ndarray, " P"]
    shift: Complex[np.ndarray, " P"]
    mirrored: Bool[np.ndarray, " P"]

    def __call__(
        self, which: Int[np.ndarray, " M"] | int, points: Complex[np.ndarray, " M"]
    ) -> Complex[np.ndarray, " M"]:
        """Images of points, each under the isometry of an index, or all under that of one."""
        own = np.where(self.mirrored[which], points.conj(), points)
        return self.turn[which] * own + self.shift[which]

    def reflected(
        self, which: Bool[np.ndarray, " P"], point: complex, direction: complex
    ) -> "Isometries":
        """Some of them followed by the reflection about a line, the others as they are."""
        squared = direction**2
        turn = np.where(which, squared * self.turn.conj(), self.turn)
        shift = np.where(which, point + squared * (self.shift - point).conj(), self.shift)
        return replace(self, turn=turn, shift=shift, mirrored=self.mirrored ^ which)

    def mirror_line(self, first: int, second: int, near: complex) -> tuple[complex, complex, float]:
        """Fixed line of the quotient of a mirrored isometry and another one.

        Returns:
            The point of the line nearest to `near`, the direction, and the glide along it, metres.
        """
        squared = self.turn[second] * self.turn[first]
        image = squared * (near - self.shift[first]).conjugate() + self.shift[second]
        direction = complex(np.sqrt(squared))
        glide = ((image - near) * direction.conjugate()).real
        return complex((near + image - glide * direction) / 2), direction, abs(float(glide))


@dataclass(frozen=True, eq=False)
class Panels:
    """Panels of a goal.

    Attributes:
        rest: x + iy of the particles at rest, shape (N,), metres.
        goal: x + iy of the particles in the goal, shape (N,), metres.
        label: index of each particle's panel, shape (N,).
        maps: isometries from rest to goal.
        edges: edges of the triangles, shape (E, 2).
        edge: median length of an edge at rest, metres.
        short_edge: length below which a tenth of the edges are, metres.
        tolerance: distance from its isometry at which a particle may belong to a panel, metres.
    """

    rest: Complex[np.ndarray, " N"]
    goal: Complex[np.ndarray, " N"]
    label: Int[np.ndarray, " N"]
    maps: Isometries
    edges: Int[np.ndarray, "E 2"]
    edge: float
    short_edge: float
    tolerance: float

    @property
    def counts(self) -> Int[np.ndarray, " P"]:
        """Number of particles of each panel."""
        return np.bincount(self.label, minlength=len(self.maps.turn))


def find_panels(
    body: Body, goal: Float[np.ndarray, "N 3"], growth: float, most: int
) -> Panels | None:
    """The panels of a goal, each particle in one, or None if there are none, or more than `most`.

    A panel grows from a small patch that fits an isometry best. Then particles go to the
    neighbouring panel that is nearest to them, and the isometries are fitted anew.

    Args:
        body: a body with triangles, flat at rest.
        goal: goal positions, shape (N, 3), metres.
        growth: distance from a panel's isometry within which it grows, relative to the body's size.
        most: largest number of panels.
    """
    rest, place = (points[:, 0] + 1j * points[:, 1] for points in (body.rest, goal))
    edges, _, _ = distinct_edges(half_edges(body.faces)[0])
    lengths = np.abs(rest[edges[:, 1]] - rest[edges[:, 0]])
    edge, short = float(np.median(lengths)), float(np.percentile(lengths, 10))
    near = _neighbourhoods(edges, len(rest))
    misfit = _patch_misfits(near, rest, place)
    used = np.unique(edges)
    noise = float(np.percentile(misfit[used], 25))
    tolerance = max(growth * body.size, NOISE_FACTOR * noise)
    start = Panels(rest, place, np.full(len(rest), -1), _none(), edges, edge, short, tolerance)
    grown = _grow(start, near, used[np.argsort(misfit[used], kind="stable")], 4 * most)
    if grown is None or not len(grown.maps.turn):
        return None
    merged = _merge(_relabel(_spread(grown, body)))
    return merged if len(merged.maps.turn) <= most else None


def fit_isometry(
    rest: Complex[np.ndarray, " M"], goal: Complex[np.ndarray, " M"]
) -> tuple[complex, complex, bool]:
    """Turn, shift and facing of the isometry that fits points best, by least squares.

    The closed form in the plane (B. Horn, "Closed-form solution of absolute orientation using
    unit quaternions", 1987, in two dimensions), for both facings.
    """
    middle, target = rest.mean(), goal.mean()
    plain = np.vdot(rest - middle, goal - target)
    mirror = np.vdot((rest - middle).conj(), goal - target)
    mirrored = bool(abs(mirror) > abs(plain))
    best = mirror if mirrored else plain
    turn = complex(best / abs(best)) if best else 1.0 + 0.0j
    return turn, complex(target - turn * (middle.conjugate() if mirrored else middle)), mirrored


def layer_order(panels: Panels, height: Float[np.ndarray, " N"]) -> Int[np.ndarray, "P P"]:
    """1 where the first panel lies above the second, -1 where below, 0 where neither is sure.

    The median height difference of particles that cover each other, where it is above `SURE`
    standard errors of a median (1.25 standard deviations over the root of the number).

    Args:
        panels: the panels.
        height: height of each particle, shape (N,), metres.
    """
    from scipy.spatial import cKDTree

    count = len(panels.maps.turn)
    order = np.zeros((count, count), dtype=int)
    points = np.stack([panels.goal.real, panels.goal.imag], axis=1)
    members = [np.flatnonzero(panels.label == one) for one in range(count)]
    trees = [cKDTree(points[own]) for own in members]
    for first in range(count):
        for second in range(first):
            distance, nearest = trees[second].query(points[members[first]])
            over = distance <= COVERS * panels.edge
            other = members[second][nearest[over]]
            order[first, second] = _sure_sign(height[members[first][over]] - height[other])
            order[second, first] = -order[first, second]
    return order


def _sure_sign(differences: np.ndarray) -> int:
    if len(differences) < LEAST_PARTICLES:
        return 0
    middle = float(np.median(differences))
    spread = 1.4826 * float(np.median(np.abs(differences - middle)))
    error = 1.25 * spread / np.sqrt(len(differences))
    return int(np.sign(middle)) if abs(middle) > SURE * error else 0


def _neighbourhoods(edges: np.ndarray, count: int) -> Any:
    """Sparse matrix, shape (N, N), of ones at each particle and its neighbours."""
    from scipy.sparse import csr_array

    alone = np.repeat(np.arange(count)[:, None], 2, axis=1)
    pairs = np.concatenate([edges, edges[:, ::-1], alone])
    return csr_array((np.ones(len(pairs)), pairs.T), shape=(count, count))


def _patch_misfits(near: Any, rest: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Standard deviation along an axis of each particle's neighbourhood from an isometry."""
    count = near @ np.ones(len(rest))
    middle, target = (near @ rest) / count, (near @ goal) / count
    spread = near @ np.abs(rest) ** 2 - count * np.abs(middle) ** 2
    spread += near @ np.abs(goal) ** 2 - count * np.abs(target) ** 2
    plain = near @ (goal * rest.conj()) - count * target * middle.conj()
    mirror = near @ (goal * rest) - count * target * middle
    squared = spread - 2 * np.maximum(np.abs(plain), np.abs(mirror))
    return np.sqrt(np.maximum(squared, 0.0) / np.maximum(2 * count - 3, 1))


def _none() -> Isometries:
    return Isometries(np.zeros(0, dtype=complex), np.zeros(0, dtype=complex), np.zeros(0, bool))


def _grow(panels: Panels, near: Any, seeds: Int[np.ndarray, " M"], most: int) -> Panels | None:
    """Panels grown from seeds in order, or None if there are more than `most`."""
    label = panels.label.copy()
    count = 0
    for whole in (True, False):  # whole patches first, then what is left of others
        for seed in seeds:
            patch = near.indices[near.indptr[seed] : near.indptr[seed + 1]]
            free = patch[label[patch] < 0]
            if label[seed] >= 0 or (whole and len(free) < len(patch)):
                continue
            region = _region(panels, near, free, label < 0)
            if region is not None:
                label[region], count = count, count + 1
            if count > most:
                return None
    return _fitted(replace(panels, label=label), count)


def _region(
    panels: Panels, near: Any, patch: np.ndarray, free: np.ndarray
) -> Bool[np.ndarray, " N"] | None:
    """Free particles around a patch that one isometry fits, or None if they are too few."""
    inside = np.zeros(len(free), dtype=bool)
    inside[patch] = True
    for _ in range(len(free)):
        if not _is_broad(panels, inside):
            return None
        turn, shift, mirrored = fit_isometry(panels.rest[inside], panels.goal[inside])
        image = turn * (panels.rest.conj() if mirrored else panels.rest) + shift
        fits = free & (np.abs(image - panels.goal) < panels.tolerance)
        after = fits & (near @ (inside & fits) > 0)
        if (after == inside).all() or after.sum() <= inside.sum() * 0.5:
            break
        inside = after
    return inside if _is_broad(panels, inside) else None


def _is_broad(panels: Panels, inside: Bool[np.ndarray, " N"]) -> bool:
    """Whether particles are enough, and not in one row."""
    points = panels.rest[inside]
    if len(points) < LEAST_PARTICLES:
        return False
    flat = np.stack([points.real, points.imag])
    return bool(np.linalg.eigvalsh(np.cov(flat))[0] > (THINNEST * panels.short_edge) ** 2)


def _fitted(panels: Panels, count: int) -> Panels:
    """The panels with their isometries fitted to their particles."""
    fits = [
        fit_isometry(panels.rest[panels.label == one], panels.goal[panels.label == one])
        for one in range(count)
    ]
    if not fits:
        return replace(panels, maps=_none())
    turn, shift, mirrored = (np.array(column) for column in zip(*fits, strict=True))
    return replace(panels, maps=Isometries(turn, shift, mirrored))


def _spread(panels: Panels, body: Body) -> Panels:
    """The panels with every other particle in that of the nearest particle at rest."""
    from scipy.spatial import cKDTree

    without = panels.label < 0
    if not without.any():
        return panels
    label = panels.label.copy()
    _, nearest = cKDTree(body.rest[~without]).query(body.rest[without])
    label[without] = label[~without][nearest]
    return replace(panels, label=label)


def _relabel(panels: Panels) -> Panels:
    """Particles in the nearest of the panels of their neighbours, and fits, in turn."""
    both = np.concatenate([panels.edges, panels.edges[:, ::-1]])
    for _ in range(ROUNDS):
        own = np.abs(panels.maps(panels.label, panels.rest) - panels.goal)
        offered = panels.label[both[:, 1]]
        off = np.abs(panels.maps(offered, panels.rest[both[:, 0]]) - panels.goal[both[:, 0]])
        order = np.lexsort((-off, both[:, 0]))  # the last assignment, of the least, stays
        best, label = np.full(len(own), np.inf), panels.label.copy()
        best[both[order, 0]], label[both[order, 0]] = off[order], offered[order]
        label = np.where(best < own, label, panels.label)
        if (label == panels.label).all():
            break
        panels = _compact(panels, label)
    return panels


def _compact(panels: Panels, label: np.ndarray) -> Panels:
    """The panels with new labels, without those too small to fit."""
    counts = np.bincount(label, minlength=len(panels.maps.turn))
    kept = counts >= LEAST_PARTICLES
    if not kept[label].all():  # those of a panel too small go to the nearest that stays
        stay = np.flatnonzero(kept)
        lost = np.flatnonzero(~kept[label])
        off = [np.abs(panels.maps(int(one), panels.rest[lost]) - panels.goal[lost]) for one in stay]
        label[lost] = stay[np.argmin(off, axis=0)]
    names, label = np.unique(label, return_inverse=True)
    return _fitted(replace(panels, label=label), len(names))


def _merge(panels: Panels) -> Panels:
    """The panels, neighbours that one isometry fits joined."""
    while (pair := _mergeable(panels)) is not None:
        label = np.where(panels.label == pair[1], pair[0], panels.label)
        panels = _relabel(_compact(panels, label))
    return panels


def _mergeable(panels: Panels) -> tuple[int, int] | None:
    pairs = np.unique(np.sort(panels.label[panels.edges], axis=1), axis=0)
    same = panels.maps.mirrored[pairs[:, 0]] == panels.maps.mirrored[pairs[:, 1]]
    for first, second in pairs[same & (pairs[:, 0] != pairs[:, 1])]:
        both = (panels.label == first) | (panels.label == second)
        turn, shift, mirrored = fit_isometry(panels.rest[both], panels.goal[both])
        rest = panels.rest[both].conj() if mirrored else panels.rest[both]
        if np.abs(turn * rest + shift - panels.goal[both]).max() < panels.tolerance:
            return int(first), int(second)
    return None
