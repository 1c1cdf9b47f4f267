"""The verb `simplify`: key points of goals in files.

The face loads each room at first use, so that `jaxsimp --help` imports none of them.
"""

import math
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.markup import escape
from rich.table import Table

import jaxsimp
from jaxsimp.cli.hints import told_hints

NO_MODEL = 1
"""Exit status if some goal has no model within the tolerance and the workspace."""
PICTURES = (".jpg", ".pdf", ".png", ".svg")
MOST_PICTURED = 40
"""Largest number of goals in one picture: matplotlib draws up to 65,536 pixels, 500 per goal."""
XYZ = tuple[float, float, float]


@dataclass(frozen=True)
class Options:
    """Key points of goals in files: the particles to grasp to reach them.

    A goal is an .npz file with `positions` (N x 3, metres, z up, the table at z = 0). It may
    define its body: by `rest` (N x 2 or N x 3) and `faces` (F x 3) a sheet, without faces a
    rope. Without rest coordinates a rope is straight at rest, and a sheet is flat, with the
    edge lengths of the goal: accurate to about 1 % where creases lie along edges of the
    triangles, otherwise too short by up to a triangle at each crease.

    With --body a goal may also be a mesh file or an .npy file of positions, and its points may be
    others than the body's particles, or in another order: they are registered. Coordinates are in
    metres with z up: --scale 0.001 takes files in millimetres, --up y files in which y points up.
    Goals of one body are one batch: give --body, or the same rest and faces.

    --lower, --upper, --above-table, --fixed-ends and --max-stretch limit the models of ropes
    to a workspace. A goal that has no model within it has the status INFEASIBLE.

    The exit status is 0, 1 if a goal has no model within the tolerance and the workspace, 2 for
    wrong input.
    """

    goals: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="GOAL ...")]
    """Files of goals."""
    body: Path | None = None
    """The body at rest: a mesh (OBJ, PLY, STL, OFF, GLB, ...) in metres, or an .npz file with
    rest, and with faces if it is a sheet."""
    scale: float = 1.0
    """Metres in one unit of the files, of goals and body: 0.001 for millimetres."""
    up: str | None = None
    """Axis of the files that points up: z, y or x; z by default."""
    method: str = "robust"
    """Method: robust, paper (section III-A), or meshlab (the paper's tool, an optional extra)."""
    tolerance: float | None = None
    """Error below which a model fits, metres; the method's own by default."""
    lower: Annotated[XYZ | None, tyro.conf.arg(metavar="X Y Z")] = None
    """Lowest x, y and z of a rope's model, metres; -inf for no limit."""
    upper: Annotated[XYZ | None, tyro.conf.arg(metavar="X Y Z")] = None
    """Highest x, y and z of a rope's model, metres; inf for no limit."""
    above_table: bool = False
    """Keep a rope's model at least the rope's radius above the table at z = 0."""
    fixed_ends: bool = False
    """Keep the ends of a rope's model at the ends of the goal."""
    max_stretch: float | None = None
    """Largest elongation of a segment of a rope's model, as a fraction of its rest length (0.05
    for 5 %)."""
    json: Path | None = None
    """File for the result: an object, or a list of them for several goals."""
    figure: Path | None = None
    """Picture (PNG, PDF, SVG, JPG) of the goals with their models and errors by size."""

    def check(self) -> None:
        """Check the options before any computation.

        Raises:
            ValueError: if there is no goal, the method or the axis is unknown, a number is out of
                its range, the workspace is invalid, or a path is not writable or is another
                file's.
        """
        from jaxsimp.bodies.size import LARGEST, require_scale
        from jaxsimp.checks import require_choice, require_number
        from jaxsimp.cli.paths import require_writable
        from jaxsimp.simplification.key_points import SMALLEST_TOLERANCE

        if not self.goals:
            raise ValueError("no goal is given; name at least one file")
        require_choice("method", self.method, jaxsimp.METHODS)
        require_choice("up", self.up or "z", ("x", "y", "z"))
        require_scale(self.scale)
        if self.tolerance is not None:
            require_number("tolerance", self.tolerance, SMALLEST_TOLERANCE, LARGEST, "m")
        self.workspace()
        used = [path.resolve() for path in (*self.goals, self.body) if path]
        for name, path in (("--json", self.json), ("--figure", self.figure)):
            if path is None:
                continue
            require_writable(path, name)
            if path.resolve() in used:
                raise ValueError(f"{path} is another file of this command; give another {name}")
            used.append(path.resolve())
        if self.figure:
            _check_figure(self.figure, len(self.goals))

    def workspace(self) -> "jaxsimp.Workspace | None":
        """The workspace that the options define; None without such options.

        Raises:
            ValueError: if a bound or `max_stretch` is out of its range.
        """
        given = {
            "lower": self.lower,
            "upper": self.upper,
            "above_table": self.above_table or None,
            "fixed_ends": self.fixed_ends or None,
            "max_stretch": self.max_stretch,
        }
        limits: dict[str, Any] = {name: each for name, each in given.items() if each is not None}
        return jaxsimp.Workspace(**limits) if limits else None

    def run(self) -> int:
        """Simplify the goals, print a table, and write the requested files.

        Returns:
            The exit status: 0, or `NO_MODEL`.

        Raises:
            ValueError: if a file or an option is invalid; nothing is written then.
            OSError: if a file cannot be written.
        """
        self.check()
        models = simplified(self)
        console = Console(width=None if sys.stdout.isatty() else 160)  # fixed width for a file
        console.print(table(models))
        if self.json:
            rows = [row(model, self.method) for model in models]
            jaxsimp.records.write_json(self.json, rows[0] if len(rows) == 1 else rows)
        if self.figure:
            save_figure(models, self.figure)
        fits = jaxsimp.FitStatus.FITS
        return 0 if all(model.key_points.status == fits for model in models) else NO_MODEL


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
    """A goal and its model.

    Attributes:
        path: path of the goal's file.
        body: body of the goal.
        goal: shape (N, 3), metres.
        key_points: the model.
        seconds: computing time, seconds; that of a batch over its number of goals.
    """

    path: Path
    body: "jaxsimp.Body"
    goal: "jaxsimp.goals.Positions"
    key_points: "jaxsimp.KeyPoints"
    seconds: float


def simplified(options: Options) -> list[SimplifiedGoal]:
    """Models of all goals in their order, computed in one batch per body.

    Raises:
        ValueError: if a file or an option is invalid.
    """
    from jaxsimp.goals import load_body, load_goal

    scale, up = options.scale, options.up
    with told_hints():
        body = load_body(options.body, scale=scale, up=up) if options.body else None
        loaded = [load_goal(path, body, scale=scale, up=up or "z") for path in options.goals]
    # Files with equal body definitions are goals of one body.
    batches: dict[tuple[bytes, bytes], list[int]] = {}
    for index, (made, _) in enumerate(loaded):
        batches.setdefault((made.rest.tobytes(), made.faces.tobytes()), []).append(index)
    models: dict[int, SimplifiedGoal] = {}
    for indices in batches.values():
        paths = [options.goals[index] for index in indices]
        goals = [loaded[index][1] for index in indices]
        batch = _simplified_batch(options, loaded[indices[0]][0], paths, goals)
        models.update(zip(indices, batch, strict=True))
    return [models[index] for index in range(len(loaded))]


def _simplified_batch(
    options: Options,
    body: "jaxsimp.Body",
    paths: list[Path],
    goals: "list[jaxsimp.goals.Positions]",
) -> list[SimplifiedGoal]:
    """Models of the goals of one body."""
    import numpy as np

    start = time.perf_counter()
    found = jaxsimp.simplify_batch(
        body,
        np.stack(goals),
        method=options.method,
        tolerance=options.tolerance,
        workspace=options.workspace(),
    )
    seconds = (time.perf_counter() - start) / len(found)
    return [
        SimplifiedGoal(path, body, goal, key_points, seconds)
        for path, goal, key_points in zip(paths, goals, found, strict=True)
    ]


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
        "environment": jaxsimp.records.environment(),
    }


def _number(error: float) -> float | None:
    """An error as JSON: None for infinity, where there is no model of that size."""
    return float(error) if math.isfinite(error) else None


def table(models: list[SimplifiedGoal]) -> Table:
    """A table of the models for the terminal, one line each."""
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
    """Save a picture of the goals with their models and errors, one row per goal."""
    import matplotlib.pyplot as plt

    stems = [model.path.stem for model in models]
    shown = {
        # The whole path if files of several folders have the same name.
        stem if stems.count(stem) == 1 else str(model.path): (
            model.body,
            model.goal,
            model.key_points,
        )
        for stem, model in zip(stems, models, strict=True)
    }
    figure = jaxsimp.viz.plot_simplifications(shown)
    with jaxsimp.records.whole_file(path) as part:
        figure.savefig(part, dpi=150)
    plt.close(figure)
