"""Output of the study of transfer: summary.json, figures, and a report."""

from pathlib import Path
from typing import Any

import numpy as np

from experiments.plans import PLANS_FOLDER
from experiments.transfer import REPLAYS_FOLDER, ROWS_FILE, SCRIPTED, TransferStudy, replay_path
from jaxsimp import records, viz
from jaxsimp.engines.mujoco import VARIANTS
from jaxsimp.records.markdown import provenance, save_figure, spread, success_interval, table

Rows = list[dict[str, Any]]
ENGINES = {
    "ours": "final_score",
    "MuJoCo fast": "mujoco_fast_score",
    "MuJoCo full": "mujoco_full_score",
}
"""The column of scores of each engine."""
LABELS = {"key_points": "key points", "all_particles": "all particles", SCRIPTED: "made by hand"}


def write_report(study: TransferStudy, summary: dict[str, Any], folder: Path) -> None:
    """Write `summary.json`, the figures and `report.md`."""
    records.write_json(folder / "summary.json", summary)
    figures = folder / "figures"
    figures.mkdir(exist_ok=True)
    rows = [*summary["transfer"], *summary["scripted"]]
    points = {task: _points(_of(rows, task=task)) for task in study.plans.tasks}
    figure = viz.plot_scores(points, "score in ours", "score in MuJoCo full", study.success_score)
    save_figure(figure, figures / "transfer.png")
    pictures = [
        _picture(study, folder, row, f"{name}_{task}")
        for task in study.plans.tasks
        for name, row in _shown(_of(rows, task=task)).items()
    ]
    records.write_text(folder / "report.md", _report(study, summary, pictures))


def _of(rows: Rows, **fields: Any) -> Rows:
    return [row for row in rows if all(row[name] == value for name, value in fields.items())]


def _points(rows: Rows) -> dict[str, np.ndarray]:
    """Scores in ours and in MuJoCo's full variant, one row per plan, by action space."""
    return {
        LABELS[space]: np.array(
            [
                [row["final_score"], row["mujoco_full_score"]]
                for row in _of(rows, action_space=space)
            ],
            dtype=float,
        )
        for space in dict.fromkeys(row["action_space"] for row in rows)
    }


def _shown(rows: Rows) -> dict[str, dict[str, Any]]:
    """Plans for pictures: the median score in the full variant, the worst, and a hand-made one."""
    found = [row for row in rows if row["action_space"] != SCRIPTED]
    ranked = sorted(found, key=lambda row: _score(row, "mujoco_full_score"))
    shown = {"median": ranked[len(ranked) // 2], "worst": ranked[0]} if ranked else {}
    scripted = _of(rows, action_space=SCRIPTED)
    return shown | ({"by_hand": scripted[0]} if scripted else {})


def _picture(study: TransferStudy, folder: Path, row: dict[str, Any], name: str) -> str:
    """Draw a plan in all engines, one row per engine, and return the file's name."""
    task = study.plans.task(row["task"])
    source = (
        folder if study.source is None or row["action_space"] == SCRIPTED else Path(study.source)
    )
    paths = [source / row["plan"], *(replay_path(folder, row, variant) for variant in VARIANTS)]
    motions = {
        engine: (records.load_plan(path).positions, _score(row, column))
        for (engine, column), path in zip(ENGINES.items(), paths, strict=True)
    }
    goal = np.asarray(task.episode_fn(row["seed"]).goal)
    title = f"{row['task']}, {LABELS[row['action_space']]}, seed {row['seed']}"
    file = f"{name}.png"
    save_figure(
        viz.plot_executions(task.body, goal, motions, title, task.obstacles),
        folder / "figures" / file,
    )
    return file


def _score(row: dict[str, Any], column: str) -> float:
    return -np.inf if row[column] is None else row[column]


def _report(study: TransferStudy, summary: dict[str, Any], pictures: list[str]) -> str:
    lines = [
        "# Transfer: plans found in our dynamics, carried out in MuJoCo",
        "",
        f"A plan transfers when its settled score is at least {study.success_score}. Score 1 is a "
        f"cost of 0, which a goal need not have, and 0 is the start. {study.plans.seeds} seeds a "
        "row; intervals are 95 % (Wilson). Fast: hardly stretches, limp, layers pass through "
        "others. Full: elastic as our springs are, with self-collision and friction of layers.",
        "",
        "## Plans found by the search",
        *_table(summary["transfer"], study.success_score),
        "",
        "## Plans made by hand",
        *_table(summary["scripted"], study.success_score),
        "",
        "## Scores in ours and in MuJoCo",
        "![scores](figures/transfer.png)",
        "",
        "## Pictures",
        "For each task the plan of median score in the full variant, the worst, and one made by "
        "hand.",
        *(f"![{Path(file).stem}](figures/{file})" for file in pictures),
        "",
        *provenance(
            [*summary["transfer"], *summary["scripted"]],
            f"Rows in `{ROWS_FILE}`, plans in `{PLANS_FOLDER}/`, their motions in MuJoCo in "
            f"`{REPLAYS_FOLDER}/`",
        ),
    ]
    return "\n".join(lines) + "\n"


def _table(rows: Rows, success_score: float) -> list[str]:
    """Scores and transfer rates by task and action space."""
    names = ("task", "planner", "action_space", "planning")
    groups = dict.fromkeys(tuple(row[name] for name in names) for row in rows)
    header = ["task", "planner", "candidates", "planning"]
    header += [f"{engine}: median (range)" for engine in ENGINES]
    header += [f"{engine}: rate (95 %)" for engine in ENGINES]
    lines = []
    for group in groups:
        runs = _of(rows, **dict(zip(names, group, strict=True)))
        task, planner, space, planning = group
        scores = [np.array([_score(run, column) for run in runs]) for column in ENGINES.values()]
        warned = sum(bool(run["warnings"]) for run in runs)
        cells = [*map(spread, scores), *(_rate(each, success_score) for each in scores), warned]
        lines.append([task, planner, LABELS[space], planning, *cells])
    return table([*header, "warned"], lines)


def _rate(scores: np.ndarray, success_score: float) -> str:
    successes = int(np.sum(scores >= success_score))
    low, high = success_interval(successes, len(scores))
    return f"{successes}/{len(scores)} ({low:.2f} to {high:.2f})"
