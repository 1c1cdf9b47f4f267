"""The step in C, compiled at run time for one body, one call per sample."""

import ctypes
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from experiments.benchmark.peers.workload import (
    GRAVITY,
    Offsets,
    UnavailableError,
    Workload,
    by_offset,
)

SOURCE = Path(__file__).with_name("step.c")
COMPILERS = ("cc", "gcc", "clang")
FLAGS = (
    ("-march=native", "-ffast-math", "-fopenmp-simd", "-mprefer-vector-width=512"),
    ("-march=native", "-ffast-math", "-fopenmp-simd"),
    ("-ffast-math",),
)
"""Sets of flags, the fastest first; the first that the compiler accepts is in use."""
MAX_OFFSETS = 32
"""Largest number of offsets: loops over more do not unroll. Ropes and grids have fewer."""


class _Physics(ctypes.Structure):
    _fields_ = tuple(
        (name, ctypes.c_float)
        for name in ("radius", "friction", "drag", "gravity", "time_step", "shortest")
    )


def prepare(workload: Workload, num_threads: int) -> Callable[[], np.ndarray]:
    """A function giving the final positions, shape (B, N, 3), metres.

    Args:
        workload: workload to compute.
        num_threads: number of threads for the samples; the calls release the interpreter's lock.

    Raises:
        UnavailableError: if there is no C compiler, or the springs have too many offsets.
    """
    body, dt = workload.body, workload.time_step
    springs = by_offset(body)
    rollout = _compile(springs)
    halo = ((0, 0), (int(springs.offsets.max()), 0))
    tables = (springs.stiffness, springs.stiffness * springs.rest_length, springs.damping)
    arrays = [np.pad(table, halo).astype(np.float32) for table in tables]
    arrays.append((dt / body.mass).astype(np.float32))
    friction, drag = body.material.friction, body.material.drag
    physics = _Physics(body.radius, friction, drag, GRAVITY, dt, workload.shortest)
    start, shares = (np.ascontiguousarray(a, np.float32) for a in (workload.start, workload.shares))
    pick, move = workload.pick, workload.displacement
    sizes = pick.shape[1], workload.action_steps, pick.shape[2]
    pool = ThreadPoolExecutor(num_threads)

    def run_one(sample: int, end: np.ndarray) -> None:
        ends = map(_pointer, (pick[sample], move[sample], shares, end))
        if rollout(*map(_pointer, arrays), physics, _pointer(start), *sizes, *ends):
            raise MemoryError("a rollout in C")

    def run() -> np.ndarray:
        end = np.empty((workload.population, *start.shape), np.float32)
        list(pool.map(run_one, range(len(end)), end))
        return end

    return run


def _compile(springs: Offsets) -> Callable[..., int]:
    """The C function for a body with these springs.

    Compilation and linking are separate steps: linking with -ffast-math would change the
    floating-point mode of the thread that loads the library.
    """
    if len(springs.offsets) > MAX_OFFSETS:
        raise UnavailableError(
            f"the springs have {len(springs.offsets)} offsets; the C step takes up to {MAX_OFFSETS}"
        )
    compiler = next(filter(None, map(shutil.which, COMPILERS)), None)
    if compiler is None:
        raise UnavailableError(f"no C compiler found ({', '.join(COMPILERS)})")
    macros = (
        f"-DNUM_PARTICLES={springs.stiffness.shape[1]}",
        f"-DHALO={springs.offsets.max()}",
        f"-DOFFSETS={','.join(map(str, springs.offsets))}",
    )
    with tempfile.TemporaryDirectory() as folder:
        compiled, library = Path(folder, "step.o"), Path(folder, "step.so")
        link = (compiler, "-shared", "-o", library, compiled, "-lm")
        for flags in FLAGS:
            build = (compiler, "-O3", "-fPIC", *flags, *macros, "-c", SOURCE, "-o", compiled)
            done = [subprocess.run(command, capture_output=True) for command in (build, link)]
            if not any(each.returncode for each in done):
                return ctypes.CDLL(str(library)).rollout
    raise UnavailableError(
        f"{compiler} fails: {done[0].stderr.decode(errors='replace').strip()[:200]}"
    )


def _pointer(array: np.ndarray) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)
