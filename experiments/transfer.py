"""The study of transfer: plans found in our dynamics, carried out in MuJoCo.

The study replays each plan in both variants of `jaxsimp.engines.mujoco`. It also scores hand-made
plans in all three engines: if they transfer and the plans found do not, the search has exploited
our dynamics; if neither do, the engines differ.
"""

import dataclasses
import json
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import jax.numpy as jnp
from rich.console import Console

from experiments import plans
from experiments.plan_options import PlanOptions
from experiments.plan_study import IDENTITY, PlanStudy, Run
from experiments.scripted import SCRIPTS, scripted_plan
from experiments.study import teller, told_done
from jaxsimp import records
from jaxsimp.cli.progress import progress_bar
from jaxsimp.engines import Execution, MuJoCo, replay
from jaxsimp.engines.mujoco import VARIANTS
from jaxsimp.tasks import Task, score, task_names

ROWS_FILE = "replays.jsonl"
REPLAYS_FOLDER = "replays"
SCRIPTED = "scripted"
"""Name of the action space of hand-made plans."""
SCRIPTED_SEEDS = 2
"""Number of seeds of the hand-made plans: a fold starts flat, and the seed sets its turn."""
FIELDS = (
    *("planning", "plan", "final_score", "warnings"),
    *(f"mujoco_{name}_score" for name in VARIANTS),
)
"""Fields that the report reads."""


@dataclass(frozen=True)
class TransferStudy:
    """Configuration of the study.

    Attributes:
        plans: study of the plans to replay.
        source: folder of its results; None if this study finds the plans, in its own folder.
        success_score: smallest settled score of a plan that transfers.
    """

    plans: PlanStudy
    source: str | None
    success_score: float

    def identity(self) -> dict[str, Any]:
        """Identity of a folder of results: the plans, and the models of MuJoCo."""
        variants = {name: dataclasses.asdict(variant) for name, variant in VARIANTS.items()}
        return {
            "source": self.source,
            "success_score": self.success_score,
            "variants": variants,
            "plans": self.plans.identity(),
        }

    def scripted(self) -> Iterator[tuple[str, int]]:
        """Task and seed of the scripted plans."""
        for name in self.plans.tasks:
            if name in SCRIPTS:
                first, count = self.plans.first_seed, min(self.plans.seeds, SCRIPTED_SEEDS)
                yield from ((name, seed) for seed in range(first, first + count))


@dataclass(frozen=True)
class Case:
    """A plan to replay: its row of results so far, and the path of its arrays."""

    row: dict[str, Any]
    path: Path

    @property
    def key(self) -> tuple[Any, ...]:
        """Values that identify the plan."""
        return tuple(self.row[name] for name in IDENTITY)


def planned_study(folder: Path) -> PlanStudy:
    """The study of plans with its results in a folder.

    Raises:
        ValueError: if the folder holds no results of a study of plans.
    """
    try:
        config = json.loads((folder / records.CONFIG_FILE).read_text())
        names = [field.name for field in dataclasses.fields(PlanStudy)]
        settings = {name: config[name] for name in names}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(
            f"{folder} holds no plans ({type(error).__name__}: {error}); give the folder of a "
            f"study of plans, as results/paper"
        ) from error
    lists = {name: tuple(value) for name, value in settings.items() if isinstance(value, list)}
    return PlanStudy(**{**settings, **lists})


def run_study(
    study: TransferStudy, folder: Path, console: Console, *, mixed: bool = False
) -> dict[str, Any]:
    """Plan and replay the cases missing from the folder, and return the summary of all.

    Raises:
        ResultsError: if the folder has rows of another environment, unless `mixed`; or a plan of
            an earlier study is missing or damaged.
    """
    environment = records.environment()
    rows = records.RowFile(folder / ROWS_FILE, IDENTITY, FIELDS)
    rows.resume(environment, mixed=mixed, tell=teller(console))
    if study.source is None:
        found, source = plans.run_study(study.plans, folder, console, mixed=mixed)["runs"], folder
    else:
        source = Path(study.source)
        found = _earlier_runs(study.plans, source)
    cases = [Case(_row_of_plan(row), source / row["plan"]) for row in found]
    cases += _scripted_cases(study, folder, console)
    fault = partial(_replay_fault, study, folder, {case.key: case for case in cases})
    rows.resume(environment, mixed=mixed, fault=fault, tell=teller(console))
    _replay_all(study, cases, rows, folder, environment, console)
    ordered = rows.in_order(case.key for case in cases)
    return {
        "environment": environment,
        "transfer": [row for row in ordered if row["action_space"] != SCRIPTED],
        "scripted": [row for row in ordered if row["action_space"] == SCRIPTED],
    }


def _earlier_runs(study: PlanStudy, source: Path) -> list[dict[str, Any]]:
    """The runs of an earlier study whose plans are whole.

    Raises:
        ResultsError: if a row or a plan is damaged.
    """
    rows = plans.row_file(source)
    by_key = {rows.key(row): row for row in rows.rows()}
    found = [by_key[run] for run in study.runs() if run in by_key]
    tasks = plans.all_tasks(study)
    for row in found:
        if fault := plans.run_fault(tasks, source, row):
            raise records.ResultsError(f"{fault}; run its study again, which makes it again")
    return found


def _replay_fault(
    study: TransferStudy, folder: Path, cases: dict[tuple[Any, ...], Case], row: dict[str, Any]
) -> str | None:
    """What is wrong with the replays of a row, whose files are set aside then; or None."""
    case = cases.get(tuple(row[name] for name in IDENTITY))
    if case is None:
        return None
    if any(row.get(name) != value for name, value in case.row.items()):
        return f"{folder / ROWS_FILE}: the replay of {row['plan']!r} is of another plan"
    task = study.plans.task(row["task"], row["planner"])
    for variant in VARIANTS:
        path, score = replay_path(folder, row, variant), row[f"mujoco_{variant}_score"]
        if fault := plans.set_plan_aside(path, plans.plan_fault(path, task, (score,))):
            return fault
    return None


def _row_of_plan(row: dict[str, Any]) -> dict[str, Any]:
    """Fields that a replay's row takes from the row of its plan."""
    return {name: row[name] for name in (*IDENTITY, "planning", "final_score", "plan")}


def _scripted_cases(study: TransferStudy, folder: Path, console: Console) -> list[Case]:
    """Hand-made plans, carried out in our dynamics unless already on disk."""
    (folder / plans.PLANS_FOLDER).mkdir(exist_ok=True)
    cases, executors = [], {}
    for name, seed in study.scripted():
        path = folder / plans.PLANS_FOLDER / f"{name}-{SCRIPTED}-{seed}.npz"
        task = study.plans.task(name)
        episode = task.episode_fn(seed)
        fault = plans.plan_fault(path, task)
        if fault and path.exists():
            teller(console)(f"{plans.set_plan_aside(path, fault)}; it is made again")
        if fault:
            if name not in executors:
                console.print(f"{name}: plans made by hand")
                executors[name] = study.plans.evaluator().executor(task)
            actions = scripted_plan(task, episode)
            execution = executors[name](episode, actions)
            engine = study.plans.evaluator()
            records.save_plan(path, task, episode, actions, execution, engine=engine)
        settled = records.load_plan(path).positions[-1].astype(float)
        value = float(score(task, episode, jnp.asarray(settled)))
        row = {
            **Run(name, study.plans.planners[0], SCRIPTED, SCRIPTED, seed)._asdict(),
            "planning": SCRIPTED,
            "final_score": plans.finite(value),
            "plan": f"{plans.PLANS_FOLDER}/{path.name}",
        }
        cases.append(Case(row, path))
    return cases


def _replay_all(
    study: TransferStudy,
    cases: list[Case],
    rows: records.RowFile,
    folder: Path,
    environment: dict[str, Any],
    console: Console,
) -> None:
    """Replay the cases without a row, task by task."""
    (folder / REPLAYS_FOLDER).mkdir(exist_ok=True)
    todo = set(rows.left(case.key for case in cases))
    left = [case for case in cases if case.key in todo]
    with progress_bar(console) as progress:
        bar = progress.add_task("replays in MuJoCo", total=len(left))
        for name, planner in study.plans.pairs():
            task = study.plans.task(name, planner)
            of_task = [
                case for case in left if (case.row["task"], case.row["planner"]) == (name, planner)
            ]
            for row in _replay_task(task, of_task, folder) if of_task else ():
                rows.append(row | {"environment": environment})
                progress.advance(bar)


def _replay_task(task: Task, cases: list[Case], folder: Path) -> Iterator[dict[str, Any]]:
    """Replay plans in every variant, save each one's motions, and return its row."""
    episodes = [task.episode_fn(case.row["seed"]) for case in cases]
    plans = [records.load_plan(case.path).actions for case in cases]
    # All variants at once, so that no core waits for the last plan of a variant.
    found = [replay(task, episodes, plans, name) for name in VARIANTS]
    for case, episode, actions, *results in zip(cases, episodes, plans, *found, strict=True):
        replays = dict(zip(VARIANTS, results, strict=True))
        for name, result in replays.items():
            path = replay_path(folder, case.row, name)
            records.save_plan(path, task, episode, actions, result, engine=MuJoCo(name))
        yield case.row | _fields(replays)


def _fields(replays: dict[str, Execution]) -> dict[str, Any]:
    """Fields that replays add to a row."""
    warnings = [f"{name}: {each}" for name, one in replays.items() for each in one.warnings]
    scores = {f"mujoco_{name}_score": plans.finite(one.score) for name, one in replays.items()}
    status = {f"mujoco_{name}_status": one.status.name for name, one in replays.items()}
    return scores | status | {"warnings": warnings}


def replay_path(folder: Path, row: dict[str, Any], variant: str) -> Path:
    """Path of the motion of a replay."""
    return folder / REPLAYS_FOLDER / f"{Path(row['plan']).stem}-{variant}.npz"


@dataclass(frozen=True)
class TransferOptions(PlanOptions):
    """Plans found in our dynamics, carried out in MuJoCo, with self-collision and without.

    Stop it with Ctrl-C or kill it at any time: the same command resumes it.
    """

    NAME: ClassVar[str] = "transfer"
    TRANSFER_SCORE: ClassVar[float] = 0.8

    tasks: tuple[str, ...] = task_names("paper")
    """Tasks to plan for."""
    action_spaces: tuple[str, ...] = ("key_points",)
    """Action spaces: the particles that a picker may grasp."""
    pick_encodings: tuple[str, ...] = ("joint",)
    """CEM's encoding of the choice of particles."""
    plans: Path | None = None
    """Folder of an earlier study of plans to replay, which sets the options of planning."""

    def transfer(self) -> TransferStudy:
        """The study of these options.

        Raises:
            ValueError: if the value of an option is invalid.
        """
        if self.plans and self.planning != TransferOptions.planning:
            raise ValueError(
                f"--planning {self.planning} finds plans, but {self.plans} already holds plans; "
                f"leave out --planning or --plans"
            )
        planned = planned_study(self.plans) if self.plans else self.configuration()
        source = str(self.plans) if self.plans else None
        return TransferStudy(planned, source, self.TRANSFER_SCORE)

    def run(self, console: Console) -> None:
        """Run the study, or list its possible tasks, action spaces and encodings."""
        if self.list:
            super().run(console)
            return
        study, folder = self.transfer(), self.folder()
        start = time.perf_counter()
        with records.open_folder(folder, study.identity()):
            from experiments.transfer_report import write_report

            summary = run_study(study, folder, console, mixed=self.mixed)
            write_report(study, summary, folder)
            if self.plans:
                _add_to_report(study, summary, self.plans, teller(console))
        told_done(console, folder, start)


def _add_to_report(
    study: TransferStudy, summary: dict[str, Any], source: Path, tell: Callable[[str], None]
) -> None:
    """Add columns on transfer to the report of the study of the plans.

    Raises:
        ResultsError: if another process holds the folder of that study.
    """
    from experiments import plan_report

    with records.lock_folder(source):
        records.write_json(source / plan_report.TRANSFER_FILE, summary["transfer"])
        path = source / plan_report.SUMMARY_FILE
        if not path.exists():
            return
        try:
            earlier = json.loads(path.read_text())
            earlier["runs"], earlier["models"]
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            tell(
                f"{path} is damaged ({type(error).__name__}: {error}), and its report is left as "
                f"it is; run the study of these plans again, which makes both again"
            )
            return
        plan_report.write_report(study.plans, earlier, source, tell)
