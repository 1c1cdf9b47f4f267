"""Provenance: the environment that results depend on, besides their configuration."""

import importlib.metadata
import os
import platform
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from jaxsimp.machine import num_cores
from jaxsimp.records.commit import own_commit

PACKAGES = (
    "jaxsimp",
    "jax",
    "jaxlib",
    "numpy",
    "scipy",
    "optax",
    "libigl",
    "proxsuite",
    "mujoco",
)
SETTINGS = (
    "jax_enable_x64",
    "jax_default_prng_impl",
    "jax_threefry_partitionable",
    "jax_random_seed_offset",
    "jax_default_matmul_precision",
    "jax_disable_most_optimizations",
)
"""Settings of JAX that change what is computed."""


def environment() -> dict[str, Any]:
    """What results depend on besides their configuration: versions, commit, machine, settings."""
    device = jax.devices()[0]
    return {
        "python": platform.python_version(),
        "versions": {name: _version(name) for name in PACKAGES},
        "commit": own_commit(Path(__file__).parents[2]),
        "platform": platform.platform(),
        "processor": _processor(),
        "cores": num_cores(),
        "device": device.device_kind,
        "num_devices": jax.device_count(),
        "x64": jnp.result_type(float) == jnp.float64,
        "settings": {name: _setting(name) for name in SETTINGS}
        | {"XLA_FLAGS": " ".join(os.environ.get("XLA_FLAGS", "").split())},
    }


def _setting(name: str) -> Any:
    """A setting of JAX, here and now; not every one is an attribute."""
    return getattr(jax.config, name, jax.config.values.get(name))


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(errors="replace").splitlines()
    except OSError:  # on systems other than Linux
        lines = []
    for line in lines:
        if line.startswith("model name"):  # not on aarch64
            return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
