"""Times, memory and exponents: how every row of the benchmark is measured."""

import ctypes
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

COLUMNS = (
    "name",
    "engine",
    "body",
    "population",
    "layout",
    "compile_seconds",
    "run_seconds",
    "particle_steps_per_second",
    "peak_megabytes",
    "checked_against",
    "error",
)
"""What every row has; null where it has no meaning or was not measured."""
Row = dict[str, Any]


def make_row(name: str, **fields: Any) -> Row:
    """A row: the columns that every row has, and those of its section."""
    return {**dict.fromkeys(COLUMNS), "name": name, **fields}


@dataclass(frozen=True)
class Scale:
    """Sizes of everything that is measured.

    Attributes:
        repeats: of which the median is reported.
        kinds: of bodies that rollouts and layouts are measured on.
        rope: particles along the rope.
        side: particles along a side of the cloths.
        population: rollouts at a time.
        num_actions: in a rollout.
        action_steps: time steps of an action.
        chunk_sizes: of the layouts, beside the whole population.
        growth: factors by which rollouts become longer for their gradient.
        sides: of the cloths of the first sweep.
        populations: of the second.
        horizons: actions of the rollouts of the third.
        contact_sides: of the cloths that touch themselves.
        cem_side: particles along a side of the cloth that is planned for.
        cem_iterations: of a plan.
        cem_plans: plans made.
        cold_starts: processes started of each kind.
        caches: compilation caches that they start with: none, an empty one, the one it filled.
        goals: numbers of goals that lines are fitted to.
    """

    repeats: int
    kinds: tuple[str, ...]
    rope: int
    side: int
    population: int
    num_actions: int
    action_steps: int
    chunk_sizes: tuple[int, ...]
    growth: tuple[int, ...]
    sides: tuple[int, ...]
    populations: tuple[int, ...]
    horizons: tuple[int, ...]
    contact_sides: tuple[int, ...]
    cem_side: int
    cem_iterations: int
    cem_plans: int
    cold_starts: int
    caches: tuple[str, ...]
    goals: tuple[int, ...]


FULL = Scale(
    repeats=5,
    kinds=("rope", "cloth", "unstructured"),
    rope=41,
    side=25,
    population=128,
    num_actions=4,
    action_steps=150,
    chunk_sizes=(1, 4, 8, 16, 32, 64),
    growth=(1, 4, 16),
    sides=(16, 25, 32, 50, 64, 100),
    populations=(16, 64, 256, 1024),
    horizons=(2, 4, 8, 16, 32),
    contact_sides=(25, 36, 50, 64),
    cem_side=25,
    cem_iterations=15,
    cem_plans=3,
    cold_starts=3,
    caches=("no cache", "empty cache", "filled cache"),
    goals=(1, 64, 1024),
)
QUICK = Scale(
    repeats=3,
    kinds=("rope", "cloth"),
    rope=41,
    side=25,
    population=32,
    num_actions=2,
    action_steps=50,
    chunk_sizes=(8,),
    growth=(1,),
    sides=(25, 50),
    populations=(16, 64),
    horizons=(2, 16),
    contact_sides=(25,),
    cem_side=15,
    cem_iterations=4,
    cem_plans=1,
    cold_starts=1,
    caches=("empty cache", "filled cache"),
    goals=(1, 64),
)


@dataclass(frozen=True)
class Prepared:
    """Something made ready to be timed.

    Attributes:
        run: what is timed; it returns when its result is there.
        result: of the first run, which is not timed.
        compile_seconds: that making it ready took.
        peak_megabytes: memory of the first run above that before, or None where it is unknown.
    """

    run: Callable[[], Any]
    result: Any
    compile_seconds: float
    peak_megabytes: float | None


def prepare(make: Callable[[], Callable[[], Any]]) -> Prepared:
    """Make something ready, and run it once."""
    start = time.perf_counter()
    run = make()
    compile_seconds = time.perf_counter() - start
    before = _reset_peak()
    result = run()
    peak = _status("VmHWM")
    megabytes = None if before is None or peak is None else max(0.0, peak - before)
    return Prepared(run, result, compile_seconds, megabytes)


def measured(prepared: Prepared, seconds: np.ndarray, particle_steps: int | None = None) -> Row:
    """The columns of times and memory.

    Args:
        prepared: what was timed.
        seconds: its wall times.
        particle_steps: time steps of all particles in one run, where that has a meaning.
    """
    run_seconds = float(np.median(seconds))
    return {
        "compile_seconds": prepared.compile_seconds,
        "run_seconds": run_seconds,
        "particle_steps_per_second": particle_steps and particle_steps / run_seconds,
        "peak_megabytes": prepared.peak_megabytes,
    }


def time_in_turns(runs: Sequence[Callable[[], Any]], repeats: int) -> np.ndarray:
    """Wall times, shape (repeats, runs), in turns (A B C A B C ...): all see the same load."""
    seconds = np.empty((repeats, len(runs)))
    for repeat in range(repeats):
        for index, run in enumerate(runs):
            start = time.perf_counter()
            run()
            seconds[repeat, index] = time.perf_counter() - start
    return seconds


def fit_exponent(sizes: Sequence[float], values: Sequence[float]) -> float:
    """The `p` of `values ~ sizes ** p`: least squares between logarithms.

    Raises:
        ValueError: if there are fewer than two sizes, or a number is not above zero.
    """
    x, y = np.asarray(sizes, dtype=float), np.asarray(values, dtype=float)
    if len(x) < 2 or not (x > 0).all() or not (y > 0).all():
        raise ValueError(f"sizes {sizes} and values {values}; give two or more, above zero")
    return float(np.polyfit(np.log(x), np.log(y), 1)[0])


def _reset_peak() -> float | None:
    """Give free memory back, start the high-water mark anew, and return the memory in use."""
    try:
        ctypes.CDLL(None).malloc_trim(0)  # else a peak hides in what compilation left free
        Path("/proc/self/clear_refs").write_text("5")
    except (OSError, AttributeError):
        return None
    return _status("VmRSS")


def _status(field: str) -> float | None:
    """A size in /proc/self/status, megabytes (1e6 bytes), or None where there is none."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return None
    sizes = [line.split()[1] for line in lines if line.startswith(f"{field}:")]
    return int(sizes[0]) * 1024 / 1e6 if sizes else None
