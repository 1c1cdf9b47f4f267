"""Results on disk: a folder that one configuration owns, rows that survive a kill, provenance."""

import importlib.metadata
import json
import os
import platform
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from jaxsimp.machine import num_cores

CONFIG_FILE = "config.json"
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


class ResultsError(Exception):
    """A results folder cannot be used as asked; the message says why and what to do."""


def environment() -> dict[str, Any]:
    """What results depend on besides their configuration: versions, commit, device, cores."""
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
    }


def open_folder(folder: Path, config: Mapping[str, Any]) -> None:
    """Make a results folder for a configuration, or find the one made earlier.

    Raises:
        ResultsError: if the folder is a file, cannot be written to, or was made with another
            configuration. Nothing is written then.
    """
    if folder.exists() and not folder.is_dir():
        raise ResultsError(f"{folder} is a file; give a folder with --out")
    path = folder / CONFIG_FILE
    wanted = json.loads(json.dumps(config))
    if path.exists():
        _require_same(folder, _read_config(path), wanted)
    elif folder.is_dir() and any(folder.iterdir()):
        raise ResultsError(
            f"{folder} holds files but no {CONFIG_FILE}; give an empty or a new folder with --out"
        )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_json(path, wanted)
    except OSError as error:
        raise ResultsError(
            f"{folder} cannot be written to ({error.strerror}); give another folder with --out"
        ) from error


def _read_config(path: Path) -> dict[str, Any]:
    try:
        config = json.loads(path.read_text())
    except ValueError:  # neither JSON nor text
        config = None
    if not isinstance(config, dict):
        raise ResultsError(f"{path} is no configuration of ours; give another folder with --out")
    return config


def _require_same(folder: Path, found: dict[str, Any], wanted: dict[str, Any]) -> None:
    differing = sorted(
        name for name in found.keys() | wanted.keys() if found.get(name) != wanted.get(name)
    )
    if differing:
        name = differing[0]
        raise ResultsError(
            f"{folder} was made with another configuration: {', '.join(differing)} differ "
            f"({name}: {found.get(name)!r} there, {wanted.get(name)!r} now); "
            f"give another folder with --out, or remove this one"
        )


def write_json(path: Path, value: object) -> None:
    """Write a JSON file that appears under its name whole or not at all."""
    part = path.with_name(path.name + ".part")
    part.write_text(json.dumps(value, indent=1) + "\n")
    os.replace(part, path)


def append_row(path: Path, row: Mapping[str, Any]) -> None:
    """Add one line to a JSON-lines file and make sure that it is on the disk."""
    with path.open("a") as file:
        file.write(json.dumps(row) + "\n")
        file.flush()
        os.fsync(file.fileno())


def read_rows(path: Path) -> list[dict[str, Any]]:
    """The rows of a JSON-lines file; a last line cut short by a kill is removed from it."""
    if not path.exists():
        return []
    whole, newline, rest = path.read_text().rpartition("\n")
    if rest:
        with path.open("r+") as file:
            file.truncate(len((whole + newline).encode()))
    return [json.loads(line) for line in whole.splitlines()]


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def _commit() -> str:
    """The commit that the code is at, with `+changes` where files differ from it."""
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
