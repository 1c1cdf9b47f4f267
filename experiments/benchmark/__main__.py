"""Measure: `python -m experiments.benchmark`; with `--help`, all options."""

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console
from rich.table import Table

from experiments.benchmark import contact, planning, rollouts
from experiments.benchmark.measure import FULL, QUICK, Row, Scale
from jaxsimp import records
from jaxsimp.cli.progress import progress_bar
from jaxsimp.cli.status import exit_status

SECTIONS: dict[str, Callable[[Scale], Iterator[Row]]] = {
    "step": rollouts.step,
    "rollout": rollouts.rollout,
    "population": rollouts.population,
    "storage": rollouts.storage,
    "engines": rollouts.engines,
    "gradient": rollouts.gradient,
    "cem": planning.cem,
    "line_fit": planning.line_fit,
    "cold_start": planning.cold_start,
    "scaling": rollouts.scaling,
    "self_contact": contact.self_contact,
    "crumpling": contact.crumpling,
    "contact_population": contact.contact_population,
    "contact_gradient": contact.contact_gradient,
}


@dataclass(frozen=True)
class Options:
    """Speed of jaxsimp on this machine, beside other implementations of the same computation.

    Compare figures only within one run: the measurements take turns, under the current load.
    """

    quick: bool = False
    """Smaller sizes and fewer repeats: every section in about a minute."""
    only: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Section to run instead of all; repeat the option for more."""
    json: Path | None = None
    """File for the rows."""
    figures: Path | None = None
    """Folder for plots."""

    def check(self) -> None:
        """Check the options before any run.

        Raises:
            ValueError: if there is no such section, or a path cannot be written to.
        """
        unknown = [name for name in self.only if name not in SECTIONS]
        if unknown:
            raise ValueError(f"unknown section {unknown[0]!r}; choose from {', '.join(SECTIONS)}")
        if self.json is not None and self.json.is_dir():
            raise ValueError(f"{self.json} is a folder; give a file with --json")
        if self.json is not None and not self.json.parent.is_dir():
            raise ValueError(f"{self.json.parent} is no folder; make it, or give another --json")
        if self.figures is not None and self.figures.exists() and not self.figures.is_dir():
            raise ValueError(f"{self.figures} is a file; give a folder with --figures")


def main() -> int:
    """Run the command line; the exit status is 0, 2 for a wrong request, 130 for Ctrl-C."""
    options = tyro.cli(Options, prog="python -m experiments.benchmark")
    return exit_status(partial(_run, options), "interrupted; sections that are finished are kept")


def _run(options: Options) -> int:
    options.check()
    console = Console(width=None if sys.stdout.isatty() else 160)  # a file has no width
    run(options, QUICK if options.quick else FULL, console)
    return 0


def run(options: Options, scale: Scale, console: Console) -> list[Row]:
    """Measure the chosen sections, print a table of each, and write the chosen files."""
    names = [name for name in SECTIONS if name in options.only or not options.only]
    environment = records.environment()
    rows: list[Row] = []
    with progress_bar(console, remaining=False) as progress:
        bar = progress.add_task("", total=len(names))
        for name in names:
            progress.update(bar, description=name)
            found = [_placed(row, name, environment["device"]) for row in SECTIONS[name](scale)]
            progress.advance(bar)
            console.print(table(name, found))
            rows.extend(found)
            if options.json:
                records.write_json(options.json, {"environment": environment, "rows": rows})
    if options.figures:
        # Imported here, so that --help and wrong options do not wait for matplotlib.
        from experiments.benchmark.figures import save_figures

        save_figures(rows, options.figures)
    return rows


def _placed(row: Row, section: str, device: str) -> Row:
    """The row with its section and device."""
    return row | {"section": section, "device": "cpu" if row["engine"] in ON_HOST else device}


ON_HOST = ("c", "numpy", "taichi", "warp", "qpsolvers", "proxsuite")
"""Engines that run on the CPU, whatever device JAX has."""
UNITS = {
    "compile_seconds": "compile (s)",
    "run_seconds": "run (ms)",
    "particle_steps_per_second": "particle-steps (M/s)",
    "peak_megabytes": "peak (MB)",
    "error": "error (m)",
}
FACTORS = {"run_seconds": 1e3, "particle_steps_per_second": 1e-6}
HIDDEN = ("section", "chunk_size", "workers", "particle_steps", "checked_against")


def table(title: str, rows: list[Row]) -> Table:
    """Table of the rows, with the columns in which some row has a value."""
    shown = dict.fromkeys(name for row in rows for name in row if name not in HIDDEN)
    names = [name for name in shown if any(row.get(name) is not None for row in rows)]
    made = Table(title=title, title_justify="left")
    for name in names:
        number = any(isinstance(row.get(name), (int, float)) for row in rows)
        heading = UNITS.get(name, name.replace("_", " "))
        made.add_column(heading, justify="right" if number else "left")
    for row in rows:
        made.add_row(*(_cell(name, row.get(name)) for name in names))
    return made


def _cell(name: str, value: Any) -> str:
    if not isinstance(value, float):
        return "" if value is None else str(value)
    if name == "error":
        return f"{value:.1e}"
    return f"{value * FACTORS.get(name, 1):.3g}"


if __name__ == "__main__":
    sys.exit(main())
