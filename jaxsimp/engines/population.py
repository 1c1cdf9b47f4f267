"""Layout of a population of rollouts on the cores and devices of this machine.

On a CPU the fastest layout gives every core an equal part of the population, and runs that part in
chunks whose state fits in the cache, each through its whole rollout (under `vmap`, time steps run
with the batch axis last, see batching.py). On a GPU the fastest is the whole population in one
`vmap`. See `Layout`.
"""

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from jaxsimp.checks import require_count
from jaxsimp.machine import num_cores

MOST_WORKERS = 10_000
"""Most threads."""


@dataclass(frozen=True)
class Layout:
    """A population split into one part per worker, each run in chunks of samples.

    Attributes:
        chunk_size: number of samples batched by `vmap`, 1 for no batching; a worker runs its
            chunks one after another.
        num_workers: number of host threads, each with its part; they take the devices in turn.

    Raises:
        ValueError: if a number is below 1.
    """

    chunk_size: int = 1
    num_workers: int = 1

    def __post_init__(self) -> None:
        require_count("chunk_size", self.chunk_size, 1)
        require_count("num_workers", self.num_workers, 1, MOST_WORKERS)


def default_layout(population: int, chunk_size: int) -> Layout:
    """The layout that was fastest in measurements, for a population of rollouts.

    On a CPU every core takes an equal part, in chunks; on other devices every device takes an
    equal part in one `vmap`.

    Args:
        population: number of rollouts at a time.
        chunk_size: fastest number of rollouts under one `vmap` on a core of a CPU, see
            `SearchEngine.chunk_size`.
    """
    devices = jax.local_devices()
    if devices[0].platform != "cpu":
        return Layout(chunk_size=-(-population // len(devices)), num_workers=len(devices))
    return Layout(
        chunk_size=min(chunk_size, population), num_workers=max(num_cores(), len(devices))
    )


class PopulationMap:
    """A function of one sample, compiled for a population of fixed size and layout.

    Compilation is for one worker's part, so every sample runs through the same machine code on
    every worker: results do not depend on the number of workers.

    Attributes:
        compile_seconds: compilation time, seconds.
        temporary_bytes: temporary memory of the compiled function in one worker, bytes; 0 if the
            backend does not report it.
    """

    def __init__(
        self,
        sample_fn: Callable[[Any, Any], Any],
        shared: PyTree[Any],
        batch: PyTree[Any],
        layout: Layout,
    ) -> None:
        """Compile.

        Args:
            sample_fn: function of `shared` and one sample; pure JAX.
            shared: example of the arguments common to all samples.
            batch: example of a whole population, leading axis `B` on every leaf.
            layout: layout of the population on the machine.
        """
        population = len(jax.tree.leaves(batch)[0])
        self._layout = layout
        self._share = _ceil_to(-(-population // layout.num_workers), layout.chunk_size)
        devices = jax.local_devices()
        self._devices = [devices[w % len(devices)] for w in range(layout.num_workers)]
        self._pool = ThreadPoolExecutor(layout.num_workers)
        # `jax.enable_x64` as a context holds for one thread only, so pass it on to the workers.
        self._x64 = jnp.result_type(float) == jnp.float64

        trees = jax.tree.structure(shared), jax.tree.structure(batch)

        # Compile a function of leaves: JAX would otherwise build trees of objects that are not
        # arrays.
        def share_fn(shared: list[Array], share: list[Array]) -> PyTree[Any]:
            shared = jax.tree.unflatten(trees[0], shared)

            def one(sample: list[Array]) -> PyTree[Any]:
                return sample_fn(shared, jax.tree.unflatten(trees[1], sample))

            if layout.chunk_size == 1:
                return jax.lax.map(one, share)
            return jax.lax.map(one, share, batch_size=layout.chunk_size)

        # Full-width vectors: 1.2 to 1.4 times as fast on processors that have them.
        options = {"xla_cpu_prefer_vector_width": 512} if devices[0].platform == "cpu" else None
        jitted = jax.jit(share_fn, compiler_options=options)
        start = time.perf_counter()
        arguments = jax.tree.leaves(shared), self._shares(batch)[0]
        self._compiled = {
            device: jitted.lower(*jax.device_put(arguments, device)).compile()
            for device in dict.fromkeys(self._devices)
        }
        self.compile_seconds = time.perf_counter() - start
        memory = self._compiled[self._devices[0]].memory_analysis()
        self.temporary_bytes = int(memory.temp_size_in_bytes) if memory else 0

    def __call__(self, shared: PyTree[Any], batch: PyTree[Any]) -> PyTree[np.ndarray]:
        """The function's values on a population, leading axis `B`, on the host.

        Raises:
            ValueError: if the batch has more samples than `capacity`.
        """
        population = len(jax.tree.leaves(batch)[0])
        if population > self.capacity:
            raise ValueError(
                f"the batch has {population} samples; the function was compiled for at most "
                f"{self.capacity}"
            )
        run = partial(self._run, jax.tree.leaves(shared))
        shares = self._shares(batch)[: -(-population // self._share)]  # the others are empty
        results = self._pool.map(run, self._devices, shares)
        return jax.tree.map(lambda *parts: np.concatenate(parts)[:population], *results)

    def whole_chunks(self, population: int) -> int:
        """Number of samples of the chunks that a population takes."""
        return _ceil_to(population, self._layout.chunk_size)

    @property
    def capacity(self) -> int:
        """Largest number of samples of a call: whole chunks on every worker."""
        return self._share * self._layout.num_workers

    def _run(
        self, shared: list[Any], device: jax.Device, share: list[np.ndarray]
    ) -> PyTree[np.ndarray]:
        with jax.enable_x64(self._x64):
            return jax.device_get(self._compiled[device](*jax.device_put((shared, share), device)))

    def _shares(self, batch: PyTree[Any]) -> list[list[np.ndarray]]:
        """Leaves of equal parts, the last ones padded with copies of the last sample."""
        leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(batch)]
        wanted = np.arange(self._share * self._layout.num_workers)
        wanted = np.minimum(wanted, len(leaves[0]) - 1)
        shares = np.split(wanted, self._layout.num_workers)
        return [[leaf[share] for leaf in leaves] for share in shares]


def _ceil_to(count: int, multiple: int) -> int:
    return -(-count // multiple) * multiple
