"""Parts of reports: tables, intervals, figures, provenance."""

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxsimp.records.files import whole_file
from jaxsimp.records.rows import environments

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def table(header: Iterable[str], rows: Iterable[Iterable[object]]) -> list[str]:
    """Lines of a Markdown table."""
    header = list(header)
    return [
        "| " + " | ".join(map(str, cells)) + " |"
        for cells in [header, ["---"] * len(header), *rows]
    ]


def spread(scores: np.ndarray) -> str:
    """Median and range, in words."""
    return f"{np.median(scores):.3f} ({scores.min():.3f} to {scores.max():.3f})"


def success_interval(successes: int, count: int) -> tuple[float, float]:
    """Wilson's 95 % confidence interval of a success rate."""
    from scipy import stats

    found = stats.binomtest(successes, count).proportion_ci(method="wilson")
    return float(found.low), float(found.high)


def save_figure(figure: "Figure", path: Path) -> None:
    """Write a figure as PNG, whole or not at all, and close it."""
    import matplotlib.pyplot as plt

    with whole_file(path) as part:
        figure.savefig(part, dpi=150)
    plt.close(figure)


def provenance(rows: Iterable[dict[str, Any]], files: str) -> list[str]:
    """Lines on the software and machine behind the rows of a study, and on its files."""
    found = environments(rows)
    lines = ["## Provenance"]
    if len(found) == 1:
        ((environment, _),) = found
        lines.append(_environment(environment))
    else:
        lines += [
            f"**The rows are of {len(found)} environments (`--mixed`)**, and differ for that "
            f"reason, too:",
            "",
            *(f"- {number} rows: {_environment(environment)}" for environment, number in found),
            "",
        ]
    return [*lines, f"{files}, settings in `config.json`."]


def _environment(environment: dict[str, Any] | None) -> str:
    if environment is None:
        return "an unknown environment."
    versions = ", ".join(f"{name} {version}" for name, version in environment["versions"].items())
    settings = ", ".join(
        f"`{name}` {value}" for name, value in environment.get("settings", {}).items() if value
    )
    return (
        f"Commit `{environment['commit']}`; Python {environment['python']}; {versions}; "
        f"{environment['processor']}, {environment['cores']} cores, {environment['device']}; "
        f"{environment['platform']}; {settings}."
    )
