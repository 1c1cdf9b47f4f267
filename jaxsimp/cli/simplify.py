"""Key points of goals in files: `python -m jaxsimp.cli.simplify GOAL`."""

import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from jaxsimp import records
from jaxsimp.bodies import Body
from jaxsimp.goals import Positions, load_goal
from jaxsimp.goals.files import load_body
from jaxsimp.simplification import METHODS, FitStatus, KeyPoints, simplify_batch

NO_MODEL = 1
"""Exit status if some goal has no model within the tolerance."""
REFUSED = 2
"""Exit status for wrong input."""
PICTURES = (".jpg", ".pdf", ".png", ".svg")
MOST_PICTURED = 40
"""Most goals in one picture: matplotlib draws up to 65,536 pixels, 500 of them a goal."""


@dataclass(frozen=True)
class Options:
    """Key points of goals: the particles that are worth grasping to reach them.

    A goal is an .npz file with `positions` (N x 3, metres, z up, the table at z = 0). It may
    define its body: by `rest` (N x 2 or N x 3) and `faces` (F x 3) a sheet, without faces a
    rope. Without rest coordinates a rope is straight at rest, and a sheet is flat, its
    triangles laid out as large as they are in the goal: right to about 1 % where creases
    lie along edges of the triangles, otherwise short by up to a triangle at each crease.

    With --body a goal may also be a mesh file, whose points are the body's, in its order.
    Goals of one body are one batch: give --body, or the same rest and faces.

    The exit status is 0, 1 if a goal has no model within the tolerance, 2 for wrong input.
    """

    goals: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="GOAL ...")]
    """Files of goals."""
    body: Path | None = None
    """The body at rest: a mesh (OBJ, PLY, STL, OFF, GLB, ...) in metres, or an .npz file with
    rest, and with faces if it is a sheet."""
    method: str = "robust"
    """How: robust, paper (section III-A), or meshlab (the paper's own tool, an extra)."""
    tolerance: float | None = None
    """Error below which a model fits, metres; the method's own by default."""
    json: Path | None = None
    """File for the result: an object, or a list of them for several goals."""
    figure: Path | None = None
    """Picture (PNG, PDF, SVG, JPG) of the goals with their models and errors by size."""

    def check(self) -> None:
        """Refuse what cannot be done, before anything is run.

        Raises:
            ValueError: if there is no goal or no such method, the tolerance is not above zero,
                or a path cannot be written to or is that of another file.
        """
        if not self.goals:
            raise ValueError("no goal is given; name at least one file")
        if self.method not in METHODS:
            raise ValueError(f"unknown method {self.method!r}; choose from {', '.join(METHODS)}")
        if self.tolerance is not None and not 0 < self.tolerance < np.inf:
            raise ValueError(f"tolerance is {self.tolerance:g}; give metres, above zero")
        used = [path.resolve() for path in (*self.goals, self.body) if path]
        for name, path in (("--json", self.json), ("--figure", self.figure)):
            if path is None:
                continue
            if path.is_dir():
                raise ValueError(f"{path} is a folder; give a file with {name}")
            if not path.parent.is_dir():
                raise ValueError(f"{path.parent} is no folder; make it, or give another {name}")
            if path.resolve() in used:
                raise ValueError(f"{path} is another file of this command; give another {name}")
            used.append(path.resolve())
        if self.figure:
            _check_figure(self.figure, len(self.goals))


def _check_figure(path: Path, num_goals: int) -> None:
    if path.suffix.lower() not in PICTURES:
        raise ValueError(f"{path} is no picture; give --figure a file in {', '.join(PICTURES)}")
    if num_goals > MOST_PICTURED:
        raise ValueError(
            f"{num_goals} goals are given; a picture shows {MOST_PICTURED} at most: name fewer, "
            f"or leave --figure out"
        )


@dataclass(frozen=True)
class SimplifiedGoal:
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
    options = tyro.cli(Options, prog="python -m jaxsimp.cli.simplify")
    console = Console(width=None if sys.stdout.isatty() else 160)  # a file has no width
    try:
        options.check()
        models = simplified(options)
        console.print(table(models))
        if options.json:
            rows = [row(model, options.method) for model in models]
            records.write_json(options.json, rows[0] if len(rows) == 1 else rows)
        if options.figure:
            save_figure(models, options.figure)
    except (ValueError, OSError) as error:
        told = " ".join(str(error).split())
        Console(stderr=True).print(
            f"error: {told}", style="red", markup=False, highlight=False, soft_wrap=True
        )
        return REFUSED
    return 0 if all(model.key_points.status == FitStatus.FITS for model in models) else NO_MODEL


def simplified(options: Options) -> list[SimplifiedGoal]:
    """Models of all goals in their order, found in a batch for each body.

    Raises:
        ValueError: if a file or an option is refused.
    """
    body = load_body(options.body) if options.body else None
    loaded = [load_goal(path, body) for path in options.goals]
    # Files that define their bodies alike are goals of one body.
    batches: dict[tuple[bytes, bytes], list[int]] = {}
    for index, (made, _) in enumerate(loaded):
        batches.setdefault((made.rest.tobytes(), made.faces.tobytes()), []).append(index)
    models: dict[int, SimplifiedGoal] = {}
    for indices in batches.values():
        made, goals = loaded[indices[0]][0], [loaded[index][1] for index in indices]
        start = time.perf_counter()
        found = simplify_batch(
            made, np.stack(goals), method=options.method, tolerance=options.tolerance
        )
        seconds = (time.perf_counter() - start) / len(found)
        for index, goal, key_points in zip(indices, goals, found, strict=True):
            models[index] = SimplifiedGoal(options.goals[index], made, goal, key_points, seconds)
    return [models[index] for index in range(len(loaded))]


def row(model: SimplifiedGoal, method: str) -> dict[str, Any]:
    """A model as JSON."""
    found = model.key_points
    errors = map(_number, found.errors)
    return {
        "goal": str(model.path),
        "status": found.status.name,
        "key_points": found.particles.tolist(),
        "num_key_points": len(found),
        "positions": found.positions.tolist(),
        "method": method,
        "algorithm": found.method,
        "tolerance": found.tolerance,
        "max_error": _number(found.max_error),
        "rms_error": _number(found.rms_error),
        "certified": found.certified,
        "errors": dict(zip(map(str, found.sizes), errors, strict=True)),
        "seconds": model.seconds,
        "num_particles": model.body.num_particles,
        "environment": records.environment(),
    }


def _number(error: float) -> float | None:
    """An error as JSON, which has no infinity: there is no model of that size."""
    return float(error) if np.isfinite(error) else None


def table(models: list[SimplifiedGoal]) -> Table:
    """Models for people, a line each."""
    made = Table(title="key points", title_justify="left")
    made.add_column("goal", overflow="fold")
    for heading in ("status", "key points", "particles", "tolerance (mm)"):
        made.add_column(heading)
    for heading in ("largest error (mm)", "rms error (mm)", "certified", "seconds"):
        made.add_column(heading)
    for model in models:
        found = model.key_points
        made.add_row(
            escape(str(model.path)),
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


def save_figure(models: list[SimplifiedGoal], path: Path) -> None:
    """A picture of the goals with their models and errors, a row a goal."""
    import matplotlib.pyplot as plt

    from jaxsimp.viz import plot_simplifications

    stems = [model.path.stem for model in models]
    shown = {
        # The whole path where files of several folders have the same name.
        stem if stems.count(stem) == 1 else str(model.path): (
            model.body,
            model.goal,
            model.key_points,
        )
        for stem, model in zip(stems, models, strict=True)
    }
    figure = plot_simplifications(shown)
    figure.savefig(path, dpi=150)
    plt.close(figure)


if __name__ == "__main__":
    sys.exit(main())
