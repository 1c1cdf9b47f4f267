"""Results on disk: a folder for one configuration, and atomic writes of JSON."""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

CONFIG_FILE = "config.json"


class ResultsError(ValueError):
    """A results folder is not usable; the message gives the reason and a remedy."""


def open_folder(folder: Path, config: Mapping[str, Any]) -> None:
    """Make a results folder for a configuration, or open the existing one.

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
        raise ResultsError(f"{path} is not a configuration file; give another folder with --out")
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
    """Write a JSON file atomically: under its name it is complete or absent."""
    part = path.with_name(path.name + ".part")
    part.write_text(json.dumps(value, indent=1) + "\n")
    os.replace(part, path)
