"""Provenance: the environment that results depend on, besides their configuration."""

import importlib.metadata
import os
import platform
import subprocess
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from jaxsimp.machine import num_cores

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
        "commit": _commit(),
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


def _commit() -> str:
    """The commit of the code, with `+changes` if files differ from it."""
    root = Path(__file__).parent
    git = ["git", "-C", str(root)]
    try:
        commit = subprocess.run(
            [*git, "rev-parse", "HEAD"], capture_output=True, text=True, check=True
        ).stdout.strip()
        status = subprocess.run(
            [*git, "status", "--porcelain"], capture_output=True, text=True, check=True
        ).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return commit + ("+changes" if status else "")


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    if info.exists():
        for line in info.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor()
