"""Tasks of ropes: the two of the paper, after SoftGym, letters and the crossed triangle."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsimp import goals
from jaxsimp.bodies import Body, rope
from jaxsimp.tasks.costs import distance, distance_cost, matching_cost
from jaxsimp.tasks.crumpling import crumple
from jaxsimp.tasks.task import Episode, Task, register

ROPE_LENGTH = 0.5375
"""Rest length of SoftGym's rope, metres; the straight goal is `SLACK` of it long."""
SLACK = 0.5 / ROPE_LENGTH
ROPE_LIMITS = (0.15, 0.15, 0.15)
"""Largest displacement of one action along x, y, z, metres."""


@register("rope_straightening", full=41, quick=21, group="paper")
def rope_straightening(resolution: int) -> Task:
    """Pull a crumpled rope straight: cost `abs(|p_1 - p_N| - L)`, as in SoftGym.

    `L` is the length of the slack straight goal; the start is a straight rope after four
    random picks (see `crumple`).
    """
    body = rope(resolution, ROPE_LENGTH)
    goal = goals.straight(body, SLACK * body.size)

    def cost(episode: Episode, position: Float[Array, "N 3"]) -> Float[Array, ""]:
        goal = jnp.asarray(episode.goal)
        return jnp.abs(distance(position[0] - position[-1]) - distance(goal[0] - goal[-1]))

    return Task(
        name="rope_straightening",
        body=body,
        goal=goal,
        limits=ROPE_LIMITS,
        episode_fn=lambda seed: Episode(crumple(body, seed), goal),
        cost_fn=cost,
    )


@register("rope_folding", full=41, quick=21, group="paper")
def rope_folding(resolution: int) -> Task:
    """Lay a straight rope along two sides of an equilateral triangle, its corner at the middle.

    The cost is SoftGym's bipartite matching distance between 11 particles, evenly chosen, and
    their goal positions: the mean distance in the best assignment.
    """
    body = rope(resolution, ROPE_LENGTH)
    side = body.size / 2
    height = np.sqrt(3) / 2 * side
    corners = np.array([[-side / 2, -height / 2], [0.0, height / 2], [side / 2, -height / 2]])
    goal = goals.polyline(body, corners)
    start = goals.straight(body)

    return Task(
        name="rope_folding",
        body=body,
        goal=goal,
        limits=ROPE_LIMITS,
        episode_fn=lambda seed: Episode(start, goal),
        cost_fn=matching_cost(resolution),
    )


@register("rope_letter_m", full=41, quick=21, group="goals")
def rope_letter_m(resolution: int) -> Task:
    """Lay a straight rope as an M."""
    body = rope(resolution, ROPE_LENGTH)
    return _shape_task("rope_letter_m", body, goals.letter(body, "M"))


@register("rope_letter_u", full=41, quick=21, group="goals")
def rope_letter_u(resolution: int) -> Task:
    """Lay a straight rope as a U, its bow round."""
    body = rope(resolution, ROPE_LENGTH)
    return _shape_task("rope_letter_u", body, goals.letter(body, "U"))


@register("rope_crossed_triangle", full=41, quick=21, group="goals")
def rope_crossed_triangle(resolution: int) -> Task:
    """Lay a straight rope as a triangle whose two ends cross and go on."""
    body = rope(resolution, ROPE_LENGTH)
    return _shape_task("rope_crossed_triangle", body, goals.crossed_triangle(body))


def _shape_task(name: str, body: Body, goal: goals.Positions) -> Task:
    """A goal from a straight start; the cost is the mean distance of particles to their goals."""
    start = goals.straight(body)
    return Task(
        name=name,
        body=body,
        goal=goal,
        limits=ROPE_LIMITS,
        episode_fn=lambda seed: Episode(start, goal),
        cost_fn=distance_cost,
        num_actions=6,
    )
