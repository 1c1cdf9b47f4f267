"""The same rollouts in other implementations, for comparison with jaxsimp's speed.

An engine is a function that prepares a `Workload`, compilation included, and returns a function
that computes its final positions, shape (B, N, 3), metres. It raises `UnavailableError` if the
compiler or library that it needs is missing.
"""

import importlib
import os
from collections.abc import Callable
from functools import partial

import numpy as np

from experiments.benchmark.peers import c_step, edge_list, numpy_step, population_map
from experiments.benchmark.peers.workload import UnavailableError, Workload
from jaxsimp.machine import num_cores

Engine = Callable[[Workload], Callable[[], np.ndarray]]


def _peer(module: str, workload: Workload) -> Callable[[], np.ndarray]:
    """Prepare an engine of the extra `peers`, imported on demand."""
    os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")
    try:
        found = importlib.import_module(f"experiments.benchmark.peers.{module}")
    except ImportError as error:
        raise UnavailableError(f"{error}: install the extra 'peers'") from error
    return found.prepare(workload)


ENGINES: dict[str, tuple[str, str, Engine]] = {
    "jaxsimp": ("jaxsimp", "default layout", population_map.prepare),
    "c": ("c", "all cores", partial(c_step.prepare, num_threads=num_cores())),
    "c_1_thread": ("c", "1 thread", partial(c_step.prepare, num_threads=1)),
    "taichi": ("taichi", "all cores", partial(_peer, "taichi_step")),
    "warp": ("warp", "all cores", partial(_peer, "warp_step")),
    "numpy": ("numpy", f"1 thread, chunks of {numpy_step.CHUNK_SIZE}", numpy_step.prepare),
    "edge_list_vmap": ("edge_list_vmap", "one vmap", edge_list.prepare),
}
"""Kind of each engine, its layout of the population, and the engine."""
