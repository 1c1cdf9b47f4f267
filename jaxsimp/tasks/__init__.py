"""Tasks: a body, its start and goal, and the costs of states and actions.

A factory makes a task from the resolution; `register` adds the factory to the registry. The four
tasks of the paper are after SoftGym and fabric-vsf. A new task is one file:

```python
import jax.numpy as jnp

from jaxsimp import goals
from jaxsimp.bodies import rope
from jaxsimp.tasks import Episode, FixedStart, Task, register


def terminal_cost(episode, state):
    # Largest distance of a particle to its goal, metres.
    return jnp.linalg.norm(state.position - episode.goal, axis=1).max()


def running_cost(episode, state, action):
    # The same, plus a small cost of long displacements.
    return terminal_cost(episode, state) + 0.01 * jnp.abs(action.displacement).sum()


@register(full=41, quick=21)
def rope_letter_s(resolution):
    body = rope(resolution)
    goal = goals.letter(body, "S")
    start = FixedStart(Episode(goals.straight(body), goal))
    return Task(
        body=body,
        goal=goal,
        episode_fn=start,
        draw_fn=start.draw,
        running_cost=running_cost,
        terminal_cost=terminal_cost,
        limits=(0.15, 0.15, 0.15),
    )
```

Functions of a module and instances of its classes can be pickled, and so can a task made of them; a
lambda cannot.
"""

# The modules of tasks register them, in this order.
from jaxsimp.tasks import rope

# isort: split
from jaxsimp.tasks import cloth

# isort: split
from jaxsimp.tasks import garments

# isort: split
from jaxsimp.tasks import draping

# isort: split
from jaxsimp.tasks import strips

# isort: split
from jaxsimp.tasks.costs import COSTS, MatchingCost, distance_cost, matching_distance
from jaxsimp.tasks.crumpling import crumple
from jaxsimp.tasks.episode import DrawFn, Episode, EpisodeFn, RunningCost, TerminalCost
from jaxsimp.tasks.reaching import reach
from jaxsimp.tasks.registry import TaskFactory, make_task, register, task_names
from jaxsimp.tasks.starts import CrumpledStart, FixedStart, TurnedStart
from jaxsimp.tasks.task import Task, score

__all__ = [
    "COSTS",
    "CrumpledStart",
    "DrawFn",
    "Episode",
    "EpisodeFn",
    "FixedStart",
    "MatchingCost",
    "RunningCost",
    "Task",
    "TaskFactory",
    "TerminalCost",
    "TurnedStart",
    "cloth",
    "crumple",
    "distance_cost",
    "draping",
    "garments",
    "make_task",
    "matching_distance",
    "reach",
    "register",
    "rope",
    "score",
    "strips",
    "task_names",
]
