"""The folds of a goal, found from the goal alone: the inverse of `jaxsimp.goals.fold_sequence`."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Complex, Int

from jaxsimp.bodies import Body
from jaxsimp.bodies.topology import distinct_edges, half_edges
from jaxsimp.checks import require_reals
from jaxsimp.goals.check import as_goal
from jaxsimp.goals.folds import Fold
from jaxsimp.goals.orders import MOST_FOLDS, unfoldings
from jaxsimp.goals.panels import (
    COVERS,
    LEAST_PARTICLES,
    Panels,
    find_panels,
    fit_isometry,
    layer_order,
)
from jaxsimp.goals.refolding import Refolding, refold
from jaxsimp.goals.shapes import Positions, require_flat

OFF = 0.045
"""Largest distance of the folds' end from the goal, relative to the body's size. Of the fold tasks,
let go and settled, it is up to 0.04 at the ends of creases."""
SPRUNG = 3.0
"""Largest height of the goal's layers above those of the folds, as a multiple of the distance in
the plane, if above half a thickness: layers of settled goals spring open, by 2 times that."""
ATTEMPTS = ((0.025, True), (0.012, True), (0.025, False), (0.012, False))
"""What is tried in turn: distance from a panel's isometry within which it grows, relative to the
body's size, as panels of settled goals are bent; and whether only what lies on top unfolds, since
heights in the goal may be wrong where little is covered."""
MOST_PANELS = 16
"""Largest number of panels: four folds of all layers in half."""
LIKELIER = 5.0
"""Least logarithm of the likelihood ratio of two ends, for the better one to be the goal's."""
SHIFTED = 0.1
"""Largest distance between particles of the same folds, relative to the body's size: twice the
distance of their lines."""
ALIKE = 0.9
"""Least fraction of particles on which same folds agree: those near creases may differ."""


@dataclass(frozen=True, eq=False)
class Subgoal:
    """The body after one of the folds of a goal.

    Attributes:
        positions: shape (N, 3), metres.
        moving: true for the particles that this fold turns over, shape (N,).
        fold: the fold.
    """

    positions: Positions
    moving: Bool[np.ndarray, " N"]
    fold: Fold


def find_folds(body: Body, goal: Positions) -> tuple[Fold, ...]:
    """The folds of a flat goal, in order: the inverse of `fold_sequence`.

    `fold_sequence(body, find_folds(body, goal), unfolded(body, goal))` gives the goal. A goal
    without folds, flat on the table and wherever there, gives none. Where several orders give the
    same end, as with corners side by side, one of them is returned.

    The goal is divided into panels, each a planar isometry of the body at rest; creases join
    neighbours of opposite facing; the layers unfold from the top, all orders being tried. The folds
    are fitted to all particles and carried out, and refused if that does not give the goal.

    Args:
        body: a body with triangles, flat at rest.
        goal: goal positions, shape (N, 3), metres; noise of 2 mm on a cloth of 0.3 m does no harm.

    Raises:
        ValueError: if the body is a rope or not flat at rest, the goal is none of the body's (see
            `as_goal`), or there are no folds that give it: it is not flat on the table, is turned
            over, has a part tucked under, has more than `MOST_PANELS` panels or `MOST_FOLDS` folds,
            or two orders of its layers are about equally likely.
    """
    return _unfold(body, goal).folds


def unfolded(body: Body, goal: Positions) -> Positions:
    """The flat body where the folds of a goal start, shape (N, 3), metres.

    What the folds do not move lies where it lies in the goal.

    Raises:
        ValueError: as for `find_folds`.
    """
    return _unfold(body, goal).start


def subgoals(body: Body, goal: Positions) -> tuple[Subgoal, ...]:
    """The body after each fold of a goal, the last being the goal itself; none without folds.

    Args:
        body: a body with triangles, flat at rest.
        goal: goal positions, shape (N, 3), metres.

    Raises:
        ValueError: as for `find_folds`.
    """
    found = _unfold(body, goal)
    ends = (*found.states[:-1], as_goal(body, goal))
    return tuple(map(Subgoal, ends, found.moves, found.folds))


def same_folds(body: Body, goal: Positions, end: Positions) -> bool:
    """Whether an end unfolds to the same folds as a goal, wherever both lie on the table.

    Both are unfolded, and folded again from the body at rest. They are the same if they have the
    same number of folds, at least `ALIKE` of the particles lie within `SHIFTED` of each other in
    the plane, and at least `ALIKE` of the pairs that cover each other are in the same order.

    Args:
        body: a body with triangles, flat at rest.
        goal: goal positions, shape (N, 3), metres.
        end: positions that were reached, shape (N, 3), metres.

    Returns:
        The answer; False for an end that `find_folds` refuses.

    Raises:
        ValueError: if `find_folds` refuses the goal.
    """
    require_reals("end", end, body.rest.shape, "one row of x, y, z for each particle")
    wanted = _unfold(body, goal)
    try:
        found = _unfold(body, end)
    except ValueError:
        return False
    return len(wanted.folds) == len(found.folds) and _are_alike(body, wanted, found)


def _unfold(body: Body, goal: Positions) -> Refolding:
    """The folds of a goal; see `find_folds`."""
    if not len(body.faces):
        raise ValueError(
            f"the {body.name} has no triangles; folds are found of sheets only: give "
            f"a cloth, a garment or a mesh"
        )
    require_flat(body)
    goal = as_goal(body, goal)
    refusals = []
    for growth, looks_up in ATTEMPTS:
        try:
            return _attempt(body, goal, growth, looks_up)
        except ValueError as error:
            refusals.append(error)
    raise refusals[0]


def _attempt(body: Body, goal: Positions, growth: float, looks_up: bool) -> Refolding:
    """The folds of a goal, by panels that grow within a distance."""
    panels = find_panels(body, goal, growth, MOST_PANELS)
    if panels is None:
        raise ValueError(
            f"the goal of the {body.name} has no panels that lie flat, or more than {MOST_PANELS}; "
            f"{_REMEDY}"
        )
    above = layer_order(panels, goal[:, 2])
    orders = unfoldings(panels, above if looks_up else np.zeros_like(above))
    upright = [order for order in orders if order.faces_up]
    if not upright:
        raise ValueError(_why_none(body, len(panels.counts), bool(orders)))
    found = _likeliest(body, [refold(body, goal, panels, order) for order in upright])
    _check_near(body, found)
    _check_layers(body, panels, above, found)
    return found


_REMEDY = (
    "give a goal of simple folds, each turning layers over onto the others, flat on the table, or "
    "plan to the goal itself"
)


def _why_none(body: Body, count: int, is_turned: bool) -> str:
    if is_turned:
        what = "lies face down: it was turned over, or a part of it is tucked under"
    else:
        what = (
            f"has {count} panels that cannot be unfolded from the top, one fold after another, by "
            f"up to {MOST_FOLDS} folds"
        )
    return f"the goal of the {body.name} {what}; {_REMEDY}"


def _likeliest(body: Body, found: list[Refolding]) -> Refolding:
    """The folds nearest to the goal, if they are near, and clearly nearer than others."""
    best = min(found, key=lambda one: one.squared)
    variance = max(best.squared / best.end.size, (1e-3 * body.radius) ** 2)
    likely = [one for one in found if one.squared - best.squared < 2 * LIKELIER * variance]
    # Of about equal ends the one of the fewest folds, and of these the first order: it takes
    # together what it can.
    chosen = min(likely, key=lambda one: len(one.folds))
    if any(
        len(one.folds) == len(chosen.folds) and _num_higher(body, one, chosen) >= LEAST_PARTICLES
        for one in likely
    ):
        raise ValueError(
            f"two orders of the layers fit the goal of the {body.name} about equally: the "
            f"logarithm of their likelihood ratio is below {LIKELIER:g}; give heights with less "
            f"noise, or the goal as goals.fold_sequence makes it"
        )
    return chosen


def _check_near(body: Body, found: Refolding) -> None:
    """Raise a `ValueError` for folds that do not give the goal."""
    limit = OFF * body.size
    low = min(limit, max(body.radius, SPRUNG * found.beside))
    for what, off, most, name in (
        ("the place of a particle", found.beside, limit, f"{OFF:g} of its size"),
        (
            "panels too low by",
            -found.heights.min(),
            low,
            f"half its thickness or {SPRUNG:g} times the former",
        ),
        ("panels too high by", found.heights.max(), body.radius, "half its thickness"),
    ):
        if off > most:
            raise ValueError(
                f"the folds found do not give the goal of the {body.name}: {what} {off:.3g} m, "
                f"and {most:.3g} m, {name}, is the limit; {_REMEDY}"
            )


def _check_layers(
    body: Body, panels: Panels, above: Int[np.ndarray, "P P"], found: Refolding
) -> None:
    """Raise a `ValueError` for folds that lay panels above each other in another order."""
    place = found.end[:, 0] + 1j * found.end[:, 1]
    order = layer_order(replace(panels, goal=place), found.end[:, 2])
    wrong = np.argwhere(order * above < 0)
    if len(wrong):
        raise ValueError(
            f"no folds give the layers of the goal of the {body.name}: those found lay "
            f"{len(wrong) // 2} pairs of its {len(above)} panels the other way round; {_REMEDY}"
        )


def _num_higher(body: Body, one: Refolding, other: Refolding) -> int:
    """Number of particles with another height in two ends, by a layer."""
    return int((np.abs(one.end[:, 2] - other.end[:, 2]) > 1.5 * body.radius).sum())


def _are_alike(body: Body, wanted: Refolding, found: Refolding) -> bool:
    places = [_from_rest(body, one) for one in (wanted, found)]
    near = np.abs(places[0] - places[1]) <= SHIFTED * body.size
    if np.mean(near) < ALIKE:
        return False
    first, second = _covering(body, places[0])
    heights = [one.end[:, 2] for one in (wanted, found)]
    above, still = (height[first] - height[second] for height in heights)
    counts = np.abs(above) > body.radius  # not of one layer
    return not counts.any() or bool(np.mean((above * still > 0)[counts]) >= ALIKE)


def _from_rest(body: Body, found: Refolding) -> Complex[np.ndarray, " N"]:
    """The end as complex numbers x + iy, of folds that start from the body at rest."""
    start, rest, end = (p[:, 0] + 1j * p[:, 1] for p in (found.start, body.rest, found.end))
    turn, shift, _ = fit_isometry(start, rest)
    return turn * end + shift


def _covering(body: Body, place: Complex[np.ndarray, " N"]) -> Int[np.ndarray, "2 _"]:
    """Pairs of particles that cover each other."""
    from scipy.spatial import cKDTree

    edges = distinct_edges(half_edges(body.faces)[0])[0]
    usual = np.median(np.linalg.norm(body.rest[edges[:, 1]] - body.rest[edges[:, 0]], axis=1))
    tree = cKDTree(np.stack([place.real, place.imag], axis=1))
    return tree.query_pairs(COVERS * float(usual), output_type="ndarray").T
