"""The report and the figures of `jaxsimp plan`."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import jaxsimp

if TYPE_CHECKING:
    import numpy as np

    from jaxsimp.goal_plan import GoalPlanner

    Executions = dict[str, tuple[np.ndarray, float]]

Row = dict[str, Any]
"""A row of the results, or the result, as JSON."""
ROWS_FILE, PLANS_FOLDER = "plans.jsonl", "plans"
FIGURE_FILE, MODEL_FILE, PAGE_FILE = "plan.png", "key_points.png", "plan.html"


def save_figures(planner: "GoalPlanner", executions: "Executions", folder: Path) -> None:
    """Write the pictures of the goal's model and of the executions."""
    from jaxsimp import viz
    from jaxsimp.records.markdown import save_figure

    task = planner.task
    model = viz.plot_simplifications({task.name: (task.body, task.goal, planner.key_points)})
    save_figure(model, folder / MODEL_FILE)
    plan = viz.plot_executions(task.body, task.goal, executions, task.name, task.obstacles)
    save_figure(plan, folder / FIGURE_FILE)


def report(planner: "GoalPlanner", saved: "jaxsimp.SavedPlan", result: Row, rows: list[Row]) -> str:
    """The report, in Markdown."""
    from jaxsimp.records.markdown import provenance, table

    task = planner.planner.task
    is_verified = "mujoco_full_score" in result
    in_mujoco = [["score in MuJoCo", _told(result["mujoco_full_score"])]] if is_verified else []
    summary = table(
        ["", ""],
        [
            ["score of the best plan", _told(result["score"])],
            *in_mujoco,
            ["plans, successful", f"{len(rows)}, {sum(row['success'] for row in rows)}"],
            ["key points", result["key_points"]],
            ["actions, pickers", f"{result['num_actions']}, {task.num_pickers}"],
            [
                "search (s), compilation (s)",
                f"{result['seconds']:.1f}, {result['compile_seconds']:.1f}",
            ],
            ["rollouts", result["rollouts"]],
            ["least distance between grippers", _distance(result["least_gripper_distance"])],
        ],
    )
    plans = table(
        ["seed", "score", "seconds", "rollouts"],
        [
            [row["seed"], _told(row["score"]), f"{row['seconds']:.1f}", row["rollouts"]]
            for row in rows
        ],
    )
    return "\n".join(
        [
            f"# Plan for {task.name}",
            "",
            *summary,
            "",
            "The score is `(c_0 - c) / c_0` of the settled state, with its cost `c` and that of "
            "the start, `c_0`: 1 at the goal.",
            "",
            f"Open [{PAGE_FILE}]({PAGE_FILE}) in a browser to see it move.",
            "",
            f"![Execution of the plan]({FIGURE_FILE})",
            "",
            f"![Key points of the goal]({MODEL_FILE})",
            "",
            "## Actions",
            *table(["action", "picker", "particle", "dx, dy, dz (mm)"], _actions(saved)),
            "",
            "## Plans",
            *plans,
            "",
            *provenance(rows, f"Plans in `{PLANS_FOLDER}`, rows in `{ROWS_FILE}`"),
            "",
        ]
    )


def _actions(saved: "jaxsimp.SavedPlan") -> list[list[object]]:
    """A line for each action of a picker that holds a particle."""
    import numpy as np

    pick, moves = np.asarray(saved.actions.pick), np.asarray(saved.actions.displacement)
    return [
        [
            action + 1,
            picker + 1,
            pick[action, picker],
            ", ".join(f"{1e3 * each:.0f}" for each in moves[action, picker]),
        ]
        for action, picker in np.argwhere(pick != jaxsimp.NONE)
    ]


def _distance(least: float | None) -> str:
    return "one holds at a time" if least is None else f"{1e3 * least:.0f} mm"


def _told(score: float | None) -> str:
    return "none (the simulation became unstable)" if score is None else f"{score:.3f}"


def told(result: Row) -> str:
    """The scores of a result, in words."""
    said = f"score {_told(result['score'])}"
    if "mujoco_full_score" in result:
        said += f", in MuJoCo {_told(result['mujoco_full_score'])}"
    return said
