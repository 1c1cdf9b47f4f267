"""A task for any body and goal: from a start on the table, or a given one, to the goal."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxsimp import goals
from jaxsimp.bodies import Body
from jaxsimp.checks import require_choice, require_count
from jaxsimp.dynamics import Obstacle, Pinch, Table, at_rest
from jaxsimp.dynamics.arrays import require_positions
from jaxsimp.dynamics.contact.settings import longest_contact_step
from jaxsimp.dynamics.pickers import require_limits, top_speed
from jaxsimp.tasks.costs import COSTS, RUNNING_WEIGHT
from jaxsimp.tasks.episode import Episode
from jaxsimp.tasks.starts import CrumpledStart, FixedStart
from jaxsimp.tasks.task import COUNTS, Task

STARTS = ("flat", "crumpled")
"""Starts by name."""
SHEET_LIMIT, SHEET_SECONDS, SHEET_SIZE = 0.2, 0.25, 0.3
ROPE_LIMIT, ROPE_SECONDS, ROPE_SIZE = 0.15, 0.3, 0.5375
"""Largest displacement along an axis, metres, and duration of an action, seconds, of a body of that
size, metres: those of the paper's tasks."""
AT_GOAL = 1e-4
"""Cost of a start that is at the goal, in sizes of the body."""
SPARE = 1.25
"""Least sum of all displacements along an axis, in largest distances to the goal."""


def reach(
    body: Body,
    goal: goals.Positions,
    *,
    start: str | Float[np.ndarray, "N 3"] = "flat",
    cost: str = "particles",
    num_actions: int = 4,
    num_pickers: int = 2,
    limits: tuple[float, float, float] | None = None,
    obstacles: tuple[Obstacle, ...] = (Table(),),
    pinch: Pinch | None = None,
    gripper_distance: float = 0.0,
    name: str = "reach",
) -> Task:
    """A task: bring a body from a start to a goal.

    Actions have the speed of those of the paper's tasks; where displacements are smaller than
    theirs, the duration falls as the square root of the ratio, as that of falling does.

    Args:
        body: the body.
        goal: goal positions, shape (N, 3), metres.
        start: "flat", on the table where `goals.flat_at` puts it; "crumpled", after four random
            picks around there (see `crumple`), others for each seed; or positions, shape (N, 3),
            metres.
        cost: cost of a state, a name in `COSTS`; the score is 1 at the goal.
        num_actions: number of actions in a plan, `T`.
        num_pickers: number of pickers, `G`.
        limits: largest displacement of an action along x, y, z, metres; by default those
            of the paper's tasks, in sizes of the body (2/3 for sheets, 0.28 for ropes), or more if
            the goal is so far away that `num_actions` would not reach it.
        obstacles: rigid bodies at rest, in the order in which they act.
        pinch: what a picker holds besides the particle that an action names.
        gripper_distance: least distance of two pickers that both hold something, metres.
        name: name of the task.

    Raises:
        ValueError: if the goal or the start is none of the body's, the start is at the goal, the
            start or the cost is unknown, or `Task` raises.
    """
    goal = goals.as_goal(body, goal)
    require_choice("cost", cost, COSTS)
    num_actions = require_count("num_actions", num_actions, *COUNTS["num_actions"])
    episode_fn, first = _start(body, goal, start)
    if isinstance(episode_fn, FixedStart):  # one that is drawn is at no goal
        _require_apart(body, Episode(first, goal), cost)
    limit, seconds, size = (
        (SHEET_LIMIT, SHEET_SECONDS, SHEET_SIZE)
        if len(body.faces)
        else (ROPE_LIMIT, ROPE_SECONDS, ROPE_SIZE)
    )
    if limits is None:
        farthest = float(np.abs(goal - first).max())
        limits = (max(limit * body.size / size, SPARE * farthest / num_actions),) * 3
    ratio = max(require_limits(limits)) / limit
    seconds *= max(ratio, np.sqrt(ratio))
    fastest = top_speed(limits, seconds)
    return Task(
        body=body,
        goal=goal,
        episode_fn=episode_fn,
        draw_fn=episode_fn.draw if isinstance(episode_fn, FixedStart) else None,
        running_cost=COSTS[cost],
        terminal_cost=COSTS[cost],
        running_weight=RUNNING_WEIGHT,
        limits=limits,
        num_actions=num_actions,
        num_pickers=num_pickers,
        action_seconds=seconds,
        longest_time_step=min(Task.longest_time_step, 0.99 * longest_contact_step(body, fastest)),
        obstacles=obstacles,
        pinch=pinch,
        gripper_distance=gripper_distance,
        name=name,
    )


def _start(
    body: Body, goal: goals.Positions, start: str | Float[np.ndarray, "N 3"]
) -> tuple[FixedStart | CrumpledStart, goals.Positions]:
    """The function of episodes, and positions that are typical of their starts."""
    if not isinstance(start, str):
        given = np.asarray(require_positions("the start", start, body.num_particles), float)
        return FixedStart(Episode(given, goal)), given
    require_choice("start", start, STARTS)
    lying = goals.flat_at(body, goal)
    if start == "flat":
        return FixedStart(Episode(lying, goal)), lying
    x, y, _ = lying.mean(axis=0).tolist()
    return CrumpledStart(body, goal, (x, y)), lying


def _require_apart(body: Body, episode: Episode, cost: str) -> None:
    """Raise a `ValueError` for a start at the goal, of which no score is defined."""
    state = at_rest(jnp.asarray(episode.start, float))
    first = float(COSTS[cost](episode, state))
    if not first > AT_GOAL * body.size:
        raise ValueError(
            f"the start has a cost of {first:.3g} and is at the goal already; give another start, "
            f"or another goal"
        )
