"""What a process of the fuzzer sets first: JAX that compiles quickly, and a limit of memory."""

import atexit
import os
import resource
import shutil
import tempfile

SPARE_BYTES = 8 * 2**30
"""Memory that inputs may take, beyond what the process has mapped at the start."""


def prepare() -> None:
    """Keep compiled programs for the life of the first process, and optimise little."""
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        programs = tempfile.mkdtemp(prefix="jaxsimp-fuzz-")
        atexit.register(shutil.rmtree, programs, ignore_errors=True)
        os.environ["JAX_COMPILATION_CACHE_DIR"] = programs
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
    os.environ["JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES"] = "0"
    os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = "true"
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    os.environ.setdefault("MPLBACKEND", "Agg")


def limit_memory() -> None:
    """Let allocations that are far too large fail, instead of the machine."""
    with open("/proc/self/statm") as file:
        mapped = int(file.read().split()[0]) * resource.getpagesize()
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (mapped + SPARE_BYTES, hard))
