"""What a process of the fuzzer sets first: JAX that compiles quickly."""

import atexit
import os
import shutil
import tempfile


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
