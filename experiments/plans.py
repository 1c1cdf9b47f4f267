"""Runs of the studies of plans: key points of goals, then plans over them and over all particles.

The paper's study has its four tasks and its own simplification. It follows Sheng Yin et al.
wherever the paper or its author's code gives details.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from experiments.plan_study import IDENTITY, AnyPlanner, PlanStudy, Run
from experiments.planners import Search, counted_rollouts, num_asks, settings, with_encoding
from experiments.study import teller
from jaxsimp import goals, records
from jaxsimp.cli.progress import progress_bar
from jaxsimp.engines import Execution, goal_scores
from jaxsimp.planning import ENCODINGS, CoarseToFinePlanner, Plan, StagedPlanner
from jaxsimp.planning.algorithm import stages
from jaxsimp.planning.planner import ATTEMPTS
from jaxsimp.simplification import KeyPoints, simplify
from jaxsimp.tasks import Task

ROWS_FILE = "runs.jsonl"
FIELDS = (
    *("planning", "plan", "final_score", "success", "cost_per_question"),
    *(
        "rollouts_per_question",
        "counted_rollouts",
        "non_finite",
        "same_folds",
        "plan_seconds",
        "compile_seconds",
    ),
)
"""Fields that reports and replays read."""
PLANS_FOLDER = "plans"
MOST_UNFOLDED = 2500
"""Most particles of a body whose end is unfolded: of 8,100, a wrong end takes minutes."""

Tasks = dict[tuple[str, str], Task]
"""Tasks by their name and that of the planner, which may change them."""


def row_file(folder: Path) -> records.RowFile:
    """The rows of a study of plans."""
    return records.RowFile(folder / ROWS_FILE, IDENTITY, FIELDS)


def plan_file(run: Run) -> str:
    """Path of the plan of a run, in the folder of its study."""
    return f"{PLANS_FOLDER}/{'-'.join(map(str, run))}.npz"


def all_tasks(study: PlanStudy) -> Tasks:
    """The tasks of a study."""
    return {pair: study.task(*pair) for pair in study.pairs()}


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


def run_fault(tasks: Tasks, folder: Path, row: dict[str, Any]) -> str | None:
    """What is wrong with the plan of a row of a folder, or None."""
    run = Run(*(row[name] for name in IDENTITY))
    task = tasks.get((run.task, run.planner))
    if task is None:
        return None
    file = plan_file(run)
    if row["plan"] != file:
        return f"the row of {folder / file} names {row['plan']!r}"
    return plan_fault(folder / file, task, (row["final_score"],))


def run_study(
    study: PlanStudy, folder: Path, console: Console, *, mixed: bool = False
) -> dict[str, Any]:
    """Run the combinations missing from the folder, and return the summary of all in it.

    Raises:
        ResultsError: if the folder has rows of another environment, unless `mixed`.
    """
    environment, rows, tasks = records.environment(), row_file(folder), all_tasks(study)

    def fault(row: dict[str, Any]) -> str | None:
        file = plan_file(Run(*rows.key(row)))
        return set_plan_aside(folder / file, run_fault(tasks, folder, row))

    rows.resume(environment, mixed=mixed, fault=fault, tell=teller(console))
    console.print("key points of the goals; the first time this compiles, for up to a minute")
    models = {name: key_points(study, name) for name in study.tasks}
    for name, model in models.items():
        console.print(f"{name}: {len(model)} key points {model.particles.tolist()}")
    if todo := rows.left(study.runs()):
        _run_all(study, models, todo, folder, environment, console)
    return {
        "environment": environment,
        "models": [_model_row(study, name, model) for name, model in models.items()],
        "runs": rows.in_order(study.runs()),
    }


def _run_all(
    study: PlanStudy,
    models: dict[str, KeyPoints],
    todo: list[Run],
    folder: Path,
    environment: dict[str, Any],
    console: Console,
) -> None:
    """Compile, estimate, and run task by task, writing a row after each run."""
    (folder / PLANS_FOLDER).mkdir(exist_ok=True)
    planners, seconds, compiled = {}, {}, {}
    left = {
        pair: [run for run in todo if (run.task, run.planner) == pair] for pair in study.pairs()
    }
    left = {pair: runs for pair, runs in left.items() if runs}
    for pair, runs in left.items():
        told = _told(study, *pair)
        console.print(f"{told}: compiling")
        planners[pair] = study.planner(*pair)
        search = study.search(planners[pair].task, pair[1])
        compiled[pair] = planners[pair].prepare(search)
        seconds[pair] = planners[pair].estimate_seconds(search) * len(runs)
        console.print(
            f"{told}: compiled in {compiled[pair]:.1f} s; "
            f"{len(runs)} runs of about {seconds[pair] / len(runs):.1f} s"
        )
    console.print(f"estimate: {sum(seconds.values()) / 60:.1f} minutes for the remaining runs")
    with progress_bar(console) as progress:
        for pair, runs in left.items():
            planner, compile_seconds = planners[pair], compiled[pair]
            search = study.search(planner.task, pair[1])
            total = len(runs) * num_questions(planner, search)
            bar = progress.add_task(_told(study, *pair), total=total)
            for run in runs:
                advance = partial(progress.advance, bar)
                row = _run(planner, search, models[run.task], run, folder, environment, advance)
                row["planning"] = study.planning_of(planner.task)
                row["success"] = (row["final_score"] or 0.0) >= study.success_score
                row["environment"] = environment
                row["compile_seconds"] += compile_seconds
                compile_seconds = 0.0
                records.append_row(folder / ROWS_FILE, row)


def _told(study: PlanStudy, task: str, planner: str) -> str:
    return task if len(study.planners) == 1 else f"{task}, {planner}"


def _run(
    planner: AnyPlanner,
    search: Search,
    model: KeyPoints,
    run: Run,
    folder: Path,
    environment: dict[str, Any],
    on_ask: Callable[[], None],
) -> dict[str, Any]:
    """Plan once, execute, save the plan, and return the row."""
    task, is_key_points = planner.task, run.action_space == "key_points"
    candidates = model if is_key_points else np.arange(task.body.num_particles)
    episode = task.episode_fn(run.seed)
    search = with_encoding(search, ENCODINGS[run.pick_encoding])
    plan = planner.plan(episode, candidates, search, run.seed, on_ask)
    execution = planner.execute(episode, plan.actions)
    file = plan_file(run)
    searches = _searches(planner, plan)
    costs = np.concatenate([each.optimum.best_costs for each in searches])
    records.save_plan(
        folder / file,
        task,
        episode,
        plan.actions,
        execution,
        engine=planner.evaluator,
        found={
            "algorithm": repr(search),
            "seed": run.seed,
            "key_points": model.particles.tolist(),
            "costs": costs[np.isfinite(costs)].tolist(),
        },
        provenance=environment,
    )
    own = np.array(counted_rollouts(search))
    counted = np.concatenate([own + index * own[-1] for index in range(len(searches))])
    score = execution.score if np.isfinite(execution.score) else None
    return {
        **run._asdict(),
        "num_particles": task.body.num_particles,
        "num_key_points": len(model),
        "cost_per_question": [finite(float(cost)) for cost in costs],
        "rollouts_per_question": counted.tolist(),
        "final_cost": finite(float(plan.optimum.cost)),
        "final_score": score,
        "missed_contacts": execution.missed,
        "same_folds": _same_folds(task, execution),
        "rollouts": plan.num_rollouts,
        "counted_rollouts": plan.price,
        "non_finite": int(plan.optimum.failed),
        "plan_seconds": plan.seconds,
        "compile_seconds": plan.compile_seconds,
        "plan": file,
        "config": _row_config(planner, search),
    }


def _same_folds(task: Task, execution: Execution) -> bool | None:
    """Whether the end unfolds to the folds of the goal.

    None for a goal without folds, and for bodies of more than `MOST_UNFOLDED` particles.
    """
    if task.body.num_particles > MOST_UNFOLDED:
        return None
    try:
        wanted = goals.find_folds(task.body, task.goal)
    except ValueError:
        return None
    end = execution.positions[-1].astype(float)
    return goals.same_folds(task.body, task.goal, end) if wanted else None


def _row_config(planner: AnyPlanner, search: Search) -> dict[str, Any]:
    task = planner.task
    return {
        "search": settings(search),
        "num_actions": task.num_actions,
        "num_pickers": task.num_pickers,
        "limits": list(task.limits),
        "running_weight": task.running_weight,
        "time_step": task.time_step,
        "action_steps": task.action_steps,
        "settle_actions": task.settle_actions,
        "layout": dataclasses.asdict(planner.layout_of(stages(search)[0])),
    }


def _searches(planner: AnyPlanner, plan: Plan) -> tuple[Plan, ...]:
    """The searches of a plan by the algorithm of its row: of a fine body, that on the coarsest."""
    return (plan.parts[0] if isinstance(planner, CoarseToFinePlanner) else plan).searches


def num_questions(planner: AnyPlanner, search: Search) -> int:
    """Number of questions of all searches for one plan."""
    if isinstance(planner, CoarseToFinePlanner):
        return ATTEMPTS * num_asks(search) + sum(map(num_asks, planner.refinements))
    return num_asks(search) * (planner.num_searches if isinstance(planner, StagedPlanner) else 1)


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
    scores = goal_scores(task, task.episode_fn(0), study.evaluator())
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
