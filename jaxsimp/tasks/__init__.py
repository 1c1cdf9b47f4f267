"""Tasks: a body, where it starts, where it should end, and what a state costs.

A task is made by a factory that takes the resolution; `register` adds one to the registry. The
four tasks of the paper are after SoftGym and fabric-vsf.
"""

# The modules of tasks register them, in this order.
from jaxsimp.tasks import rope

# isort: split
from jaxsimp.tasks import cloth

# isort: split
from jaxsimp.tasks import garments

# isort: split
from jaxsimp.tasks.costs import MatchingCost, distance_cost, matching_distance
from jaxsimp.tasks.crumpling import crumple
from jaxsimp.tasks.episode import DrawFn, Episode, EpisodeFn, RunningCost, TerminalCost
from jaxsimp.tasks.registry import TaskFactory, make_task, register, task_names
from jaxsimp.tasks.starts import CrumpledStart, FixedStart, TurnedStart
from jaxsimp.tasks.task import Task, score

__all__ = [
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
    "garments",
    "make_task",
    "matching_distance",
    "register",
    "rope",
    "score",
    "task_names",
]
