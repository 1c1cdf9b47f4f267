"""Options common to studies of plans."""

import dataclasses
import time
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

from rich.console import Console

from experiments.plan_study import ACTION_SPACES, PlanStudy
from experiments.planners import PLANNERS
from experiments.plans import run_study
from experiments.study import default_folder, teller, told_done
from jaxsimp import records
from jaxsimp.planning import ENCODINGS
from jaxsimp.tasks import make_task, task_names


@dataclass(frozen=True)
class PlanOptions:
    """Options of studies of plans."""

    NAME: ClassVar[str]
    SUCCESS_SCORE: ClassVar[float] = 0.9

    tasks: tuple[str, ...] = task_names()
    """Tasks to plan for."""
    method: str = "robust"
    """Method of simplification: robust, paper or meshlab."""
    action_spaces: tuple[str, ...] = ACTION_SPACES
    """Action spaces: the particles that a picker may grasp."""
    planners: tuple[str, ...] = ("default",)
    """Planners: default, parts of it (without_descent, without_reranking, cem), cem_24 for that of
    version 0.1, and paper for the paper's settings."""
    pick_encodings: tuple[str, ...] = ("joint", "gaussian_index")
    """CEM's encoding of the choice of particles."""
    first_seed: int = 0
    """The first seed."""
    seeds: int = 10
    """Number of seeds of each combination."""
    resolution: int | None = None
    """Particles along the rope or a side of the cloth (default: 41 and 25)."""
    num_iterations: int | None = None
    """Number of CEM rounds, instead of the planner's."""
    population: int | None = None
    """Number of plans per round, instead of the planner's."""
    initial_populations: int | None = None
    """Number of populations in the first CEM round, instead of the planner's."""
    elite_fraction: float | None = None
    """Fraction of the population that are elites, instead of the planner's."""
    smoothing: float | None = None
    """Fraction of the old distribution kept in an update, instead of the planner's."""
    initial_spread: float | None = None
    """First deviation of displacements, in units of the limits, instead of the planner's."""
    keep_best: bool | None = None
    """Whether the best plan so far stays among the elites, instead of the planner's."""
    returns: Literal["best", "mean"] | None = None
    """The best plan drawn, or the mean of the last distribution, instead of the planner's."""
    num_actions: int | None = None
    """Number of actions in a plan (the horizon), instead of the planner's."""
    planning: Literal["nominal", "robust", "self_contact", "mixed"] = "nominal"
    """Physics of the search: the body's own physics, an ensemble, self-contact, or self-contact for
    cloths and the body's own physics for ropes."""
    self_contact: bool = True
    """Carry out and score the plans found with self-contact."""
    out: Path | None = None
    """Output folder (default: results/paper, or results/paper-smoke)."""
    smoke: bool = False
    """Run everything once in under two minutes: small bodies, few rollouts, two seeds."""
    mixed: bool = False
    """Go on in a folder with rows of another environment; the report says so."""
    list: bool = False
    """List the tasks, planners, action spaces and encodings, and exit."""

    def configuration(self) -> PlanStudy:
        """The study of these options.

        Raises:
            ValueError: if the value of an option is invalid.
        """
        names = [
            field.name
            for field in dataclasses.fields(PlanOptions)
            if field.default is None and field.name not in ("resolution", "num_actions", "out")
        ]
        given = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        return PlanStudy(
            name=self.NAME,
            tasks=self.tasks,
            method=self.method,
            success_score=self.SUCCESS_SCORE,
            planners=self.planners,
            action_spaces=self.action_spaces,
            pick_encodings=self.pick_encodings,
            first_seed=self.first_seed,
            seeds=min(self.seeds, 2) if self.smoke else self.seeds,
            quick=self.smoke,
            resolution=self.resolution,
            settings=given,
            num_actions=self.num_actions,
            planning=self.planning,
            self_contact=self.self_contact,
        )

    def run(self, console: Console) -> None:
        """Run the study, or list its possible tasks, planners, action spaces and encodings."""
        if self.list:
            _list(console)
            return
        study, folder = self.configuration(), self.folder()
        start = time.perf_counter()
        with records.open_folder(folder, study.identity()):
            # Imported here, so that --help and wrong options do not wait for matplotlib.
            from experiments.plan_report import write_report

            summary = run_study(study, folder, console, mixed=self.mixed)
            write_report(study, summary, folder, teller(console))
        told_done(console, folder, start)

    def folder(self) -> Path:
        """Folder of the results."""
        name = self.NAME
        if self.planning != type(self).planning:
            name += f"-{self.planning}"
        return self.out or default_folder(name, self.smoke)


def _list(console: Console) -> None:
    for name in task_names():
        task = make_task(name)
        console.print(f"task {name}: {task.body.name}, {task.body.num_particles} particles")
    console.print(f"planners: {', '.join(PLANNERS)}")
    console.print(f"action spaces: {', '.join(ACTION_SPACES)}")
    console.print(f"pick encodings: {', '.join(ENCODINGS)}")
