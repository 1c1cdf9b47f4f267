"""Rows of results: JSON lines that survive a kill, and the keys without a row."""

import json
import os
from collections.abc import Hashable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

Key = TypeVar("Key", bound=Hashable)


@dataclass(frozen=True)
class RowFile:
    """A JSON-lines file of results, from which a killed study resumes.

    Attributes:
        path: path of the file, which may not exist yet.
        identity: names of the fields that identify a row. Their values, as a tuple, are its key.
    """

    path: Path
    identity: tuple[str, ...]

    def key(self, row: Mapping[str, Any]) -> tuple[Any, ...]:
        """The key of a row."""
        return tuple(row[name] for name in self.identity)

    def append(self, row: Mapping[str, Any]) -> None:
        """Add a row, and flush it to the disk."""
        append_row(self.path, row)

    def left(self, keys: Iterable[Key]) -> list[Key]:
        """The keys that have no row yet, in their order."""
        done = {self.key(row) for row in read_rows(self.path)}
        return [key for key in keys if key not in done]

    def in_order(self, keys: Iterable[Hashable]) -> list[dict[str, Any]]:
        """The rows of these keys, in the order of the keys.

        Raises:
            KeyError: if a key has no row.
        """
        rows: dict[Hashable, dict[str, Any]]
        rows = {self.key(row): row for row in read_rows(self.path)}
        return [rows[key] for key in keys]


def append_row(path: Path, row: Mapping[str, Any]) -> None:
    """Add one line to a JSON-lines file, and flush it to the disk."""
    with path.open("a") as file:
        file.write(json.dumps(row) + "\n")
        file.flush()
        os.fsync(file.fileno())


def read_rows(path: Path) -> list[dict[str, Any]]:
    """The rows of a JSON-lines file; removes a last line that a kill left incomplete."""
    if not path.exists():
        return []
    whole, newline, rest = path.read_text().rpartition("\n")
    if rest:
        with path.open("r+") as file:
            file.truncate(len((whole + newline).encode()))
    return [json.loads(line) for line in whole.splitlines()]
