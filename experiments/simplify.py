"""Key points of goals in files: `python -m experiments.simplify GOAL`."""

import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from experiments import records
from jaxsimp.body import Body, from_mesh
from jaxsimp.goals import Positions, load_goal
from jaxsimp.meshes import load_mesh
from jaxsimp.simplify import METHODS, KeyPoints, Status, simplify_batch

NO_MODEL = 1
"""Exit status if some goal has no model within the tolerance."""
REFUSED = 2


@dataclass(frozen=True)
class Options:
    """Key points of goals: the particles that are worth grasping to reach them.

    A goal is an .npz file with `positions` (N x 3, metres, z up, the table at z = 0) and, as the
    body's definition, `rest` (N x 2 or N x 3) and `faces` (F x 3); without faces it is a rope.
    With --body it may also be a mesh file whose points are the body's, in the same order.
    Goals of one body are one batch.
    """

    goals: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="GOAL ...")]
    """Files of goals."""
    body: Path | None = None
    """Mesh file of the body at rest (OBJ, PLY, STL, OFF, GLB, ...), in metres."""
    method: str = "robust"
    """How: robust, paper (section III-A), or meshlab (the paper's own tool, an extra)."""
    tolerance: float | None = None
    """Error below which a model fits, metres; the method's own by default."""
    json: Path | None = None
    """File for the result: an object, or a list of them for several goals."""
    figure: Path | None = None
    """Picture of the goals with their models."""

    def check(self) -> None:
        """Refuse what cannot be done, before anything is run.

        Raises:
            ValueError: if there is no goal or no such method, or a path cannot be written to.
        """
        if not self.goals:
            raise ValueError("no goal is given; name at least one file")
        if self.method not in METHODS:
            raise ValueError(f"unknown method {self.method!r}; choose from {', '.join(METHODS)}")
        for name, path in (("--json", self.json), ("--figure", self.figure)):
            if path is not None and path.is_dir():
                raise ValueError(f"{path} is a folder; give a file with {name}")
            if path is not None and not path.parent.is_dir():
                raise ValueError(f"{path.parent} is no folder; make it, or give another {name}")


@dataclass(frozen=True)
class Model:
    """A goal and what it was simplified to.

    Attributes:
        path: of the goal's file.
        body: what the goal is for.
        goal: shape (N, 3), metres.
        key_points: the model.
        seconds: that it took, its share of a batch.
    """

    path: Path
    body: Body
    goal: Positions
    key_points: KeyPoints
    seconds: float


def main() -> int:
    """Run the command line; the exit status is 0, 1 if a goal has no model, 2 for wrong input."""
    options = tyro.cli(Options, prog="python -m experiments.simplify")
    console = Console(width=None if sys.stdout.isatty() else 160)  # a file has no width
    try:
        options.check()
        models = sorted(simplified(options), key=lambda model: options.goals.index(model.path))
    except ValueError as error:
        Console(stderr=True).print(f"error: {error}", style="red", markup=False, highlight=False)
        return REFUSED
    console.print(table(models))
    if options.json:
        rows = [row(model) for model in models]
        records.write_json(options.json, rows[0] if len(rows) == 1 else rows)
    if options.figure:
        save_figure(models, options.figure)
    return 0 if all(model.key_points.status == Status.FITS for model in models) else NO_MODEL


def simplified(options: Options) -> Iterator[Model]:
    """Models of all goals, a batch for each body.

    Raises:
        ValueError: if a file or an option is refused.
    """
    body = from_mesh(*load_mesh(options.body)) if options.body else None
    loaded = [(path, *load_goal(path, body)) for path in options.goals]
    # Files that define their bodies alike are goals of one body.
    loaded.sort(key=lambda each: _definition(each[1]))
    for _, group in groupby(loaded, key=lambda each: _definition(each[1])):
        paths, bodies, goals = zip(*group, strict=True)
        start = time.perf_counter()
        found = simplify_batch(
            bodies[0], np.stack(goals), method=options.method, tolerance=options.tolerance
        )
        seconds = (time.perf_counter() - start) / len(found)
        for path, goal, key_points in zip(paths, goals, found, strict=True):
            yield Model(path, bodies[0], goal, key_points, seconds)


def _definition(body: Body) -> tuple[int, bytes, bytes]:
    return body.num_particles, body.rest.tobytes(), body.faces.tobytes()


def row(model: Model) -> dict[str, Any]:
    """A model as JSON."""
    found = model.key_points
    errors = dict(zip(map(str, found.sizes), found.errors, strict=True))
    return {
        "goal": str(model.path),
        "status": found.status.name,
        "key_points": found.particles.tolist(),
        "num_key_points": len(found),
        "positions": found.positions.tolist(),
        "method": found.method,
        "tolerance": found.tolerance,
        "max_error": found.max_error,
        "rms_error": found.rms_error,
        "certified": found.certified,
        "errors": {size: error if np.isfinite(error) else None for size, error in errors.items()},
        "seconds": model.seconds,
        "num_particles": model.body.num_particles,
        "environment": records.environment(),
    }


def table(models: list[Model]) -> Table:
    """Models for people, a line each."""
    made = Table(title="key points", title_justify="left")
    for heading in ("goal", "status", "key points", "particles", "tolerance (mm)"):
        made.add_column(heading)
    for heading in ("largest error (mm)", "rms error (mm)", "certified", "seconds"):
        made.add_column(heading)
    for model in models:
        found = model.key_points
        made.add_row(
            str(model.path),
            found.status.name,
            str(len(found)),
            " ".join(map(str, found.particles)),
            f"{1e3 * found.tolerance:.3g}",
            f"{1e3 * found.max_error:.3g}",
            f"{1e3 * found.rms_error:.3g}",
            "yes" if found.certified else "no",
            f"{model.seconds:.3g}",
        )
    return made


def save_figure(models: list[Model], path: Path) -> None:
    """A picture of the goals with their models."""
    import matplotlib.pyplot as plt

    from jaxsimp.viz import plot_models

    stems = [model.path.stem for model in models]
    shown = {
        # The whole path where files of several folders have the same name.
        stem if stems.count(stem) == 1 else str(model.path): (
            model.body,
            model.goal,
            model.key_points,
        )
        for stem, model in zip(stems, models, strict=True)
        if len(model.key_points)
    }
    if not shown:
        return
    figure = plot_models(shown)
    figure.savefig(path, dpi=150)
    plt.close(figure)


if __name__ == "__main__":
    sys.exit(main())
