"""Planners of the studies, by name: a search, and what it changes of a task."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from jaxsimp.planning import (
    CEM,
    PRICES,
    Algorithm,
    Descent,
    Encoding,
    Joint,
    Reranking,
    Sequence,
    default_algorithm,
    num_stages,
    stage_algorithm,
)
from jaxsimp.planning.algorithm import stages
from jaxsimp.tasks import Task, make_task

Search = Algorithm | Sequence


@dataclass(frozen=True)
class NamedPlanner:
    """A search, and what it changes of a task.

    Attributes:
        search: the search for plans of a task, or of each stage.
        in_stages: whether goals of several folds are planned in stages.
        refines: whether plans of fine cloths are searched for on coarser ones, and refined.
        num_actions: number of actions in a plan, instead of the task's.
        limit: largest displacement along each axis, metres, instead of the task's.
        running_weight: weight of the running costs, instead of the task's.
    """

    search: Callable[[Task], Search]
    in_stages: bool = False
    refines: bool = False
    num_actions: int | None = None
    limit: float | None = None
    running_weight: float | None = None

    def task(self, task: Task, num_actions: int | None = None) -> Task:
        """The task with these changes, or another number of actions."""
        weight = self.running_weight
        return dataclasses.replace(
            task,
            num_actions=num_actions or self.num_actions or task.num_actions,
            limits=(self.limit,) * 3 if self.limit else task.limits,
            running_weight=task.running_weight if weight is None else weight,
        )


def _rounds(task: Task, rope: int, sheet: int) -> CEM:
    return CEM(num_iterations=sheet if len(task.body.faces) else rope, encoding=Joint())


def _without_descent(task: Task) -> Sequence:
    return Sequence((_rounds(task, rope=16, sheet=11), Reranking()))


def _without_reranking(task: Task) -> Sequence:
    num_starts = 1 if len(task.body.faces) else 4
    return Sequence((_rounds(task, rope=10, sheet=10), Descent(36, num_starts)))


def _cem(task: Task) -> CEM:
    return _rounds(task, rope=16, sheet=11)


def _cem_before(task: Task) -> CEM:
    return CEM(num_iterations=24)


def _paper(task: Task) -> CEM:
    return CEM(
        num_iterations=20,
        population=333 if len(task.body.faces) else 70,
        initial_populations=1,
        smoothing=0.0,
        initial_spread=0.5**0.5,
        keep_best=False,
        returns="mean",
    )


def _smoke(task: Task) -> Sequence:
    cem = CEM(num_iterations=3, population=16, initial_populations=1, encoding=Joint())
    return Sequence((cem, Descent(2), Reranking(2)))


def _default(task: Task) -> Sequence:
    return stage_algorithm() if stages_of_task(task) else default_algorithm(task)


def _one_piece(task: Task) -> CEM:
    # It finds several folds one after another, and must not converge on the first.
    return CEM(num_iterations=40, smoothing=0.2, encoding=Joint())


def stages_of_task(task: Task) -> int:
    """`jaxsimp.planning.num_stages` of a registered task, found once."""
    return _num_stages(task.name, task.resolution)


@cache
def _num_stages(name: str, resolution: int) -> int:
    return num_stages(make_task(name, resolution))


PLANNERS = {
    "default": NamedPlanner(_default, in_stages=True, refines=True),
    # Goals of several folds by one search.
    "one_piece": NamedPlanner(_one_piece),
    # The default without one of its parts, at its price.
    "without_descent": NamedPlanner(_without_descent),
    "without_reranking": NamedPlanner(_without_reranking),
    "cem": NamedPlanner(_cem),
    # The default of version 0.1: 3,456 rollouts, and the sum of all costs.
    "cem_24": NamedPlanner(_cem_before, running_weight=1.0),
    # The author's own settings.
    "paper": NamedPlanner(_paper, num_actions=15, limit=0.08, running_weight=1.0),
}
SMOKE = NamedPlanner(_smoke, in_stages=True)
"""What every planner is in a study at smoke size."""


def with_cem(search: Search, **changes: Any) -> Search:
    """The search with other settings of its CEM."""
    parts = tuple(
        dataclasses.replace(part, **changes) if isinstance(part, CEM) else part
        for part in stages(search)
    )
    return Sequence(parts) if isinstance(search, Sequence) else parts[0]


def cem_of(search: Search) -> CEM:
    """The CEM of a search, which every planner here has."""
    return next(part for part in stages(search) if isinstance(part, CEM))


def with_encoding(search: Search, encoding: Encoding) -> Search:
    """The search with another encoding of what is grasped."""
    return with_cem(search, encoding=encoding)


def num_asks(search: Search) -> int:
    """Number of questions of all parts."""
    return sum(part.num_asks for part in stages(search))


def counted_rollouts(search: Search) -> list[int]:
    """Price of a search up to and with each question, in rollouts."""
    prices = [
        part.num_plans * PRICES[part.wants] for part in stages(search) for _ in range(part.num_asks)
    ]
    return np.cumsum(prices).tolist()


def settings(search: Search) -> list[dict[str, Any]]:
    """Settings of each part, without the encoding, which has its own field."""
    found = []
    for part in stages(search):
        own = {name: value for name, value in vars(part).items() if name != "encoding"}
        found.append({"algorithm": type(part).__name__, **own})
    return found
