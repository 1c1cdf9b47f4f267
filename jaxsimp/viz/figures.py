"""Pictures of bodies, models, searches and executed plans. Each call imports matplotlib."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from jaxsimp.bodies import Body
from jaxsimp.bodies.topology import boundary_edges
from jaxsimp.checks import require_reals
from jaxsimp.dynamics import Obstacle, Table
from jaxsimp.simplification import FitStatus, KeyPoints
from jaxsimp.viz.shapes import project, surface_grid

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d import Axes3D

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")
"""Colours distinct for colour-blind readers (Okabe and Ito)."""
GOAL_COLOR, OBSTACLE_COLOR = "#999999", "#e6c27a"
Positions = Float[np.ndarray, "N 3"]


def plot_model_errors(models: Mapping[str, KeyPoints]) -> "Figure":
    """Error of the simplified model by number of key points (Fig. 2 of the paper).

    Args:
        models: key points by the name of the task.
    """
    figure, panels = _panels(models)
    for axes, (name, model) in zip(panels, models.items(), strict=True):
        _draw_errors(axes, model)
        axes.set_title(_title(name))
    return figure


def plot_models(models: Mapping[str, tuple[Body, Positions, KeyPoints]]) -> "Figure":
    """Simplified models over their goals (Fig. 3 of the paper).

    Args:
        models: body, goal and key points by the name of the task.
    """
    figure, panels = _panels(models, three_d=True)
    for axes, (name, (body, goal, model)) in zip(panels, models.items(), strict=True):
        _draw_model(axes, body, goal, model)
        axes.set_title(f"{_title(name)}: {len(model)} key points")
    return figure


def plot_simplifications(models: Mapping[str, tuple[Body, Positions, KeyPoints]]) -> "Figure":
    """Simplified models over their goals, with their errors by size, one row per goal.

    Args:
        models: body, goal and key points by the name of the goal.
    """
    import matplotlib.pyplot as plt

    _require_some(models)
    figure = plt.figure(figsize=(9.2, 3.3 * len(models)), layout="constrained")
    for row, (name, (body, goal, model)) in enumerate(models.items()):
        shown = figure.add_subplot(len(models), 2, 2 * row + 1, projection="3d")
        _draw_model(shown, body, goal, model)
        shown.set_title(_title(name))
        _draw_errors(figure.add_subplot(len(models), 2, 2 * row + 2), model)
    return figure


def plot_costs(
    costs: Mapping[str, Mapping[str, Float[np.ndarray, "R I"]]],
    ylabel: str = "cost of best plan",
    *,
    rollouts: Mapping[str, Mapping[str, Float[np.ndarray, " I"]]] | None = None,
) -> "Figure":
    """Cost by iteration, mean with a 95 % confidence interval over runs (Fig. 4 of the paper).

    Args:
        costs: costs by task, then method, shape (R, I): one row per run, one column per iteration.
        ylabel: label of the cost axis.
        rollouts: rollouts up to each iteration, by task, then method, shape (I,), which then are
            the horizontal axis.
    """
    costs = _arrays("costs", costs, ("R", "I"), "a row of costs by iteration for each run")
    figure, panels = _panels(costs)
    for axes, (name, methods) in zip(panels, costs.items(), strict=True):
        for index, (method, runs) in enumerate(methods.items()):
            iteration = np.arange(1, runs.shape[1] + 1)
            if rollouts is not None:
                iteration = rollouts[name][method]
            mean, half = mean_interval(runs)
            color, line = COLORS[index % len(COLORS)], ("-", "--")[index % 2]
            axes.plot(iteration, mean, color=color, ls=line, label=method)
            axes.fill_between(iteration, mean - half, mean + half, color=color, alpha=0.15, lw=0)
        label = "iteration" if rollouts is None else "rollouts (counted)"
        axes.set(title=_title(name), xlabel=label, ylabel=ylabel)
        axes.locator_params(axis="x", integer=True)
        means = np.concatenate([runs.mean(axis=0) for runs in methods.values()])
        axes.set_ylim(0, 1.15 * means[np.isfinite(means)].max(initial=1e-9))
        axes.margins(x=0.02)
    panels[0].legend(frameon=False, fontsize="small")
    return figure


def plot_scores(
    scores: Mapping[str, Mapping[str, Float[np.ndarray, "R 2"]]],
    xlabel: str,
    ylabel: str,
    success: float,
) -> "Figure":
    """Scores of the same plans in two engines, one panel per task.

    Args:
        scores: scores by task, then method, shape (R, 2): the two scores of one plan per row; plans
            with a score that is not finite are omitted.
        xlabel: label of the first score.
        ylabel: label of the second score.
        success: least score of a success, drawn as a dashed line.
    """
    scores = _arrays("scores", scores, ("R", 2), "the two scores of a plan in each row")
    figure, panels = _panels(scores)
    for axes, (name, methods) in zip(panels, scores.items(), strict=True):
        shown = np.concatenate([np.array([[success, success]]), *methods.values()])
        low = min(0.0, float(shown[np.isfinite(shown)].min(initial=0.0))) - 0.05
        axes.plot([low, 1.05], [low, 1.05], color=GOAL_COLOR, lw=0.8)
        axes.axhline(success, color=GOAL_COLOR, ls="--", lw=0.8)
        for index, (method, pairs) in enumerate(methods.items()):
            color, marker = COLORS[index % len(COLORS)], "os^D"[index % 4]
            axes.plot(*pairs.T, marker, color=color, ms=5, alpha=0.7, mew=0, label=method)
        axes.set(xlim=(low, 1.05), ylim=(low, 1.05), xlabel=xlabel, ylabel=ylabel)
        axes.set_title(_title(name))
    panels[0].legend(frameon=False, fontsize="small", loc="upper left")
    return figure


def mean_interval(
    runs: Float[np.ndarray, "R I"],
) -> tuple[Float[np.ndarray, " I"], Float[np.ndarray, " I"]]:
    """Mean over runs and half the width of its 95 % confidence interval (Student's t)."""
    from scipy import stats

    mean, count = runs.mean(axis=0), len(runs)
    if count < 2:
        return mean, np.full_like(mean, np.nan)
    return mean, stats.t.ppf(0.975, count - 1) * runs.std(axis=0, ddof=1) / np.sqrt(count)


def plot_executions(
    body: Body,
    goal: Positions,
    executions: Mapping[str, tuple[Float[np.ndarray, "P N 3"], float]],
    title: str,
    obstacles: Sequence[Obstacle] = (),
) -> "Figure":
    """Snapshots of executed plans beside their goal, one row per plan (Fig. 5 of the paper).

    Args:
        body: the body that the plans move.
        goal: goal positions, shape (N, 3), metres.
        executions: by method, positions at the start, after each action, and settled, shape
            (P, N, 3), metres; and the score.
        title: title of the figure.
        obstacles: obstacles of the task, see `draw_obstacle`.
    """
    import matplotlib.pyplot as plt

    _require_some(executions)
    wanted, why = (
        ("P", *body.rest.shape),
        "positions of the body at the start and after each action",
    )
    goal = require_reals("the goal", goal, wanted[1:], "one row of x, y, z for each particle")
    executions = {
        method: (require_reals(f"the positions of {method}", frames, wanted, why), score)
        for method, (frames, score) in executions.items()
    }
    for method, (moved, _) in executions.items():
        if len(moved) < 2:
            raise ValueError(
                f"the positions of {method} are {len(moved)} rows; give at least 2, at the start "
                f"and settled"
            )
    columns = max(len(positions) for positions, _ in executions.values()) + 1
    figure, grid = plt.subplots(
        len(executions),
        columns,
        figsize=(2.2 * columns, 2.3 * len(executions) + 0.4),
        squeeze=False,
        subplot_kw={"projection": "3d"},
        layout="constrained",
    )
    every = [goal, *(frame for positions, _ in executions.values() for frame in positions)]
    for row, (method, (positions, value)) in zip(grid, executions.items(), strict=True):
        frames = [*positions, goal]
        names = [
            "start",
            *(f"action {i}" for i in range(1, len(positions) - 1)),
            f"settled, score {value:.2f}",
            "goal",
        ]
        for unused in row[len(frames) :]:  # of a plan with fewer actions than another
            unused.remove()
        for axes, frame, name in zip(row[: len(frames)], frames, names, strict=True):
            draw_body(axes, body, frame, GOAL_COLOR if name == "goal" else COLORS[0])
            _frame(axes, every)
            for obstacle in obstacles:
                draw_obstacle(axes, obstacle)
            axes.set_title(name, fontsize="small")
        row[0].text2D(
            0.0, 1.12, method, transform=row[0].transAxes, weight="bold", fontsize="small"
        )
    figure.suptitle(_title(title))
    return figure


def draw_body(axes: "Axes3D", body: Body, positions: Positions, color: str) -> None:
    """Draw a rope as a line, a surface as shaded triangles with its boundary, into 3-D axes.

    Draws nothing if a position is not finite, as after a failed motion.

    Args:
        axes: axes with a 3-D projection.
        body: the body to draw.
        positions: shape (N, 3), metres.
        color: colour of the body.
    """
    if not np.isfinite(positions).all():
        return
    if len(body.faces):
        axes.plot_trisurf(
            *positions.T,
            triangles=body.faces,
            color=color,
            alpha=0.55,
            edgecolor="none",
            antialiased=False,
            shade=True,
        )
        from mpl_toolkits.mplot3d.art3d import Line3DCollection

        outline = positions[boundary_edges(body.faces)[0]]
        if len(outline):  # a closed surface has none
            axes.add_collection3d(Line3DCollection(outline, colors="black", linewidths=0.6))
    else:
        axes.plot(*positions.T, color=color, lw=3, solid_capstyle="round")
        axes.scatter(*positions[[0, -1]].T, color=color, s=25, depthshade=False)


def draw_obstacle(axes: "Axes3D", obstacle: Obstacle, color: str = OBSTACLE_COLOR) -> None:
    """Draw the shaded surface of an obstacle into 3-D axes, within their limits.

    Not of the table, which is the bottom of the picture.

    Args:
        axes: axes with a 3-D projection and limits.
        obstacle: the obstacle to draw.
        color: colour of the surface.
    """
    if isinstance(obstacle, Table):
        return
    limits = np.array([axes.get_xlim(), axes.get_ylim(), axes.get_zlim()])
    low, high = limits.T[:, :, None, None]
    x, y, z = np.clip(_surface(obstacle, limits), low, high)
    axes.plot_surface(x, y, z, color=color, alpha=0.5, lw=0, rstride=1, cstride=1, shade=True)


def _surface(
    obstacle: Obstacle, limits: Float[np.ndarray, "3 2"]
) -> Float[np.ndarray, "3 rows columns"]:
    """A grid of points on the surface of an obstacle: the nearest to points all around.

    For the surface of a half-space, to points across the limits of the axes.
    """
    if np.isinf(obstacle.size()[1]):
        x, y = np.meshgrid(*(np.linspace(low, high, 9) for low, high in limits[:2]))
        return project(obstacle, np.stack([x, y, np.full_like(x, limits[2].mean())]))[0]
    return surface_grid(obstacle, 49, 25)[0]


def _draw_model(axes: "Axes3D", body: Body, goal: Positions, model: KeyPoints) -> None:
    """A model over its goal, into 3-D axes."""
    goal = require_reals("the goal", goal, body.rest.shape, "one row of x, y, z for each particle")
    axes.computed_zorder = False  # key points lie in the goal: depth order would hide some
    draw_body(axes, body, goal, GOAL_COLOR)
    closed = model.elements[:, [*range(model.elements.shape[1]), 0]]
    for element in closed if model.elements.shape[1] > 2 else model.elements:
        axes.plot(*model.positions[element].T, color=COLORS[0], lw=1.5, zorder=5)
    axes.scatter(*model.positions.T, color=COLORS[1], s=60, marker="*", zorder=6, depthshade=False)
    _frame(axes, [goal], zoom=0.95)


def _draw_errors(axes: "Axes", model: KeyPoints) -> None:
    """A model's error by number of key points, with the tolerance and the number chosen."""
    if not model.sizes:
        axes.set_axis_off()
        axes.text(0.5, 0.5, "infeasible: no model is within the workspace", ha="center")
        return
    chosen = "chosen" if model.status == FitStatus.FITS else "none fits, last tried"
    axes.plot(model.sizes, np.array(model.errors) * 1e3, "o-", color=COLORS[0])
    axes.axhline(model.tolerance * 1e3, color=GOAL_COLOR, ls="--", label="tolerance")
    axes.plot(
        len(model),
        model.error * 1e3,
        "o",
        ms=11,
        mfc="none",
        mec=COLORS[1],
        mew=2,
        label=f"{chosen}: {len(model)} key points",
    )
    axes.set(xlabel="key points", ylabel="model error (mm)")
    axes.set_xticks(np.arange(model.sizes[0], model.sizes[-1] + 1))
    axes.set_xlim(model.sizes[0] - 0.5, model.sizes[-1] + 0.5)
    shown = np.array([*model.errors, model.tolerance])
    axes.set_ylim(bottom=-0.05 * 1e3 * shown[np.isfinite(shown)].max())
    axes.legend(frameon=False)


def _frame(axes: "Axes3D", shown: Sequence[Positions], zoom: float = 1.1) -> None:
    """Set equal scales around all positions, a view from above at an angle, and no axes."""
    points = np.concatenate(shown)
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        points = np.zeros((1, 3))  # of failed motions, of which nothing is drawn
    low, high = points.min(axis=0), points.max(axis=0)
    low[2], high[2] = min(low[2], 0.0), max(high[2], 1e-3)
    span = np.maximum(high - low, 0.05 * np.ptp(points) or 1.0)
    middle = (low + high) / 2
    axes.set(
        xlim=(middle[0] - span[0] / 2, middle[0] + span[0] / 2),
        ylim=(middle[1] - span[1] / 2, middle[1] + span[1] / 2),
        zlim=(low[2], low[2] + span[2]),
    )
    # Matplotlib scales the box by its diagonal; the zoom of a square would cut off a long one.
    slender = np.linalg.norm(span) / (np.sqrt(2) * span.max())
    axes.set_box_aspect(span, zoom=zoom * min(1.0, slender))
    axes.view_init(elev=50, azim=-65)
    axes.set_axis_off()


def _panels(items: Mapping[str, object], *, three_d: bool = False) -> tuple["Figure", list[Any]]:
    """A figure with one panel per item, two per row."""
    import matplotlib.pyplot as plt

    _require_some(items)
    columns = min(2, len(items))
    rows = -(-len(items) // columns)
    figure, grid = plt.subplots(
        rows,
        columns,
        figsize=(4.6 * columns, 3.3 * rows),
        squeeze=False,
        layout="constrained",
        subplot_kw={"projection": "3d"} if three_d else {},
    )
    panels = list(grid.ravel())
    for unused in panels[len(items) :]:
        unused.remove()
    return figure, panels[: len(items)]


def _arrays(
    what: str, groups: Mapping[str, Mapping[str, Any]], shape: tuple[int | str, ...], why: str
) -> dict[str, dict[str, np.ndarray]]:
    """Numbers by task and method, as arrays of a shape."""
    return {
        task: {
            method: require_reals(f"{what} of {task}, {method}", values, shape, why)
            for method, values in methods.items()
        }
        for task, methods in groups.items()
    }


def _require_some(items: Mapping[str, object]) -> None:
    """Raise a `ValueError` if there is nothing to draw."""
    if not items:
        raise ValueError("there is nothing to draw; give at least one entry, by its name")


def _title(name: str) -> str:
    return name.replace("_", " ").replace("$", r"\$")  # no formulas
