"""Output of a study of plans: summary.json, figures, and a report."""

import json
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from experiments.plan_study import IDENTITY, PlanStudy
from experiments.plans import PLANS_FOLDER, ROWS_FILE, key_points
from jaxsimp import records, viz
from jaxsimp.records.markdown import provenance, save_figure, spread, success_interval, table

Rows = list[dict[str, Any]]
SUMMARY_FILE = "summary.json"
TRANSFER_FILE = "transfer.json"
"""Results of the plans in MuJoCo, once the study of transfer has replayed them."""
LABELS = {
    "key_points": "key points",
    "all_particles": "all particles",
    "categorical": "categorical",
    "gaussian_index": "Gaussian index",
    "joint": "joint",
}


def write_report(
    study: PlanStudy, summary: dict[str, Any], folder: Path, tell: Callable[[str], None] = print
) -> None:
    """Write `summary.json`, the figures and `report.md`; what is damaged is told.

    Each file is written whole or not at all.
    """
    records.write_json(folder / SUMMARY_FILE, summary)
    figures = folder / "figures"
    figures.mkdir(exist_ok=True)
    tasks = {name: study.task(name) for name in study.tasks}
    models = {name: key_points(study, name) for name in tasks}
    rows = summary["runs"]
    save_figure(viz.plot_model_errors(models), figures / "model_errors.png")
    shown = {name: (task.body, task.goal, models[name]) for name, task in tasks.items()}
    save_figure(viz.plot_models(shown), figures / "models.png")
    save_figure(
        viz.plot_costs(
            {name: _costs(_of(rows, task=name)) for name in tasks},
            rollouts={name: _rollouts(_of(rows, task=name)) for name in tasks},
        ),
        figures / "costs.png",
    )
    for name, task in tasks.items():
        plans = _typical_plans(_of(rows, task=name), folder)
        seed = _typical_seed(_of(rows, task=name))
        goal = np.asarray(task.episode_fn(seed).goal)
        figure = viz.plot_executions(task.body, goal, plans, name, task.obstacles)
        save_figure(figure, figures / f"plans_{name}.png")
    transfer = _replayed(folder, tell)
    records.write_text(folder / "report.md", _report(study, summary, transfer))


def _replayed(folder: Path, tell: Callable[[str], None]) -> Rows:
    """Rows of plans that were replayed in MuJoCo; a damaged file is set aside."""
    path = folder / TRANSFER_FILE
    if not path.exists():
        return []
    try:
        rows = json.loads(path.read_text())
        for row in rows:
            _ = [row[name] for name in (*IDENTITY, "mujoco_full_score")]
        return rows
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        kept = records.set_aside(path)
        path.unlink()
        tell(
            f"{path} is damaged ({type(error).__name__}: {error}); it is kept as {kept.name}, and "
            f"`python -m experiments.run transfer --plans {folder}` makes it again"
        )
        return []


def _of(rows: Rows, **fields: Any) -> Rows:
    return [row for row in rows if all(row[name] == value for name, value in fields.items())]


def _methods(rows: Rows) -> dict[str, Rows]:
    """Rows by method, in the order of the methods' first rows."""
    methods: dict[str, Rows] = defaultdict(list)
    has_several = len({row["planner"] for row in rows}) > 1
    for row in rows:
        name = f"{LABELS[row['action_space']]}, {LABELS[row['pick_encoding']]}"
        methods[f"{row['planner']}: {name}" if has_several else name].append(row)
    return methods


def _costs(rows: Rows) -> dict[str, np.ndarray]:
    """Cost of the best plan so far, one row per run; NaN before the first finite cost."""
    return {
        method: np.array([row["cost_per_question"] for row in runs], dtype=float)
        for method, runs in _methods(rows).items()
    }


def _rollouts(rows: Rows) -> dict[str, np.ndarray]:
    """Counted rollouts up to each of these costs."""
    return {
        method: np.array(runs[0]["rollouts_per_question"], dtype=float)
        for method, runs in _methods(rows).items()
    }


def _typical_seed(rows: Rows) -> int:
    """The seed with the median score of the first method."""
    runs = next(iter(_methods(rows).values()))
    return sorted(runs, key=lambda row: _score(row))[len(runs) // 2]["seed"]


def _score(row: dict[str, Any], column: str = "final_score") -> float:
    return -np.inf if row[column] is None else row[column]


def _typical_plans(rows: Rows, folder: Path) -> dict[str, tuple[np.ndarray, float]]:
    """Positions and score of the plan of the typical seed, by method."""
    chosen = _methods(_of(rows, seed=_typical_seed(rows)))
    return {
        method: (records.load_plan(folder / run["plan"]).positions, _score(run))
        for method, (run,) in chosen.items()
    }


def _report(study: PlanStudy, summary: dict[str, Any], transfer: Rows) -> str:
    lines = [
        f"# Goal-conditioned model simplification: the study {study.name!r}",
        "",
        f"A plan succeeds when its settled score is at least {study.success_score}. Score 1 is a "
        f"cost of 0, which a goal need not have, and 0 is the start; the body "
        f"{_touching(study)}. "
        f"{study.seeds} seeds a row, from {study.first_seed}; intervals are 95 % "
        "(Wilson for rates, Student's t in the figures). Ends have the same folds as the goal if "
        "they unfold alike. A counted rollout is one without self-contact: a gradient counts as "
        "6, a rollout with self-contact as 4.",
        "",
        *_model_table(summary["models"]),
        "",
        *_run_table(summary["runs"], transfer),
        "",
        "## Model error by number of key points",
        "![model errors](figures/model_errors.png)",
        "",
        "## Simplified models over their goals",
        "![models](figures/models.png)",
        "",
        "## Cost of the best plan by counted rollouts, mean and 95 % interval over seeds",
        "![costs](figures/costs.png)",
        "",
        "## Executed plans",
        "For each task the seed whose score is the median of the first method.",
        *(f"![plans](figures/plans_{name}.png)" for name in study.tasks),
        "",
        *provenance(summary["runs"], f"Rows in `{ROWS_FILE}`, plans in `{PLANS_FOLDER}/`"),
    ]
    return "\n".join(lines) + "\n"


def _model_table(models: list[dict[str, Any]]) -> list[str]:
    return table(
        [
            "task",
            "key points",
            "particles",
            "model error (mm)",
            "threshold (mm)",
            "method",
            "score of the goal",
            "of the goal let go and settled",
        ],
        (
            [
                m["task"],
                len(m["key_points"]),
                m["key_points"],
                f"{1e3 * _error(m):.2f}",
                f"{1e3 * m['threshold']:.1f}",
                m["method"],
                *(_cell(m[name]) for name in ("goal_score", "goal_settled_score")),
            ]
            for m in models
        ),
    )


def _cell(score: float | None) -> str:
    return "unstable" if score is None else f"{score:.3f}"


def _error(model: dict[str, Any]) -> float:
    """Error of the chosen size, metres."""
    return model["errors"][model["sizes"].index(len(model["key_points"]))]


def _touching(study: PlanStudy) -> str:
    return "touches itself" if study.self_contact else "passes through itself"


def _run_table(rows: Rows, transfer: Rows) -> list[str]:
    """Scores and rates by task and method, in MuJoCo too if known."""
    lines = []
    for task in dict.fromkeys(row["task"] for row in rows):
        for method, runs in _methods(_of(rows, task=task)).items():
            scores = np.array([_score(run) for run in runs])
            successes = sum(run["success"] for run in runs)
            low, high = success_interval(successes, len(runs))
            lines.append(
                [
                    task,
                    method,
                    spread(scores),
                    f"{successes}/{len(runs)} ({low:.2f} to {high:.2f})",
                    _folded(runs),
                    runs[0]["counted_rollouts"],
                    sum(run["non_finite"] for run in runs),
                    f"{np.median([run['plan_seconds'] for run in runs]):.1f}",
                    f"{sum(run['compile_seconds'] for run in runs):.1f}",
                    *_transferred(_methods(_of(transfer, task=task)).get(method, []), transfer),
                ]
            )
    return table(
        [
            "task",
            "method",
            "score: median (range)",
            "success rate (95 %)",
            "same folds",
            "counted rollouts",
            "not finite",
            "seconds to plan",
            "compile seconds, all runs",
            *(["in MuJoCo, full: median (range)"] if transfer else []),
        ],
        lines,
    )


def _folded(runs: Rows) -> str:
    """How many ends unfold to the folds of the goal."""
    found = [run["same_folds"] for run in runs]
    return "–" if None in found else f"{sum(found)}/{len(found)}"


def _transferred(runs: Rows, transfer: Rows) -> list[str]:
    """The cell of scores in MuJoCo; empty if no plan has been replayed there."""
    if not transfer:
        return []
    if not runs:
        return ["not replayed"]
    scores = np.array([_score(run, "mujoco_full_score") for run in runs])
    return [spread(scores)]
