"""Parts of reports: tables, intervals, figures, provenance."""

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

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
    """Write a figure as PNG, and close it."""
    import matplotlib.pyplot as plt

    figure.savefig(path, dpi=150)
    plt.close(figure)


def provenance(environment: dict[str, Any], files: str) -> list[str]:
    """Lines on the software and machine behind the results of a study, and on its files."""
    versions = ", ".join(f"{name} {version}" for name, version in environment["versions"].items())
    return [
        "## Provenance",
        f"Commit `{environment['commit']}`; Python {environment['python']}; {versions}; "
        f"{environment['processor']}, {environment['cores']} cores; {environment['platform']}. "
        f"{files}, settings in `config.json`.",
    ]
