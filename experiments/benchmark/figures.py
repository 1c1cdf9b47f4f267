"""Plots of the benchmark's rows."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from experiments.benchmark.measure import Row
from jaxsimp.viz import COLORS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Rows = list[Row]


def save_figures(rows: Rows, folder: Path) -> None:
    """Write a PNG of each plot that has rows.

    Args:
        rows: rows of a run.
        folder: folder of the plots, created if missing.
    """
    import matplotlib.pyplot as plt

    folder.mkdir(parents=True, exist_ok=True)
    plots: dict[str, Callable[[Rows], Figure]] = {
        "engines": plot_engines,
        "population": plot_layouts,
        "scaling": plot_scaling,
    }
    for section, plot in plots.items():
        chosen = [row for row in rows if row["section"] == section and row["run_seconds"]]
        if chosen:
            figure = plot(chosen)
            figure.savefig(folder / f"{section}.png", dpi=150)
            plt.close(figure)


def plot_engines(rows: Rows) -> "Figure":
    """Speed of every engine, with its ratio to jaxsimp."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(6.4, 4.2), layout="constrained")
    rows = sorted(rows, key=_speed)
    names = [f"{row['engine'].replace('_', ' ')}\n{row['layout']}" for row in rows]
    ours = [COLORS[1] if row["engine"] == "jaxsimp" else COLORS[0] for row in rows]
    bars = axes.barh(names, [_speed(row) for row in rows], color=ours)
    ratios = [row["ratio_to_jaxsimp"] for row in rows]
    axes.bar_label(bars, [f" {ratio:.2g} ×" if ratio else "" for ratio in ratios])
    axes.set(xlabel="million particle-steps per second", title=_title(rows))
    axes.margins(x=0.12)
    return figure


def plot_layouts(rows: Rows) -> "Figure":
    """Speed by chunk size, one panel per body, one line per number of workers."""
    import matplotlib.pyplot as plt

    bodies = list(dict.fromkeys(row["body"] for row in rows))
    figure, panels = plt.subplots(
        1, len(bodies), figsize=(3.6 * len(bodies), 3.4), squeeze=False, layout="constrained"
    )
    for axes, body in zip(panels[0], bodies, strict=True):
        of_body = [row for row in rows if row["body"] == body]
        for color, workers in zip(COLORS, sorted({row["workers"] for row in rows}), strict=False):
            speeds = {r["chunk_size"]: _speed(r) for r in of_body if r["workers"] == workers}
            label = f"{workers} worker{'s' if workers > 1 else ''}"
            axes.plot(*zip(*sorted(speeds.items()), strict=True), "o-", color=color, label=label)
        axes.set_xscale("log", base=2)
        axes.set(xlabel="samples in a chunk", title=_title(of_body), ylim=(0, None))
    panels[0][0].set_ylabel("million particle-steps per second")
    panels[0][0].legend(frameon=False)
    return figure


def plot_scaling(rows: Rows) -> "Figure":
    """Time by work, one line per sweep, with its exponent."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(6.4, 4.2), layout="constrained")
    for color, name in zip(COLORS, dict.fromkeys(row["name"] for row in rows), strict=False):
        sweep = [row for row in rows if row["name"] == name]
        exponent = sweep[0]["exponent"]
        label = name.removeprefix("scaling_") + (f": exponent {exponent:.2f}" if exponent else "")
        work, seconds = ([row[key] for row in sweep] for key in ("particle_steps", "run_seconds"))
        axes.loglog(work, seconds, "o-", color=color, label=label)
    axes.set(xlabel="particles × steps × rollouts", ylabel="seconds")
    axes.legend(frameon=False, title="swept")
    return figure


def _speed(row: Row) -> float:
    return row["particle_steps_per_second"] / 1e6


def _title(rows: Rows) -> str:
    kind, side = rows[0]["body"].split("_")
    size = f"{side} particles" if kind == "rope" else f"{side} × {side}"
    return f"{kind}, {size}, {rows[0]['population']} rollouts"
