"""Studies of plans: key points of goals, then plans over them and over all particles.

The paper's study has its four tasks and its own simplification. It follows Sheng Yin et al.
wherever the paper or its author's code gives details: `BUDGETS` holds the author's settings and
settings for a search of minutes.
"""

import dataclasses
import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from math import ceil
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rich.console import Console

from experiments.progress import progress_bar
from experiments.study import teller
from jaxsimp import records
from jaxsimp.checks import require_count
from jaxsimp.engines import MassSprings, SearchEngine, Spread, goal_scores, make_ensemble
from jaxsimp.planning import CEM, ENCODINGS, Planner
from jaxsimp.simplification import METHODS, KeyPoints, simplify
from jaxsimp.tasks import Task, make_task, task_names

ACTION_SPACES = ("key_points", "all_particles")
PLANNING = ("nominal", "robust", "self_contact", "mixed")
"""Physics of a search: the body's own, an ensemble, self-contact, or self-contact only for cloths,
whose folds have layers."""
ENSEMBLE_SIZE = 4
ROWS_FILE = "runs.jsonl"
IDENTITY = ("task", "action_space", "pick_encoding", "seed")
"""Fields that identify a run."""
FIELDS = (
    *("planning", "plan", "final_score", "success", "cost_per_iteration", "rollouts"),
    *("non_finite", "plan_seconds", "compile_seconds"),
)
"""Fields that reports and replays read."""
PLANS_FOLDER = "plans"


@dataclass(frozen=True)
class Budget:
    """Budget of a plan: the search settings, and overrides of the task's plan shape."""

    rope: CEM
    cloth: CEM
    garment: CEM | None = None
    num_actions: int | None = None
    limit: float | None = None

    def config(self, task: Task) -> CEM:
        """The search settings for a task's kind of body; a garment's are a cloth's by default."""
        if not len(task.body.faces):
            return self.rope
        is_grid = len(task.body.shape) == 2
        return self.cloth if is_grid or self.garment is None else self.garment


_PAPER = CEM(
    num_iterations=20,
    initial_populations=1,
    smoothing=0.0,
    initial_spread=0.5**0.5,
    keep_best=False,
    returns="mean",
)
BUDGETS = {
    "default": Budget(rope=CEM(num_iterations=24), cloth=CEM(num_iterations=24)),
    "paper": Budget(
        rope=dataclasses.replace(_PAPER, population=70),
        cloth=dataclasses.replace(_PAPER, population=333),
        num_actions=15,
        limit=0.08,
    ),
    "goals": Budget(
        rope=CEM(num_iterations=24),
        # The search finds several folds one after another: it must not converge on the first.
        cloth=CEM(num_iterations=40, smoothing=0.2),
        garment=CEM(num_iterations=24),
    ),
    "smoke": Budget(
        rope=CEM(num_iterations=3, population=16, initial_populations=1),
        cloth=CEM(num_iterations=3, population=16, initial_populations=1),
    ),
}


@dataclass(frozen=True)
class PlanStudy:
    """Configuration of the study; results of the same configuration are comparable.

    Attributes:
        name: name of the study.
        tasks: names of the tasks.
        method: method of simplification.
        success_score: smallest settled score of a successful plan.
        action_spaces: names of the sets of particles that a picker may grasp.
        pick_encodings: names of the encodings.
        seeds: number of seeds: every combination runs with the seeds 0 to `seeds` - 1.
        quick: whether bodies are small instead of full.
        resolution: number of particles along a side, instead of the scale's.
        budget: name of the budget.
        settings: CEM settings that replace the budget's.
        num_actions: number of actions in a plan, instead of the budget's or the task's.
        planning: physics of the search, one of `PLANNING`.
        self_contact: whether to carry out and score the plans found with self-contact.
    """

    name: str
    tasks: tuple[str, ...]
    method: str
    success_score: float
    action_spaces: tuple[str, ...]
    pick_encodings: tuple[str, ...]
    seeds: int
    quick: bool
    resolution: int | None
    budget: Literal["default", "paper", "goals", "smoke"]
    settings: dict[str, Any]
    num_actions: int | None
    planning: Literal["nominal", "robust", "self_contact", "mixed"]
    self_contact: bool

    def __post_init__(self) -> None:
        _require_known("task", self.tasks, task_names())
        _require_known("planning", (self.planning,), PLANNING)
        _require_known("method", (self.method,), tuple(METHODS))
        _require_known("action space", self.action_spaces, ACTION_SPACES)
        _require_known("pick encoding", self.pick_encodings, tuple(ENCODINGS))
        require_count("seeds", self.seeds, 1)
        if self.num_actions is not None:
            require_count("num_actions", self.num_actions, 1)
        for name in self.tasks:  # Raises for a wrong resolution or setting before any run.
            self.search_config(self.task(name))

    def task(self, name: str) -> Task:
        """A task at this study's scale and budget."""
        task = make_task(name, self.resolution, quick=self.quick)
        budget = BUDGETS[self.budget]
        num_actions = self.num_actions or budget.num_actions or task.num_actions
        limits = (budget.limit,) * 3 if budget.limit else task.limits
        return dataclasses.replace(task, num_actions=num_actions, limits=limits)

    def search_config(self, task: Task) -> CEM:
        """The search settings of a task."""
        config = BUDGETS[self.budget].config(task)
        if self.planning_of(task) == "self_contact":
            # A round takes about four times as long.
            rounds = ceil(config.num_iterations / 2)
            config = dataclasses.replace(config, num_iterations=rounds)
        return dataclasses.replace(config, **self.settings)

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

    def identity(self) -> dict[str, Any]:
        """Identity of a folder of results: the options, and the meaning of their names."""
        search = {name: settings(self.search_config(self.task(name))) for name in self.tasks}
        spread = {"size": ENSEMBLE_SIZE, "spread": dataclasses.asdict(Spread())}
        ensemble = spread if self.planning == "robust" else None
        return {**dataclasses.asdict(self), "search": search, "ensemble": ensemble}

    def runs(self, task: str) -> Iterator[tuple[str, str, int]]:
        """Action space, encoding and seed of every run of a task."""
        return itertools.product(self.action_spaces, self.pick_encodings, range(self.seeds))


def _require_known(kind: str, names: tuple[str, ...], known: tuple[str, ...]) -> None:
    if not names:
        raise ValueError(f"no {kind} is given; choose from {', '.join(known)}")
    for name in names:
        if name not in known:
            raise ValueError(f"unknown {kind} {name!r}; choose from {', '.join(known)}")
        if names.count(name) > 1:
            raise ValueError(f"{kind} {name!r} is given twice; give it once")


def row_file(folder: Path) -> records.RowFile:
    """The rows of a study of plans."""
    return records.RowFile(folder / ROWS_FILE, IDENTITY, FIELDS)


def plan_file(task: str, action_space: str, encoding: str, seed: int) -> str:
    """Path of the plan of a run, in the folder of its study."""
    return f"{PLANS_FOLDER}/{task}-{action_space}-{encoding}-{seed}.npz"


def plan_fault(path: Path, task: Task, scores: tuple[float | None, ...] = ()) -> str | None:
    """What is wrong with a plan file, or None.

    Args:
        path: path of the file.
        task: the task that the plan is for.
        scores: the score that the file must have; any if empty.
    """
    if not path.exists():
        return f"{path} is missing"
    try:
        plan = records.load_plan(path)
    except ValueError as error:
        return str(error)
    frames = (task.num_actions + 2, task.body.num_particles, 3)
    picks = (task.num_actions, task.num_pickers)
    if plan.positions.shape != frames or plan.actions.pick.shape != picks:
        return (
            f"{path} has positions of shape {plan.positions.shape} and picks of shape "
            f"{plan.actions.pick.shape}, not {frames} and {picks}"
        )
    if scores and plan.about.get("score", "none is there") not in scores:
        return f"{path} has another score than its row"
    return None


def set_plan_aside(path: Path, fault: str | None) -> str | None:
    """Give a plan file with a fault another name, and return the fault with that name."""
    if fault is None or not path.exists():
        return fault
    kept = records.set_aside(path)
    path.unlink()
    return f"{fault} (kept as {kept.name})"


def all_runs(study: PlanStudy) -> list[tuple[str, str, str, int]]:
    """The identity of every run of a study, in order."""
    return [(name, *run) for name in study.tasks for run in study.runs(name)]


def run_fault(tasks: dict[str, Task], folder: Path, row: dict[str, Any]) -> str | None:
    """What is wrong with the plan of a row of a folder, or None."""
    if row["task"] not in tasks:
        return None
    file = plan_file(*(row[name] for name in IDENTITY))
    if row["plan"] != file:
        return f"the row of {folder / file} names {row['plan']!r}"
    return plan_fault(folder / file, tasks[row["task"]], (row["final_score"],))


def run_study(
    study: PlanStudy, folder: Path, console: Console, *, mixed: bool = False
) -> dict[str, Any]:
    """Run the combinations missing from the folder, and return the summary of all in it.

    Raises:
        ResultsError: if the folder has rows of another environment, unless `mixed`.
    """
    environment, rows = records.environment(), row_file(folder)
    tasks = {name: study.task(name) for name in study.tasks}

    def fault(row: dict[str, Any]) -> str | None:
        return set_plan_aside(folder / plan_file(*rows.key(row)), run_fault(tasks, folder, row))

    rows.resume(environment, mixed=mixed, fault=fault, tell=teller(console))
    console.print("key points of the goals; the first time this compiles, for up to a minute")
    models = {name: key_points(study, name) for name in study.tasks}
    for name, model in models.items():
        console.print(f"{name}: {len(model)} key points {model.particles.tolist()}")
    runs = all_runs(study)
    todo = rows.left(runs)
    left = {
        name: [(space, encoding, seed) for task, space, encoding, seed in todo if task == name]
        for name in study.tasks
    }
    if todo:
        _run_all(study, models, left, folder, environment, console)
    return {
        "environment": environment,
        "models": [_model_row(study, name, model) for name, model in models.items()],
        "runs": rows.in_order(runs),
    }


def _run_all(
    study: PlanStudy,
    models: dict[str, KeyPoints],
    left: dict[str, list[tuple[str, str, int]]],
    folder: Path,
    environment: dict[str, Any],
    console: Console,
) -> None:
    """Compile, estimate, and run task by task, writing a row after each run."""
    (folder / PLANS_FOLDER).mkdir(exist_ok=True)
    planners, seconds, compiled = {}, {}, {}
    for name in (name for name, runs in left.items() if runs):
        console.print(f"{name}: compiling")
        task = study.task(name)
        evaluator = MassSprings(self_contact=study.self_contact)
        planners[name] = Planner(task, study.engine(task), evaluator)
        compiled[name] = planners[name].prepare(study.search_config(task))
        seconds[name] = planners[name].estimate_seconds(study.search_config(task)) * len(left[name])
        console.print(
            f"{name}: compiled in {compiled[name]:.1f} s; "
            f"{len(left[name])} runs of about {seconds[name] / len(left[name]):.1f} s"
        )
    console.print(f"estimate: {sum(seconds.values()) / 60:.1f} minutes for the remaining runs")
    with progress_bar(console) as progress:
        for name, planner in planners.items():
            algorithm, compile_seconds = study.search_config(planner.task), compiled[name]
            bar = progress.add_task(name, total=len(left[name]) * algorithm.num_asks)
            for run in left[name]:
                advance = partial(progress.advance, bar)
                row = _run(planner, algorithm, models[name], run, folder, environment, advance)
                row["planning"] = study.planning_of(planner.task)
                row["success"] = (row["final_score"] or 0.0) >= study.success_score
                row["environment"] = environment
                row["compile_seconds"] += compile_seconds
                compile_seconds = 0.0
                records.append_row(folder / ROWS_FILE, row)


def _run(
    planner: Planner,
    algorithm: CEM,
    model: KeyPoints,
    run: tuple[str, str, int],
    folder: Path,
    environment: dict[str, Any],
    on_ask: Callable[[], None],
) -> dict[str, Any]:
    """Plan once, execute, save the plan, and return the row."""
    action_space, encoding, seed = run
    task = planner.task
    candidates = model if action_space == "key_points" else np.arange(task.body.num_particles)
    episode = task.episode_fn(seed)
    algorithm = dataclasses.replace(algorithm, encoding=ENCODINGS[encoding])
    plan = planner.plan(episode, candidates, algorithm, seed, on_ask)
    execution = planner.execute(episode, plan.actions)
    file = plan_file(task.name, action_space, encoding, seed)
    records.save_plan(
        folder / file,
        task,
        episode,
        plan.actions,
        execution,
        engine=planner.evaluator,
        found={"algorithm": repr(algorithm), "seed": seed},
        provenance=environment,
    )
    score = execution.score if np.isfinite(execution.score) else None
    found, rounds = plan.optimum, slice(algorithm.initial_populations - 1, None)
    elite_costs = found.traces[0]["elite_costs"][rounds]
    return {
        "task": task.name,
        "action_space": action_space,
        "pick_encoding": encoding,
        "seed": seed,
        "num_particles": task.body.num_particles,
        "num_key_points": len(model),
        "cost_per_iteration": [finite(float(cost)) for cost in found.best_costs[rounds]],
        "elite_cost_per_iteration": [finite(float(costs.mean())) for costs in elite_costs],
        "final_cost": finite(float(found.cost)),
        "final_score": score,
        "missed_contacts": execution.missed,
        "rollouts": plan.num_rollouts,
        "non_finite": int(found.failed),
        "plan_seconds": plan.seconds,
        "compile_seconds": plan.compile_seconds,
        "plan": file,
        "config": _row_config(planner, algorithm),
    }


def settings(algorithm: CEM) -> dict[str, Any]:
    """Settings of a search without its encoding, which has its own field."""
    found = dataclasses.asdict(algorithm)
    del found["encoding"]
    return found


def _row_config(planner: Planner, algorithm: CEM) -> dict[str, Any]:
    task = planner.task
    return {
        **settings(algorithm),
        "num_actions": task.num_actions,
        "num_pickers": task.num_pickers,
        "limits": list(task.limits),
        "time_step": task.time_step,
        "action_steps": task.action_steps,
        "settle_actions": task.settle_actions,
        "layout": dataclasses.asdict(planner.layout_of(algorithm)),
    }


def finite(value: float) -> float | None:
    """The value, or None (null in JSON, which has no infinity) if it is not finite."""
    return value if np.isfinite(value) else None


def key_points(study: PlanStudy, name: str) -> KeyPoints:
    """The key points of a task's goal."""
    task = study.task(name)
    return simplify(task.body, task.goal, method=study.method)


def _model_row(study: PlanStudy, name: str, model: KeyPoints) -> dict[str, Any]:
    """The key points of a task's goal, and what the goal itself scores."""
    task = study.task(name)
    scores = goal_scores(task, task.episode_fn(0), MassSprings(self_contact=study.self_contact))
    return {
        "task": name,
        "goal_score": finite(scores.laid),
        "goal_settled_score": finite(scores.settled),
        "method": model.method,
        "sizes": list(model.sizes),
        "errors": list(model.errors),
        "threshold": model.tolerance,
        "key_points": model.particles.tolist(),
    }
