"""Configuration of the studies of plans: what is planned, how, and with which seeds."""

import dataclasses
import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from math import ceil
from typing import Any, Literal, NamedTuple

from experiments.planners import (
    PLANNERS,
    SMOKE,
    NamedPlanner,
    Search,
    cem_of,
    settings,
    stages_of_task,
    with_cem,
)
from jaxsimp.checks import require_count, require_seed
from jaxsimp.engines import MassSprings, SearchEngine, Spread, make_ensemble
from jaxsimp.planning import (
    ENCODINGS,
    CoarseToFinePlanner,
    Planner,
    StagedPlanner,
    staged_task,
)
from jaxsimp.simplification import METHODS
from jaxsimp.tasks import Task, make_task, task_names

ACTION_SPACES = ("key_points", "all_particles")
PLANNING = ("nominal", "robust", "self_contact", "mixed")
"""Physics of a search: the body's own, an ensemble, self-contact, or self-contact only for cloths,
whose folds have layers."""
ENSEMBLE_SIZE = 4
COARSER = (25, 50)
"""Resolutions of cloths on which plans for finer ones are searched for and refined."""


class Run(NamedTuple):
    """What identifies a run of a study.

    Attributes:
        task: name of the task.
        planner: name of the planner.
        action_space: name of the set of particles that a picker may grasp.
        pick_encoding: name of the encoding.
        seed: seed of the episode and of the search.
    """

    task: str
    planner: str
    action_space: str
    pick_encoding: str
    seed: int


IDENTITY = Run._fields
"""Fields of a row that identify a run."""

AnyPlanner = Planner | StagedPlanner | CoarseToFinePlanner


@dataclass(frozen=True)
class PlanStudy:
    """Configuration of a study of plans; results of the same configuration are comparable.

    Attributes:
        name: name of the study.
        tasks: names of the tasks.
        method: method of simplification.
        success_score: smallest settled score of a successful plan.
        planners: names of the planners.
        action_spaces: names of the sets of particles that a picker may grasp.
        pick_encodings: names of the encodings.
        first_seed: the first seed.
        seeds: number of seeds of every combination.
        quick: whether bodies are small instead of full, and every search is short.
        resolution: number of particles along a side, instead of the scale's.
        settings: CEM settings that replace the planners'.
        num_actions: number of actions in a plan, instead of the planner's or the task's.
        planning: physics of the search, one of `PLANNING`.
        self_contact: whether to carry out and score the plans found with self-contact.
    """

    name: str
    tasks: tuple[str, ...]
    method: str
    success_score: float
    planners: tuple[str, ...]
    action_spaces: tuple[str, ...]
    pick_encodings: tuple[str, ...]
    first_seed: int
    seeds: int
    quick: bool
    resolution: int | None
    settings: dict[str, Any]
    num_actions: int | None
    planning: Literal["nominal", "robust", "self_contact", "mixed"]
    self_contact: bool

    def __post_init__(self) -> None:
        _require_known("task", self.tasks, task_names())
        _require_known("planning", (self.planning,), PLANNING)
        _require_known("method", (self.method,), tuple(METHODS))
        _require_known("planner", self.planners, tuple(PLANNERS))
        _require_known("action space", self.action_spaces, ACTION_SPACES)
        _require_known("pick encoding", self.pick_encodings, tuple(ENCODINGS))
        require_count("seeds", self.seeds, 1)
        require_seed(self.first_seed)
        require_seed(self.first_seed + self.seeds - 1)
        if self.num_actions is not None:
            require_count("num_actions", self.num_actions, 1)
        for name, planner in self.pairs():  # Raises for a wrong resolution or setting before a run.
            self.search(self.task(name, planner), planner)

    def pairs(self) -> Iterator[tuple[str, str]]:
        """Every task with every planner, by name."""
        return itertools.product(self.tasks, self.planners)

    def named(self, planner: str) -> NamedPlanner:
        """A planner at this study's scale."""
        return SMOKE if self.quick else PLANNERS[planner]

    def task(self, name: str, planner: str | None = None) -> Task:
        """A task at this study's scale, as a planner changes it; by default the first planner."""
        planner = planner or self.planners[0]
        task = make_task(name, self.resolution, quick=self.quick)
        changed = self.named(planner).task(task, self.num_actions)
        return (
            staged_task(changed, stages_of_task(task)) if self.in_stages(task, planner) else changed
        )

    def in_stages(self, task: Task, planner: str) -> bool:
        """Whether a planner plans for a task in stages."""
        return (
            self.named(planner).in_stages and stages_of_task(task) > 0 and self.num_actions is None
        )

    def planner(self, name: str, planner: str) -> AnyPlanner:
        """A planner of a task, by their names."""
        task = self.task(name, planner)
        engines = self.engine(task), self.evaluator()
        if self.in_stages(task, planner):
            return StagedPlanner(task, *engines)
        if self.named(planner).refines and is_fine(task):
            coarser = (dataclasses.replace(self, resolution=each) for each in COARSER)
            return CoarseToFinePlanner(
                task, tuple(each.task(name, planner) for each in coarser), *engines
            )
        return Planner(task, *engines)

    def search(self, task: Task, planner: str) -> Search:
        """The search of a planner for plans of a task."""
        search = self.named(planner).search(task)
        if self.planning_of(task) == "self_contact":
            # A round takes about four times as long.
            search = with_cem(search, num_iterations=ceil(cem_of(search).num_iterations / 2))
        return with_cem(search, **self.settings)

    def planning_of(self, task: Task) -> str:
        """Physics of the search of a task: one of `PLANNING`, but not "mixed"."""
        if self.planning != "mixed":
            return self.planning
        return "self_contact" if len(task.body.faces) else "nominal"

    def engine(self, task: Task) -> SearchEngine:
        """The engine that gives the search the costs of plans."""
        planning = self.planning_of(task)
        if planning == "robust":
            return make_ensemble(task, ENSEMBLE_SIZE)
        return MassSprings(self_contact=planning == "self_contact")

    def evaluator(self) -> MassSprings:
        """The engine that carries out and scores plans."""
        return MassSprings(self_contact=self.self_contact)

    def identity(self) -> dict[str, Any]:
        """Identity of a folder of results: the options, and the meaning of their names."""
        search = {
            f"{name}, {planner}": settings(self.search(self.task(name, planner), planner))
            for name, planner in self.pairs()
        }
        spread = {"size": ENSEMBLE_SIZE, "spread": dataclasses.asdict(Spread())}
        ensemble = spread if self.planning == "robust" else None
        return {**dataclasses.asdict(self), "search": search, "ensemble": ensemble}

    def runs(self) -> list[Run]:
        """Every run, in order."""
        seeds = range(self.first_seed, self.first_seed + self.seeds)
        combined = itertools.product(
            self.tasks, self.planners, self.action_spaces, self.pick_encodings, seeds
        )
        return list(itertools.starmap(Run, combined))


def is_fine(task: Task) -> bool:
    """Whether a task is of a cloth so fine that its plans are searched for on coarser ones."""
    return len(task.body.shape) == 2 and min(task.body.shape) > 1.5 * max(COARSER)


def _require_known(kind: str, names: tuple[str, ...], known: tuple[str, ...]) -> None:
    if not names:
        raise ValueError(f"no {kind} is given; choose from {', '.join(known)}")
    for name in names:
        if name not in known:
            raise ValueError(f"unknown {kind} {name!r}; choose from {', '.join(known)}")
        if names.count(name) > 1:
            raise ValueError(f"{kind} {name!r} is given twice; give it once")
