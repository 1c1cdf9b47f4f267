"""The study of simplification: rate at which each method finds the right key points of noisy goals.

The key points of a goal are right if they are as many as the true ones and each is within 1.5
spacings of its true one. Goals are ideal ones with noise (see ideal_goals.py), and settled states
of our dynamics after a scripted fold.
"""

import importlib.util
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from rich.console import Console

from experiments.ideal_goals import (
    FOLDS,
    LINES,
    NOISES,
    IdealGoal,
    add_noise,
    ideal_goal,
    ideal_line,
    is_right,
)
from experiments.settled_goals import SETTLED_FOLDS, settled_goal
from experiments.study import default_folder, teller
from jaxsimp import records
from jaxsimp.bodies import Body, cloth, rope
from jaxsimp.checks import require_count, require_seed
from jaxsimp.cli.progress import progress_bar
from jaxsimp.simplification import METHODS, simplify_batch

ROWS_FILE = "goals.jsonl"
IDENTITY = ("kind", "name", "size", "noise", "level", "gap", "rounding", "seed", "method")
"""Fields that identify a row: those of a `Case`, and the method."""
FIELDS = ("right", "certified")
"""Fields that the report reads."""
ROPE_LENGTH = 1.0
ROPE_LEVELS, CLOTH_LEVELS = (0.001, 0.002, 0.004), (0.0005, 0.001, 0.002)
"""Levels of noise, metres: on a rope of 1 m and a cloth of 0.3 m."""
LARGEST_GAP = 0.01
"""Largest random gap of layers, metres."""
ROUNDINGS = (0.0, 0.004)
"""Lateral radii of creases, metres."""


@dataclass(frozen=True)
class SimplificationStudy:
    """Configuration of the study.

    Attributes:
        methods: methods of simplification.
        first_seed: the first seed.
        seeds: number of draws of noise, gap and rounding for each goal and resolution.
        rope_sizes: numbers of particles along the ropes.
        cloth_sizes: numbers of particles along a side of the cloths.
        settled_size: number of particles along a side of the settled cloths.
    """

    methods: tuple[str, ...]
    first_seed: int
    seeds: int
    rope_sizes: tuple[int, ...]
    cloth_sizes: tuple[int, ...]
    settled_size: int

    def __post_init__(self) -> None:
        for name in self.methods:
            if name not in METHODS:
                raise ValueError(f"unknown method {name!r}; choose from {', '.join(METHODS)}")
        if not self.methods:
            raise ValueError(f"no method is given; choose from {', '.join(METHODS)}")
        require_count("seeds", self.seeds, 1)
        require_seed(self.first_seed)
        require_seed(self.first_seed + self.seeds - 1)

    def identity(self) -> dict[str, Any]:
        """Identity of a folder of results."""
        return asdict(self)

    def cases(self) -> Iterator["Case"]:
        """Every goal of the study."""
        sizes = {"rope": self.rope_sizes, "cloth": self.cloth_sizes}
        for kind, names in (("rope", LINES), ("cloth", FOLDS)):
            for size in sizes[kind]:
                for index, name in enumerate(names):
                    for seed in range(self.first_seed, self.first_seed + self.seeds):
                        yield _drawn(kind, name, size, index, seed)
        for name in SETTLED_FOLDS:
            for seed in range(self.first_seed, self.first_seed + self.seeds):
                yield Case("settled", name, self.settled_size, "none", 0.0, 0.0, 0.0, seed)


@dataclass(frozen=True)
class Case:
    """A goal to simplify.

    Attributes:
        kind: "rope", "cloth", or "settled" for the settled state of a cloth.
        name: name of the shape or the fold.
        size: number of particles along the rope or along a side.
        noise: kind of noise.
        level: level of the noise, metres.
        gap: gap of layers, metres.
        rounding: radius of corners or creases, metres.
        seed: seed of the noise.
    """

    kind: str
    name: str
    size: int
    noise: str
    level: float
    gap: float
    rounding: float
    seed: int

    def make(self) -> IdealGoal:
        """The goal, with its noise."""
        body = make_body(self.kind, self.size)
        if self.kind == "settled":
            return settled_goal(body, self.name, self.seed)
        if self.kind == "rope":
            ideal = ideal_line(body, self.name, rounding=self.rounding)
        else:
            ideal = ideal_goal(body, self.name, gap=self.gap, rounding=self.rounding)
        return add_noise(ideal, self.noise, self.level, self.seed)


@cache
def make_body(kind: str, size: int) -> Body:
    """The body of a case."""
    return rope(size, ROPE_LENGTH) if kind == "rope" else cloth((size, size))


def _drawn(kind: str, name: str, size: int, index: int, seed: int) -> Case:
    """A case with the next kind and level of noise in turn, and a random gap."""
    levels = ROPE_LEVELS if kind == "rope" else CLOTH_LEVELS
    # Neighbouring goals and seeds get different combinations, so that few seeds cover all of them.
    turn = seed + index
    rng = np.random.default_rng([size, index, seed])
    return Case(
        kind=kind,
        name=name,
        size=size,
        noise=tuple(NOISES)[turn % len(NOISES)],
        level=levels[(turn // len(NOISES) + seed) % len(levels)],
        gap=float(rng.uniform(0.0, LARGEST_GAP)) if kind == "cloth" else 0.0,
        rounding=ROUNDINGS[(seed // 2) % 2],
        seed=seed,
    )


def available_methods() -> tuple[str, ...]:
    """All methods of simplification, except those whose extra is not installed."""
    missing = () if importlib.util.find_spec("pymeshlab") else ("meshlab",)
    return tuple(name for name in METHODS if name not in missing)


def run_study(
    study: SimplificationStudy, folder: Path, console: Console, *, mixed: bool = False
) -> dict[str, Any]:
    """Simplify the goals missing from the folder, and return the summary of all in it.

    Raises:
        ResultsError: if the folder has rows of another environment, unless `mixed`.
    """
    environment = records.environment()
    rows = records.RowFile(folder / ROWS_FILE, IDENTITY, FIELDS)
    rows.resume(environment, mixed=mixed, tell=teller(console))
    todo = {
        (*asdict(case).values(), method): (case, method)
        for case in study.cases()
        for method in study.methods
    }
    left = [todo[key] for key in rows.left(todo)]
    with progress_bar(console) as progress:
        for case, method in progress.track(left, description="goals"):
            rows.append(_row(case, case.make(), method) | {"environment": environment})
    return {"environment": environment, "goals": rows.in_order(todo)}


def _row(case: Case, ideal: IdealGoal, method: str) -> dict[str, Any]:
    (found,) = simplify_batch(ideal.body, ideal.goal[None], method=method)
    return {
        **asdict(case),
        "method": method,
        "right": is_right(found, ideal),
        "status": found.status.name,
        "key_points": found.particles.tolist(),
        "num_key_points": len(found),
        "num_true": len(ideal.true_points),
        "certified": found.certified,
        "sizes": list(found.sizes),
        "errors": [error if np.isfinite(error) else None for error in found.errors],
        "max_error": found.max_error if np.isfinite(found.max_error) else None,
        "tolerance": found.tolerance,
    }


@dataclass(frozen=True)
class SimplificationOptions:
    """Rate at which each method finds the right key points of noisy goals.

    Stop it with Ctrl-C or kill it at any time: the same command resumes it.
    """

    NAME: ClassVar[str] = "simplification"

    methods: tuple[str, ...] = available_methods()
    """Methods to compare (default: all, meshlab if its extra is installed)."""
    first_seed: int = 0
    """The first seed."""
    seeds: int = 12
    """Number of draws of noise for each goal and resolution."""
    out: Path | None = None
    """Output folder (default: results/simplification, or results/simplification-smoke)."""
    smoke: bool = False
    """One resolution, one seed."""
    mixed: bool = False
    """Go on in a folder with rows of another environment; the report says so."""

    def configuration(self) -> SimplificationStudy:
        """The study of these options.

        Raises:
            ValueError: if the value of an option is invalid.
        """
        return SimplificationStudy(
            methods=self.methods,
            first_seed=self.first_seed,
            seeds=min(self.seeds, 1) if self.smoke else self.seeds,
            rope_sizes=(41,) if self.smoke else (41, 81),
            cloth_sizes=(25,) if self.smoke else (25, 45, 64),
            settled_size=13 if self.smoke else 25,
        )

    def run(self, console: Console) -> None:
        """Run the study."""
        study, folder = self.configuration(), self.out or default_folder(self.NAME, self.smoke)
        with records.open_folder(folder, study.identity()):
            from experiments.simplification_report import write_report

            write_report(study, run_study(study, folder, console, mixed=self.mixed), folder)
        console.print(f"done: {folder}/report.md")
