"""Results on disk: a folder for one configuration, in which one process works at a time."""

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from jaxsimp.checks import require_path
from jaxsimp.records.files import PART, remove_parts, write_json
from jaxsimp.records.lock import HOLDER_FILE, LOCK_FILE, ResultsError, lock_folder, not_writable
from jaxsimp.records.rows import difference

CONFIG_FILE = "config.json"


@contextmanager
def open_folder(folder: Path, config: Mapping[str, Any]) -> Iterator[None]:
    """Make a results folder for a configuration, or open the existing one, and hold it: a context.

    While the context lasts no other process can open the folder. What a kill left of files that
    were being written is removed.

    Raises:
        ResultsError: if the folder is a file, cannot be written to, is held by another process,
            or was made with another configuration. No file of the folder is changed then.
    """
    wanted = json.loads(json.dumps(config))
    require_path(folder, "give another folder with --out")
    _require_ours(folder, wanted)  # before the lock, which is a file
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise not_writable(folder, error) from error
    with lock_folder(folder):
        _require_ours(folder, wanted)  # another process may have made it meanwhile
        try:
            remove_parts(folder)
            if not (folder / CONFIG_FILE).exists():
                write_json(folder / CONFIG_FILE, wanted)
        except OSError as error:
            raise not_writable(folder, error) from error
        yield


def _require_ours(folder: Path, wanted: dict[str, Any]) -> None:
    """Raise a `ResultsError` unless a folder is new, or one of this configuration."""
    if folder.exists() and not folder.is_dir():
        raise ResultsError(f"{folder} is a file; give a folder with --out")
    path = folder / CONFIG_FILE
    if path.exists():
        _require_same(folder, _read_config(path), wanted)
    elif folder.is_dir() and not all(map(_left_by_a_kill, folder.iterdir())):
        raise ResultsError(
            f"{folder} holds files but no {CONFIG_FILE}; give an empty or a new folder with --out"
        )


def _left_by_a_kill(path: Path) -> bool:
    """Whether a file is one that opening a folder makes before the configuration."""
    names = (LOCK_FILE, HOLDER_FILE, f"{CONFIG_FILE}.part")
    return path.name in names or path.name.startswith(PART)


def _read_config(path: Path) -> dict[str, Any]:
    try:
        config = json.loads(path.read_text(encoding="utf-8"))
        fault = "it has no names with values"
    except (ValueError, RecursionError) as error:  # neither JSON nor text
        config, fault = None, str(error)
    if not isinstance(config, dict):
        raise ResultsError(
            f"{path} is damaged, or not a configuration ({fault}), so that nobody can tell which "
            f"rows the folder should hold; put back a copy of the file, or give another folder "
            f"with --out"
        )
    return config


def _require_same(folder: Path, found: dict[str, Any], wanted: dict[str, Any]) -> None:
    if told := difference(found, wanted):
        raise ResultsError(
            f"{folder} was made with another configuration: {told}; give another folder with "
            f"--out, or remove this one"
        )
