"""Run a study: `python -m experiments.run`. All options: `python -m experiments.run --help`."""

import dataclasses
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from experiments import records
from experiments.paper import ACTION_SPACES, Study, run_study
from jaxsimp.planning import ENCODINGS
from jaxsimp.tasks import make_task, task_names

INTERRUPTED = 130
"""Exit status of a program that Ctrl-C ended, as shells have it."""


@dataclass(frozen=True)
class Options:
    """Key points of the paper's goals, and plans over them and over all particles.

    Stop it with Ctrl-C or kill it at any time: the same command goes on where it was.
    """

    study: Annotated[Literal["paper"], tyro.conf.Positional] = "paper"
    """What is run: "paper" reproduces its four tasks."""
    tasks: tuple[str, ...] = task_names()
    """Tasks to plan for."""
    action_spaces: tuple[str, ...] = ACTION_SPACES
    """Particles that may be grasped."""
    pick_encodings: tuple[str, ...] = tuple(ENCODINGS)
    """How CEM encodes what is grasped."""
    seeds: int = 10
    """Seeds 0 to SEEDS - 1 of each combination."""
    resolution: int | None = None
    """Particles along the rope or a side of the cloth (default: 41 and 25)."""
    budget: Literal["default", "paper"] = "default"
    """Search settings: those that end in minutes, or the paper's own."""
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
            for field in dataclasses.fields(Options)
            if field.default is None and field.name not in ("resolution", "num_actions", "out")
        ]
        given = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        return Study(
            tasks=self.tasks,
            action_spaces=self.action_spaces,
            pick_encodings=self.pick_encodings,
            seeds=min(self.seeds, 2) if self.smoke else self.seeds,
            quick=self.smoke,
            resolution=self.resolution,
            budget="smoke" if self.smoke else self.budget,
            settings=given,
            num_actions=self.num_actions,
        )

    @property
    def folder(self) -> Path:
        """Where results go."""
        return self.out or Path("results") / ("paper-smoke" if self.smoke else "paper")


def main() -> int:
    """Run the command line; the exit status is 0, 2 for a wrong request, 130 for Ctrl-C."""
    options = tyro.cli(Options, prog="python -m experiments.run")
    console = Console()
    if options.list:
        _list(console)
        return 0
    try:
        study = options.configuration()
        records.open_folder(options.folder, study.identity())
        _run(study, options.folder, console)
    except (ValueError, records.ResultsError) as error:
        Console(stderr=True).print(f"error: {error}", style="red", markup=False, highlight=False)
        return 2
    except KeyboardInterrupt:
        console.print(f"\ninterrupted; the same command goes on from {options.folder}")
        return INTERRUPTED
    return 0


def _run(study: Study, folder: Path, console: Console) -> None:
    # Here, so that --help and wrong options do not wait for matplotlib.
    from experiments.report import write_report

    start = time.perf_counter()
    summary = run_study(study, folder, console)
    write_report(study, summary, folder)
    console.print(f"done in {(time.perf_counter() - start) / 60:.1f} minutes: {folder}/report.md")


def _list(console: Console) -> None:
    for name in task_names():
        task = make_task(name)
        console.print(f"task {name}: {task.body.name}, {task.body.num_particles} particles")
    console.print(f"action spaces: {', '.join(ACTION_SPACES)}")
    console.print(f"pick encodings: {', '.join(ENCODINGS)}")


if __name__ == "__main__":
    sys.exit(main())
