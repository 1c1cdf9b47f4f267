"""Run a study: `python -m experiments.run`. All options: `python -m experiments.run --help`."""

import dataclasses
import inspect
import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

import tyro
from rich.console import Console

from experiments import simplification, transfer
from experiments.plans import ACTION_SPACES, Study, run_study
from experiments.simplification import available_methods
from jaxsimp import records
from jaxsimp.cli.status import exit_status
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
    """How goals are simplified: robust, paper or meshlab."""
    action_spaces: tuple[str, ...] = ACTION_SPACES
    """Particles that may be grasped."""
    pick_encodings: tuple[str, ...] = ("categorical", "gaussian_index")
    """How CEM encodes what is grasped."""
    seeds: int = 10
    """Seeds 0 to SEEDS - 1 of each combination."""
    resolution: int | None = None
    """Particles along the rope or a side of the cloth (default: 41 and 25)."""
    budget: Literal["default", "paper", "goals"] = "default"
    """Search settings: those that end in minutes, the paper's own, or more for several folds."""
    num_iterations: int | None = None
    """CEM rounds, instead of the budget's."""
    population: int | None = None
    """Plans drawn a round, instead of the budget's."""
    initial_populations: int | None = None
    """Populations drawn in the first CEM round, instead of the budget's."""
    elite_fraction: float | None = None
    """Share of the population that are elites, instead of the budget's."""
    smoothing: float | None = None
    """Share of the old distribution kept in an update, instead of the budget's."""
    initial_spread: float | None = None
    """First deviation of displacements in units of their limits, instead of the budget's."""
    keep_best: bool | None = None
    """Whether the best plan so far stays among the elites, instead of the budget's."""
    returns: Literal["best", "mean"] | None = None
    """The best plan drawn, or the mean of the last distribution, instead of the budget's."""
    num_actions: int | None = None
    """Actions in a plan (the horizon), instead of the budget's."""
    planning: Literal["nominal", "robust", "self_contact", "mixed"] = "nominal"
    """What the search judges plans in: the body's physics alone, an ensemble of them, the body
    touching itself, or the last for cloths and the first for ropes."""
    self_contact: bool = True
    """Carry out and score plans that were found with the body touching itself."""
    out: Path | None = None
    """Output folder (default: results/paper, or results/paper-smoke)."""
    smoke: bool = False
    """Small bodies, few rollouts, two seeds: everything once, in under two minutes."""
    list: bool = False
    """List the tasks, action spaces and encodings, and end."""

    def configuration(self) -> Study:
        """The study that these options ask for.

        Raises:
            ValueError: if an option has a value that it cannot have.
        """
        names = [
            field.name
            for field in dataclasses.fields(PlanOptions)
            if field.default is None and field.name not in ("resolution", "num_actions", "out")
        ]
        given = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        return Study(
            name=self.NAME,
            tasks=self.tasks,
            method=self.method,
            success_score=self.SUCCESS_SCORE,
            action_spaces=self.action_spaces,
            pick_encodings=self.pick_encodings,
            seeds=min(self.seeds, 2) if self.smoke else self.seeds,
            quick=self.smoke,
            resolution=self.resolution,
            budget="smoke" if self.smoke else self.budget,
            settings=given,
            num_actions=self.num_actions,
            planning=self.planning,
            self_contact=self.self_contact,
        )

    def run(self, console: Console) -> None:
        """Run the study, or list what it can be asked for."""
        if self.list:
            _list(console)
            return
        study, folder = self.configuration(), results_folder(self)
        records.open_folder(folder, study.identity())
        # Here, so that --help and wrong options do not wait for matplotlib.
        from experiments.plan_report import write_report

        start = time.perf_counter()
        summary = run_study(study, folder, console)
        write_report(study, summary, folder)
        minutes = (time.perf_counter() - start) / 60
        console.print(f"done in {minutes:.1f} minutes: {folder}/report.md")


@dataclass(frozen=True)
class PaperOptions(PlanOptions):
    """The paper's four tasks: key points of their goals, plans over them and over all particles.

    Stop it with Ctrl-C or kill it at any time: the same command goes on where it was.
    """

    NAME: ClassVar[str] = "paper"

    tasks: tuple[str, ...] = task_names("paper")
    """Tasks to plan for."""
    method: str = "paper"
    """How goals are simplified: robust, paper or meshlab."""


@dataclass(frozen=True)
class GoalsOptions(PlanOptions):
    """Harder goals, planned as the paper's are: letters, folds in sequence, garments.

    Stop it with Ctrl-C or kill it at any time: the same command goes on where it was.
    """

    NAME: ClassVar[str] = "goals"
    SUCCESS_SCORE: ClassVar[float] = 0.8

    tasks: tuple[str, ...] = task_names("goals")
    """Tasks to plan for."""
    pick_encodings: tuple[str, ...] = ("joint",)
    """How CEM encodes what is grasped."""
    budget: Literal["default", "paper", "goals"] = "goals"
    """Search settings: those that end in minutes, the paper's own, or more for several folds."""


@dataclass(frozen=True)
class SimplificationOptions:
    """How often each method finds the right key points of noisy goals.

    Stop it with Ctrl-C or kill it at any time: the same command goes on where it was.
    """

    NAME: ClassVar[str] = "simplification"

    methods: tuple[str, ...] = available_methods()
    """Methods to compare (default: all, meshlab where its extra is installed)."""
    seeds: int = 12
    """Draws of noise for each goal and resolution."""
    out: Path | None = None
    """Output folder (default: results/simplification, or results/simplification-smoke)."""
    smoke: bool = False
    """One resolution, one seed."""

    def configuration(self) -> simplification.Study:
        """The study that these options ask for.

        Raises:
            ValueError: if an option has a value that it cannot have.
        """
        return simplification.Study(
            methods=self.methods,
            seeds=min(self.seeds, 1) if self.smoke else self.seeds,
            rope_sizes=(41,) if self.smoke else (41, 81),
            cloth_sizes=(25,) if self.smoke else (25, 45, 64),
            settled_size=13 if self.smoke else 25,
        )

    def run(self, console: Console) -> None:
        """Run the study."""
        study, folder = self.configuration(), results_folder(self)
        records.open_folder(folder, study.identity())
        from experiments.simplification_report import write_report

        write_report(study, simplification.run_study(study, folder, console), folder)
        console.print(f"done: {folder}/report.md")


@dataclass(frozen=True)
class TransferOptions(PlanOptions):
    """Plans found in our dynamics, carried out in MuJoCo, with self-collision and without.

    Stop it with Ctrl-C or kill it at any time: the same command goes on where it was.
    """

    NAME: ClassVar[str] = "transfer"
    TRANSFER_SCORE: ClassVar[float] = 0.8

    tasks: tuple[str, ...] = task_names("paper")
    """Tasks to plan for."""
    action_spaces: tuple[str, ...] = ("key_points",)
    """Particles that may be grasped."""
    pick_encodings: tuple[str, ...] = ("categorical",)
    """How CEM encodes what is grasped."""
    planning: Literal["nominal", "robust", "self_contact", "mixed"] = "mixed"
    """What the search judges plans in: the body's physics alone, an ensemble of them, the body
    touching itself, or the last for cloths and the first for ropes."""
    plans: Path | None = None
    """Folder of an earlier study, whose plans are replayed; options of planning are its own."""

    def transfer(self) -> transfer.Study:
        """The study that these options ask for.

        Raises:
            ValueError: if an option has a value that it cannot have.
        """
        if self.plans and self.planning != TransferOptions.planning:
            raise ValueError(
                f"--planning {self.planning} finds plans, and those of {self.plans} are found; "
                f"leave one of them out"
            )
        planned = transfer.planned_study(self.plans) if self.plans else self.configuration()
        source = str(self.plans) if self.plans else None
        return transfer.Study(planned, source, self.TRANSFER_SCORE)

    def run(self, console: Console) -> None:
        """Run the study, or list what it can be asked for."""
        if self.list:
            _list(console)
            return
        study, folder = self.transfer(), results_folder(self)
        records.open_folder(folder, study.identity())
        from experiments.transfer_report import write_report

        start = time.perf_counter()
        summary = transfer.run_study(study, folder, console)
        write_report(study, summary, folder)
        if self.plans:
            _add_to_report(study, summary, self.plans)
        minutes = (time.perf_counter() - start) / 60
        console.print(f"done in {minutes:.1f} minutes: {folder}/report.md")


def _add_to_report(study: transfer.Study, summary: dict[str, Any], source: Path) -> None:
    """Add columns of how plans transfer to the report of the study that they are from."""
    from experiments import plan_report

    records.write_json(source / plan_report.TRANSFER_FILE, summary["transfer"])
    path = source / plan_report.SUMMARY_FILE
    if path.exists():
        plan_report.write_report(study.plans, json.loads(path.read_text()), source)


Options = PlanOptions | SimplificationOptions
STUDIES: dict[str, type[Options]] = {
    options.NAME: options
    for options in (PaperOptions, GoalsOptions, SimplificationOptions, TransferOptions)
}
"""Options of the studies by name; the first one is run where none is named."""


def results_folder(options: Options) -> Path:
    """Where results go."""
    name = options.NAME
    if isinstance(options, PlanOptions) and options.planning != type(options).planning:
        name += f"-{options.planning}"
    name += "-smoke" * options.smoke
    return options.out or Path("results") / name


def main() -> int:
    """Run the command line; the exit status is 0, 2 for a wrong request, 130 for Ctrl-C."""
    return exit_status(_run, "interrupted; the same command goes on where it was")


def _run() -> int:
    name, arguments = _study(sys.argv[1:])
    options = tyro.cli(
        STUDIES[name],
        prog=f"python -m experiments.run {name}",
        args=arguments,
        description=f"{inspect.getdoc(STUDIES[name])}\n\nStudies: {', '.join(STUDIES)}.",
    )
    options.run(Console())
    return 0


def _study(arguments: list[str]) -> tuple[str, list[str]]:
    """The name of the study, the first argument if there is one, and the other arguments."""
    if not arguments or arguments[0].startswith("-"):
        return next(iter(STUDIES)), arguments
    name, *others = arguments
    if name not in STUDIES:
        raise ValueError(f"unknown study {name!r}; choose from {', '.join(STUDIES)}")
    return name, others


def _list(console: Console) -> None:
    for name in task_names():
        task = make_task(name)
        console.print(f"task {name}: {task.body.name}, {task.body.num_particles} particles")
    console.print(f"action spaces: {', '.join(ACTION_SPACES)}")
    console.print(f"pick encodings: {', '.join(ENCODINGS)}")


if __name__ == "__main__":
    sys.exit(main())
