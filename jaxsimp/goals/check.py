"""Checks of goals: `as_goal`, a cheap one for arrays, and `check_goal`, a strict one for users."""

import numpy as np
from jaxtyping import Float, Int

from jaxsimp.bodies import Body
from jaxsimp.bodies.size import LARGEST, unit_of
from jaxsimp.checks import require_reals
from jaxsimp.goals.shapes import Positions

NOISE = 0.03
"""Allowance for noise in a measured goal, relative to the body's size."""
MAX_STRETCH = 1.2
"""Largest stretch of the body in a goal, as a ratio; that of pickers (SoftGym's rule)."""
SPAN = 0.2
"""Distance at rest, relative to the body's size, above which pairs of particles are compared."""
MOST_SOURCES = 64
FARTHEST = 10 * LARGEST
"""Largest coordinate of a goal, metres."""
TORN = 3.0
"""Largest distance of two neighbours in any goal, relative to the body's size."""
SQUEEZED = 0.1
"""Least length of the body's edges in any goal, all together, relative to rest. Folds, rolls and
crumples keep it near 1; creases across the edges of a coarse mesh may halve it."""


def as_goal(body: Body, goal: Positions) -> Positions:
    """The goal as a float array, if it may be one of this body: the bounds are wide.

    Raises:
        ValueError: if the shape is not (N, 3), a coordinate is not finite or beyond `FARTHEST`, the
            extent is beyond that of a stretched body, or the body is torn or squeezed to nothing
            (see `TORN`, `SQUEEZED`).
    """
    why = f"one row of x, y, z for each particle of the {body.name}"
    positions = require_reals("the goal", goal, body.rest.shape, why)
    bad = np.flatnonzero(~np.isfinite(positions).all(axis=1))
    if bad.size:
        raise ValueError(
            f"the goal of particle {bad[0]} is {positions[bad[0]].tolist()} "
            f"({bad.size} such particles); give finite coordinates in metres"
        )
    _check_size(body, positions)
    _check_springs(body, positions)
    return positions


def _check_size(body: Body, goal: np.ndarray) -> None:
    """Raise a `ValueError` for a goal that is too large, or too far away."""
    far, axis = np.unravel_index(np.abs(goal).argmax(), goal.shape)
    if abs(goal[far, axis]) > FARTHEST:
        what = f"has particle {far} at {'xyz'[axis]} = {goal[far, axis]:.4g} m"
        limit = f"{FARTHEST:g} m from the origin"
    elif (extent := np.ptp(goal, axis=0).max()) > MAX_STRETCH * LARGEST:
        what, limit = f"is {extent:.4g} m large", f"{MAX_STRETCH * LARGEST:g} m"
    else:
        return
    # The median of the particles: one of them may be astray.
    usual = float(np.median(np.abs(goal - np.median(goal, axis=0)).max(axis=1)))
    own = float(np.median(np.abs(body.rest - np.median(body.rest, axis=0)).max(axis=1)))
    ratio = usual / max(own, np.finfo(float).tiny)
    hint = f" ({unit_of(ratio, 0.5, 2.0)})" if not 0.5 <= ratio <= 2 else ""
    raise ValueError(f"the goal {what}; {limit} is the limit. Give metres{hint}")


def _check_springs(body: Body, goal: np.ndarray) -> None:
    """Raise a `ValueError` for a goal with neighbours far apart, or all at one place."""
    edges = body.springs[body.families == 0]
    if not len(edges):
        return
    lengths = np.linalg.norm(goal[edges[:, 1]] - goal[edges[:, 0]], axis=1)
    longest = int(lengths.argmax())
    if lengths[longest] > TORN * body.size:
        first, second = edges[longest]
        raise ValueError(
            f"in the goal particles {first} and {second} are neighbours, and "
            f"{lengths[longest]:.4g} m apart; the {body.name} is only {body.size:.4g} m large. "
            f"Give the goal in metres, with the particles in the body's order"
        )
    share = float(lengths.sum() / body.rest_length[body.families == 0].sum())
    if share < SQUEEZED:
        raise ValueError(
            f"in the goal the edges of the {body.name} have {share:.2g} of their length at rest; "
            f"{SQUEEZED:g} is the least, also of a body that is folded or crumpled. Give the goal "
            f"in metres ({unit_of(share, 0.5, 2.0)})"
        )


def check_goal(body: Body, goal: Positions, *, has_table: bool = True) -> Positions:
    """The goal as a float array, if the body can reach it.

    No particle may be farther under the table than the noise (`NOISE` times the body's size). The
    body may not be stretched beyond `MAX_STRETCH`. A single spring is too short to distinguish
    stretch from noise, so the check compares pairs of particles at least `SPAN` times the body's
    size apart, along its springs at rest: their straight distance in the goal may be `MAX_STRETCH`
    times their distance along the springs, plus the noise. One particle of each pair is among up
    to `MOST_SOURCES` particles spread over the body.

    Args:
        body: the body.
        goal: goal positions, metres.
        has_table: whether there is a table, which no particle may be under.

    Raises:
        ValueError: if `as_goal` refuses the goal, a particle is under the table, or the body is
            stretched too far.
    """
    goal = as_goal(body, goal)
    lowest = int(goal[:, 2].argmin())
    under = -goal[lowest, 2]
    if has_table and under > NOISE * body.size:
        raise ValueError(
            f"the goal of particle {lowest} is {under:.4g} m under the table, which is at z = 0 "
            f"with z up; raise the goal, or turn it if another axis is up (up='y' for a file)"
        )
    _check_stretch(body, goal)
    return goal


def _check_stretch(body: Body, goal: np.ndarray) -> None:
    """Raise a `ValueError` for a goal with particles farther apart than the body is long."""
    count = body.num_particles
    sources = np.unique(np.linspace(0, count - 1, min(count, MOST_SOURCES)).round().astype(int))
    reach = _distances_along(body, sources)
    apart = np.linalg.norm(goal[sources][:, None] - goal[None], axis=2)
    compared = reach >= SPAN * body.size  # infinite between pieces, which no distance exceeds
    excess = np.where(compared, apart - MAX_STRETCH * reach, -np.inf)
    row, other = np.unravel_index(excess.argmax(), excess.shape)
    if excess[row, other] > NOISE * body.size:
        raise ValueError(
            f"in the goal particles {sources[row]} and {other} are {apart[row, other]:.4g} m "
            f"apart; the {body.name} is only {reach[row, other]:.4g} m long between them. Give "
            f"the goal in metres, with the particles in the body's order"
        )


def _distances_along(body: Body, sources: Int[np.ndarray, " M"]) -> Float[np.ndarray, "M N"]:
    """Rest distances from some particles to all, along the springs, metres; inf if not joined."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import dijkstra

    shape = (body.num_particles, body.num_particles)
    graph = coo_array((body.rest_length, body.springs.T), shape=shape).tocsr()
    return dijkstra(graph, directed=False, indices=sources)
