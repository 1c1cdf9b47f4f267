"""Times, memory and exponents: the measurements in every row of the benchmark."""

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
    "device",
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
"""Columns of every row; null if meaningless or not measured."""
Row = dict[str, Any]


def make_row(name: str, **fields: Any) -> Row:
    """A row: the common columns, and those of its section."""
    return {**dict.fromkeys(COLUMNS), "name": name, **fields}


@dataclass(frozen=True)
class Scale:
    """Sizes of all measurements.

    Attributes:
        repeats: number of repeats; rows report their median.
        kinds: kinds of bodies for rollouts and layouts.
        rope: number of particles along the rope.
        side: number of particles along a side of the cloths.
        population: number of rollouts at a time.
        num_actions: number of actions in a rollout.
        action_steps: number of time steps of an action.
        chunk_sizes: chunk sizes of the layouts, besides the whole population.
        growth: factors on the length of rollouts for gradients.
        sides: sides of the cloths of the first sweep, in particles.
        populations: populations of the second sweep.
        horizons: numbers of actions in the rollouts of the third sweep.
        contact_sides: sides of the cloths with self-contact, in particles.
        crumpling_actions: number of actions that crumple them.
        cem_side: number of particles along a side of the cloth in planning.
        cem_iterations: number of CEM iterations of a plan.
        cem_plans: number of plans.
        cold_starts: number of processes started of each kind.
        caches: compilation caches of these processes: none, an empty one, the one it filled.
        goals: numbers of goals in the line fits.
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
    crumpling_actions: int
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
    crumpling_actions=15,
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
    crumpling_actions=3,
    cem_side=15,
    cem_iterations=4,
    cem_plans=1,
    cold_starts=1,
    caches=("empty cache", "filled cache"),
    goals=(1, 64),
)


@dataclass(frozen=True)
class Prepared:
    """A function ready for timing.

    Attributes:
        run: function to time; it returns when its result is complete.
        result: result of the first run, which is not timed.
        compile_seconds: time to prepare the function, seconds.
        peak_megabytes: peak memory of the first run above that before, megabytes; None if unknown.
    """

    run: Callable[[], Any]
    result: Any
    compile_seconds: float
    peak_megabytes: float | None


def prepare(make: Callable[[], Callable[[], Any]]) -> Prepared:
    """Prepare a function, and run it once."""
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
        prepared: the timed function.
        seconds: wall times of its runs, seconds.
        particle_steps: time steps of all particles in one run; None if meaningless.
    """
    run_seconds = float(np.median(seconds))
    return {
        "compile_seconds": prepared.compile_seconds,
        "run_seconds": run_seconds,
        "particle_steps_per_second": particle_steps and particle_steps / run_seconds,
        "peak_megabytes": prepared.peak_megabytes,
    }


def time_in_turns(runs: Sequence[Callable[[], Any]], repeats: int) -> np.ndarray:
    """Wall times, shape (repeats, runs), seconds, in turns (A B C A B C ...), for equal load."""
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
    """Free unused memory, reset the peak, and return the memory in use, megabytes."""
    try:
        ctypes.CDLL(None).malloc_trim(0)  # memory freed by compilation would hide a peak
        Path("/proc/self/clear_refs").write_text("5")
    except (OSError, AttributeError):
        return None
    return _status("VmRSS")


def _status(field: str) -> float | None:
    """A size in /proc/self/status, megabytes (1e6 bytes), or None if it is missing."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return None
    sizes = [line.split()[1] for line in lines if line.startswith(f"{field}:")]
    return int(sizes[0]) * 1024 / 1e6 if sizes else None
