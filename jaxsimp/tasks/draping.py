"""Tasks with an obstacle: a towel hung over a bar."""

import numpy as np

from jaxsimp import goals
from jaxsimp.bodies import Body, cloth
from jaxsimp.dynamics import Capsule, Table, least_radius
from jaxsimp.tasks.costs import RUNNING_WEIGHT, distance_cost
from jaxsimp.tasks.episode import Episode
from jaxsimp.tasks.registry import register
from jaxsimp.tasks.starts import FixedStart
from jaxsimp.tasks.task import Task

HEIGHT = 0.16
"""Height of the bar's axis, metres."""
SIZE = (0.3, 0.15)
"""Length of the towel, along x, and width, metres."""
RADIUS = 0.02
"""Radius of the bar, metres; more for a coarse towel, which a thin bar would slip through."""
AWAY = 0.25
"""Distance of the towel's middle from the bar at the start, metres along x."""


@register(full=25, quick=13, group="obstacles")
def towel_over_bar(resolution: int) -> Task:
    """Hang a towel, which lies beside a bar, over it in equal halves."""
    body = cloth((resolution, resolution), SIZE)
    radius = max(RADIUS, least_radius(body))
    half = 0.6 * SIZE[1]
    bar = Capsule((0.0, -half, HEIGHT), (0.0, half, HEIGHT), radius)
    goal = hung_over(body, radius)
    start = FixedStart(Episode(goals.flat(body) - np.array([AWAY, 0.0, 0.0]), goal))
    return Task(
        body=body,
        goal=goal,
        episode_fn=start,
        draw_fn=start.draw,
        running_cost=distance_cost,
        terminal_cost=distance_cost,
        running_weight=RUNNING_WEIGHT,
        limits=(0.25, 0.1, 0.4),
        num_actions=3,
        action_seconds=0.5,
        obstacles=(bar, Table()),
    )


def hung_over(body: Body, radius: float) -> goals.Positions:
    """A flat body hung over the bar in equal halves: straight down, round its top, and down.

    Args:
        body: a sheet, whose rest coordinate x goes round the bar; it does not stretch.
        radius: of the bar, metres.
    """
    reach = radius + body.radius
    x, y, _ = body.rest.T
    turn = np.clip(x / reach, -np.pi / 2, np.pi / 2)
    hanging = np.abs(x - reach * turn)
    return np.stack([reach * np.sin(turn), y, HEIGHT + reach * np.cos(turn) - hanging], axis=1)
