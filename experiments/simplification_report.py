"""Output of the study of simplification: summary.json, figures, and a report."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from experiments.simplification import ROWS_FILE, Case, SimplificationStudy
from jaxsimp import records, viz
from jaxsimp.records.markdown import provenance, save_figure, success_interval, table
from jaxsimp.simplification import KeyPoints, simplify_batch

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Rows = list[dict[str, Any]]
KINDS = {
    "rope": "ropes, 1 m",
    "cloth": "cloths, 0.3 m",
    "settled": "cloths settled in a simulation",
}
SHOWN = ("M, unequal", "triangle 3 4 5", "letter", "quarter", "four corners", "through a corner")
"""Goals in the figures of models, each with noise."""


def write_report(study: SimplificationStudy, summary: dict[str, Any], folder: Path) -> None:
    """Write `summary.json`, the figures and `report.md`."""
    records.write_json(folder / "summary.json", summary)
    figures = folder / "figures"
    figures.mkdir(exist_ok=True)
    rows = summary["goals"]
    save_figure(plot_rates(rows), figures / "rates.png")
    save_figure(plot_goals(rows), figures / "goals.png")
    for method in study.methods:
        shown = _shown(study, method)
        models = {name: (each.body, each.goal, found) for name, (each, found) in shown.items()}
        save_figure(viz.plot_models(models), figures / f"models_{method}.png")
    errors = {name: found for name, (_, found) in _shown(study, study.methods[0]).items()}
    save_figure(viz.plot_model_errors(errors), figures / "errors.png")
    records.write_text(folder / "report.md", _report(study, summary))


def _shown(study: SimplificationStudy, method: str) -> dict[str, tuple[Any, KeyPoints]]:
    """Noisy goals of one seed, and a method's models of them."""
    shown = {}
    for case in _typical_cases(study):
        ideal = case.make()
        (found,) = simplify_batch(ideal.body, ideal.goal[None], method=method)
        shown[f"{case.name}, {1e3 * case.level:.1f} mm {case.noise}"] = ideal, found
    return shown


def _typical_cases(study: SimplificationStudy) -> list[Case]:
    """One case for each goal in the figures: the last seed of the smallest size."""
    cases = {case.name: case for case in reversed(list(study.cases())) if case.kind != "settled"}
    smallest = {study.rope_sizes[0], study.cloth_sizes[0]}
    for case in study.cases():
        if case.kind != "settled" and case.size in smallest:
            cases[case.name] = case
    return [cases[name] for name in SHOWN]


def plot_rates(rows: Rows) -> "Figure":
    """Rate of right key points by level of noise, one panel per kind of goal."""
    import matplotlib.pyplot as plt

    kinds = [kind for kind in KINDS if _of(rows, kind=kind)]
    figure, panels = plt.subplots(
        1, len(kinds), figsize=(3.7 * len(kinds), 3.4), sharey=True, squeeze=False,
        layout="constrained",
    )  # fmt: skip
    for axes, kind in zip(panels[0], kinds, strict=True):
        by = "name" if kind == "settled" else "level"
        _draw_rates(axes, _of(rows, kind=kind), by)
        axes.set(title=KINDS[kind], ylim=(-0.03, 1.03))
        axes.set_xlabel("fold" if kind == "settled" else "noise (mm)")
    panels[0][0].set_ylabel("rate of right key points")
    handles, labels = panels[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, frameon=False, loc="outside upper center", ncols=len(labels))
    return figure


def _draw_rates(axes: "Axes", rows: Rows, by: str) -> None:
    values = list(dict.fromkeys(sorted(row[by] for row in rows)))
    methods = list(dict.fromkeys(row["method"] for row in rows))
    for index, method in enumerate(methods):
        chosen = [_of(rows, method=method, **{by: value}) for value in values]
        rate = np.array([_rate(each)[0] for each in chosen])
        low, high = np.array([_rate(each)[1] for each in chosen]).T
        x = np.arange(len(values)) + 0.12 * (index - (len(methods) - 1) / 2)
        bars = [np.maximum(rate - low, 0), np.maximum(high - rate, 0)]
        style = "o" if by == "name" else "o-"
        axes.errorbar(x, rate, yerr=bars, fmt=style, color=viz.COLORS[index], label=method, lw=1)
    labels = [value if by == "name" else f"{1e3 * value:g}" for value in values]
    axes.set_xticks(np.arange(len(values)), labels, fontsize="small", rotation=30 * (by == "name"))


def plot_goals(rows: Rows) -> "Figure":
    """Rate of right key points of each goal, one row per method."""
    import matplotlib.pyplot as plt

    names = list(dict.fromkeys(row["name"] for row in rows if row["kind"] != "settled"))
    methods = list(dict.fromkeys(row["method"] for row in rows))
    ideal = [row for row in rows if row["kind"] != "settled"]
    rates = [[_rate(_of(ideal, name=name, method=m))[0] for name in names] for m in methods]
    figure, axes = plt.subplots(figsize=(0.5 * len(names) + 2, 0.5 * len(methods) + 2.2),
                                layout="constrained")  # fmt: skip
    axes.imshow(rates, cmap="cividis", vmin=0, vmax=1, aspect="auto")
    for row, of_method in enumerate(rates):
        for column, rate in enumerate(of_method):
            color = "black" if rate > 0.5 else "white"
            axes.text(column, row, f"{100 * rate:.0f}", ha="center", va="center", color=color)
    axes.set_xticks(range(len(names)), names, rotation=40, ha="right")
    axes.set_yticks(range(len(methods)), methods)
    axes.set_title("right key points, % of noisy goals")
    return figure


def _of(rows: Rows, **fields: Any) -> Rows:
    return [row for row in rows if all(row[name] == value for name, value in fields.items())]


def _rate(rows: Rows) -> tuple[float, tuple[float, float]]:
    """Rate of right key points, and its interval."""
    right = sum(row["right"] for row in rows)
    return right / len(rows), success_interval(right, len(rows))


def _report(study: SimplificationStudy, summary: dict[str, Any]) -> str:
    rows = summary["goals"]
    certified = _of(rows, kind="rope", method="robust")
    lines = [
        "# Right key points of noisy goals",
        "",
        "A goal is right when its key points are as many as the true ones and each is within one "
        "and a half spacings of its own. Intervals are 95 % (Wilson).",
        "",
        *_rate_table(rows, "kind", lambda row: KINDS[row["kind"]]),
        "",
        *_rate_table(rows, "particles", lambda row: f"{row['kind']} {row['size']}"),
        "",
        *_rate_table(rows, "noise", lambda row: row["noise"]),
        "",
        f"Ropes: {sum(row['certified'] for row in certified)} of {len(certified)} models of the "
        "method robust are proven to be the smallest.",
        "",
        "![rates by level of noise](figures/rates.png)",
        "",
        "![rates by goal](figures/goals.png)",
        "",
        "## Models of noisy goals",
        *(
            line
            for method in study.methods
            for line in (f"{method}:", "", f"![{method}](figures/models_{method}.png)", "")
        ),
        f"## Error by number of key points, method {study.methods[0]}",
        "![errors](figures/errors.png)",
        "",
        *provenance(rows, f"Rows in `{ROWS_FILE}`"),
    ]
    return "\n".join(lines) + "\n"


def _rate_table(rows: Rows, heading: str, key: Callable[[dict[str, Any]], str]) -> list[str]:
    """One line per group of goals, one column per method."""
    methods = list(dict.fromkeys(row["method"] for row in rows))
    groups: dict[str, Rows] = {}
    for row in rows:
        groups.setdefault(key(row), []).append(row)

    def cells(group: str) -> Iterable[str]:
        yield group
        for method in methods:
            of_method = _of(groups[group], method=method)
            rate, (low, high) = _rate(of_method)
            right = sum(row["right"] for row in of_method)
            yield f"{right}/{len(of_method)} = {rate:.3f} ({low:.3f} to {high:.3f})"

    return table([heading, *methods], map(cells, groups))
