"""Tasks of ropes: the two of the paper, after SoftGym, letters and the crossed triangle."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsimp import goals
from jaxsimp.bodies import Body, rope
from jaxsimp.dynamics import Actions, State
from jaxsimp.tasks.costs import RUNNING_WEIGHT, MatchingCost, distance, distance_cost
from jaxsimp.tasks.episode import Episode
from jaxsimp.tasks.registry import register
from jaxsimp.tasks.starts import CrumpledStart, FixedStart
from jaxsimp.tasks.task import Task

ROPE_LENGTH = 0.5375
"""Rest length of SoftGym's rope, metres; the straight goal is `SLACK` of it long."""
SLACK = 0.5 / ROPE_LENGTH
ROPE_LIMITS = (0.15, 0.15, 0.15)
"""Largest displacement of one action along x, y, z, metres."""


def ends_cost(episode: Episode, state: State, action: Actions | None = None) -> Float[Array, ""]:
    """Difference, metres, between the distance of a rope's ends and their distance in the goal.

    `abs(|p_1 - p_N| - L)`, with `L` the distance of the ends in the goal, as in SoftGym.
    """
    position, goal = state.position, jnp.asarray(episode.goal)
    return jnp.abs(distance(position[0] - position[-1]) - distance(goal[0] - goal[-1]))


@register(full=41, quick=21, group="paper")
def rope_straightening(resolution: int) -> Task:
    """Pull a crumpled rope straight, as in SoftGym; the goal is slack.

    The start is a straight rope after four random picks (see `crumple`); the cost is `ends_cost`.
    """
    body = rope(resolution, ROPE_LENGTH)
    goal = goals.straight(body, SLACK * body.size)
    start = CrumpledStart(body, goal)
    return Task(
        body=body,
        goal=goal,
        limits=ROPE_LIMITS,
        episode_fn=start,
        draw_fn=start.draw,
        running_cost=ends_cost,
        terminal_cost=ends_cost,
        running_weight=RUNNING_WEIGHT,
    )


@register(full=41, quick=21, group="paper")
def rope_folding(resolution: int) -> Task:
    """Lay a straight rope along two sides of an equilateral triangle, its corner at the middle.

    The cost is SoftGym's bipartite matching distance between 11 evenly spaced particles and their
    goal positions: the mean distance in the best assignment.
    """
    body = rope(resolution, ROPE_LENGTH)
    side = body.size / 2
    height = np.sqrt(3) / 2 * side
    corners = np.array([[-side / 2, -height / 2], [0.0, height / 2], [side / 2, -height / 2]])
    goal = goals.polyline(body, corners)
    start, cost = FixedStart(Episode(goals.straight(body), goal)), MatchingCost(resolution)
    return Task(
        body=body,
        goal=goal,
        limits=ROPE_LIMITS,
        episode_fn=start,
        draw_fn=start.draw,
        running_cost=cost,
        terminal_cost=cost,
        running_weight=RUNNING_WEIGHT,
    )


@register(full=41, quick=21, group="goals")
def rope_letter_m(resolution: int) -> Task:
    """Lay a straight rope as an M."""
    body = rope(resolution, ROPE_LENGTH)
    return _shape_task(body, goals.letter(body, "M"))


@register(full=41, quick=21, group="goals")
def rope_letter_u(resolution: int) -> Task:
    """Lay a straight rope as a U, its bow round."""
    body = rope(resolution, ROPE_LENGTH)
    return _shape_task(body, goals.letter(body, "U"))


@register(full=41, quick=21, group="goals")
def rope_crossed_triangle(resolution: int) -> Task:
    """Lay a straight rope as a triangle whose two ends cross and continue."""
    body = rope(resolution, ROPE_LENGTH)
    return _shape_task(body, goals.crossed_triangle(body))


def _shape_task(body: Body, goal: goals.Positions) -> Task:
    """A task from a straight start; the cost is the particles' mean distance to their goals."""
    start = FixedStart(Episode(goals.straight(body), goal))
    return Task(
        body=body,
        goal=goal,
        limits=ROPE_LIMITS,
        episode_fn=start,
        draw_fn=start.draw,
        running_cost=distance_cost,
        terminal_cost=distance_cost,
        running_weight=RUNNING_WEIGHT,
        num_actions=6,
    )
