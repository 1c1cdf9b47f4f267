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
from jaxsimp.tasks.costs import distance_cost, matching_cost, matching_distance
from jaxsimp.tasks.crumpling import crumple
from jaxsimp.tasks.task import (
    CostFn,
    Episode,
    Task,
    TaskFactory,
    make_task,
    register,
    score,
    task_names,
)

__all__ = [
    "CostFn",
    "Episode",
    "Task",
    "TaskFactory",
    "cloth",
    "crumple",
    "distance_cost",
    "garments",
    "make_task",
    "matching_cost",
    "matching_distance",
    "register",
    "rope",
    "score",
    "task_names",
]
