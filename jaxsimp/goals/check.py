"""Checks of goals: `as_goal`, a cheap one for arrays, and `check_goal`, a strict one for users."""

import numpy as np
from jaxtyping import Float, Int

from jaxsimp.bodies import Body
from jaxsimp.goals.shapes import Positions

NOISE = 0.03
"""Allowance for noise in a measured goal, relative to the body's size."""
MAX_STRETCH = 1.2
"""Largest stretch of the body in a goal, as a ratio; that of pickers (SoftGym's rule)."""
SPAN = 0.2
"""Distance at rest, relative to the body's size, above which pairs of particles are compared."""
MOST_SOURCES = 64


def as_goal(body: Body, goal: Positions) -> Positions:
    """The goal as a float array, if it has finite coordinates for each particle of this body.

    Raises:
        ValueError: if the shape is not (N, 3), or a coordinate is not finite.
    """
    goal = np.asarray(goal, dtype=float)
    if goal.shape != body.rest.shape:
        raise ValueError(
            f"the goal has shape {goal.shape}; {body.rest.shape} is needed, "
            f"one row of x, y, z for each particle of the {body.name}"
        )
    bad = np.flatnonzero(~np.isfinite(goal).all(axis=1))
    if bad.size:
        raise ValueError(
            f"the goal of particle {bad[0]} is {goal[bad[0]].tolist()} "
            f"({bad.size} such particles); give finite coordinates in metres"
        )
    return goal


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
        ValueError: if the shape is not (N, 3), a coordinate is not finite, a particle is under
            the table, or the body is stretched too far.
    """
    goal = as_goal(body, goal)
    lowest = int(goal[:, 2].argmin())
    under = -goal[lowest, 2]
    if has_table and under > NOISE * body.size:
        raise ValueError(
            f"the goal of particle {lowest} is {under:.4g} m under the table, which is at z = 0 "
            f"with z up; raise the goal, or exchange its axes if it has another one up"
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
