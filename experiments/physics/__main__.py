"""Make the figures of docs/physics.md: `python -m experiments.physics`; with `--help`, options."""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from experiments.physics import (
    against_mujoco,
    obstacles,
    resolution,
    self_contact,
    swings,
    two_sheets,
)
from jaxsimp import records
from jaxsimp.cli.status import exit_status

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FIGURES: "dict[str, Callable[[bool], tuple[Figure, str]]]" = {
    "time_step": swings.plot_time_step,
    "resolution": resolution.plot_resolution,
    "energy": swings.plot_energy,
    "obstacles": obstacles.plot_obstacles,
    "mujoco": against_mujoco.plot_mujoco,
    "self_contact": self_contact.plot_self_contact,
    "two_sheets": two_sheets.plot_two_sheets,
}
"""Functions that draw a figure, by its name; each also returns a line with its numbers."""


@dataclass(frozen=True)
class Options:
    """Figures of the physics page: convergence, energy, obstacles, MuJoCo, contact, garments."""

    out: Path = Path("docs/figures")
    """Folder of the figures, created if missing."""
    quick: bool = False
    """Smaller bodies and shorter motions: for tests."""
    only: tuple[str, ...] = ()
    """Names of the figures to make; all by default."""

    def check(self) -> None:
        """Check the options before any run.

        Raises:
            ValueError: if there is no such figure, or the folder is a file.
        """
        unknown = [name for name in self.only if name not in FIGURES]
        if unknown:
            raise ValueError(f"unknown figure {unknown[0]!r}; choose from {', '.join(FIGURES)}")
        if self.out.exists() and not self.out.is_dir():
            raise ValueError(f"{self.out} is a file; give a folder with --out")


def main() -> int:
    """Run the command line; the exit status is 0, 2 for a wrong request, 130 for Ctrl-C."""
    options = tyro.cli(Options, prog="python -m experiments.physics", description=Options.__doc__)
    return exit_status(partial(_run, options))


def _run(options: Options) -> int:
    options.check()
    save_figures(options)
    return 0


def save_figures(options: Options) -> None:
    """Write the figures, and print their numbers."""
    import matplotlib.pyplot as plt

    options.out.mkdir(parents=True, exist_ok=True)
    for name in options.only or FIGURES:
        figure, numbers = FIGURES[name](options.quick)
        save_small(figure, options.out / f"physics_{name}.png")
        plt.close(figure)
        print(f"{name}: {numbers}", flush=True)


def save_small(figure: "Figure", path: Path) -> None:
    """Write a figure as PNG of at most 128 colors: a third of the size with all colors."""
    from PIL import Image

    with records.whole_file(path) as part:
        figure.savefig(part, dpi=110)
        with Image.open(part) as picture:
            few = picture.convert("RGB").quantize(128)
        few.save(part, optimize=True)


if __name__ == "__main__":
    sys.exit(main())
