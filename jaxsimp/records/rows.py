"""Rows of results: JSON lines that survive a kill, and the keys without a row."""

import json
import os
from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from jaxsimp.records.files import set_aside, whole_file
from jaxsimp.records.lock import ResultsError

Key = TypeVar("Key", bound=Hashable)
Row = dict[str, Any]


@dataclass(frozen=True)
class RowFile:
    """A JSON-lines file of results, from which a killed study resumes.

    If a key has several rows, the last one counts.

    Attributes:
        path: path of the file, which may not exist yet.
        identity: names of the fields that identify a row. Their values, as a tuple, are its key.
        fields: names of further fields that each row has.
    """

    path: Path
    identity: tuple[str, ...]
    fields: tuple[str, ...] = ()

    def key(self, row: Mapping[str, Any]) -> tuple[Any, ...]:
        """The key of a row."""
        return tuple(row[name] for name in self.identity)

    def append(self, row: Mapping[str, Any]) -> None:
        """Add a row, and flush it to the disk."""
        append_row(self.path, row)

    def rows(self) -> list[Row]:
        """One row a key, the last one, in the order of the keys' first rows.

        Raises:
            ResultsError: if a line is no row.
        """
        rows, damage, _ = self._read()
        _require_whole(self.path, damage)
        return list(self._by_key(rows).values())

    def left(self, keys: Iterable[Key]) -> list[Key]:
        """The keys that have no row yet, in their order."""
        done = set(map(self.key, self.rows()))
        return [key for key in keys if key not in done]

    def in_order(self, keys: Iterable[Hashable]) -> list[Row]:
        """The rows of these keys, in the order of the keys.

        Raises:
            KeyError: if a key has no row.
        """
        rows: dict[Hashable, Row] = {self.key(row): row for row in self.rows()}
        return [rows[key] for key in keys]

    def resume(
        self,
        environment: Mapping[str, Any],
        *,
        mixed: bool = False,
        fault: Callable[[Row], str | None] = lambda row: None,
        tell: Callable[[str], None] = print,
    ) -> None:
        """Prepare the file to be continued: what is damaged in it is left to do again.

        A file with lines that are no rows is set aside under another name, and its rows are kept.
        Rows with a fault are removed. Both are told.

        Args:
            environment: the environment of the rows to come, as from `environment()`.
            mixed: whether rows of another environment are allowed.
            fault: function from a row to what is wrong with what the row tells of, or None.
            tell: prints a line.

        Raises:
            ResultsError: if there are rows of another environment. Nothing is changed then.
        """
        rows, damage, is_cut = self._read()
        sound = self._by_key(rows)
        if not mixed:
            _require_environment(self.path, sound.values(), environment)
        faults = {key: told for key, row in sound.items() if (told := fault(row))}
        if damage:
            kept = set_aside(self.path)
            tell(
                f"{_told_damage(self.path, damage)}; the file is kept as {kept.name}, and what is "
                f"missing is made again"
            )
        for told in faults.values():
            tell(f"{told}; it is made again")
        if damage or faults or is_cut:
            left = [row for row in rows if self.key(row) not in faults]
            with whole_file(self.path) as part:
                part.write_text("".join(map(_line, left)), encoding="utf-8")

    def _read(self) -> tuple[list[Row], list[tuple[int, str]], bool]:
        return _read(self.path, self.identity, self.fields)

    def _by_key(self, rows: Iterable[Row]) -> dict[tuple[Any, ...], Row]:
        return {self.key(row): row for row in rows}


def environments(rows: Iterable[Mapping[str, Any]]) -> list[tuple[dict[str, Any] | None, int]]:
    """The different environments of rows, with the number of rows of each, in order."""
    found: dict[str, tuple[dict[str, Any] | None, int]] = {}
    for row in rows:
        environment = row.get("environment")
        name = json.dumps(_that_counts(environment), sort_keys=True)
        first, number = found.get(name, (environment, 0))
        found[name] = first, number + 1
    return list(found.values())


def append_row(path: Path, row: Mapping[str, Any]) -> None:
    """Add one line to a JSON-lines file, and flush it to the disk.

    A last line that a kill left incomplete is removed.
    """
    with path.open("a+b") as file:
        end = file.seek(0, os.SEEK_END)
        file.seek(max(end - 1, 0))
        if file.read() not in (b"", b"\n"):
            file.seek(0)
            file.truncate(file.read().rfind(b"\n") + 1)
        file.write(_line(row).encode())
        file.flush()
        os.fsync(file.fileno())


def read_rows(path: Path) -> list[Row]:
    """The rows of a JSON-lines file, without a last line that a kill left incomplete.

    Args:
        path: path of the file; without a file there are no rows.

    Raises:
        ResultsError: if a line is no row.
    """
    rows, damage, _ = _read(path)
    _require_whole(path, damage)
    return rows


def _require_whole(path: Path, damage: list[tuple[int, str]]) -> None:
    if damage:
        raise ResultsError(
            f"{_told_damage(path, damage)}; run the study of this folder again, which sets the "
            f"file aside and makes again what is missing, or remove the line"
        )


def _read(
    path: Path, identity: tuple[str, ...] = (), fields: tuple[str, ...] = ()
) -> tuple[list[Row], list[tuple[int, str]], bool]:
    """Rows; number and fault of each line that is no row; whether a kill cut the last line."""
    if not path.exists():
        return [], [], False
    *lines, last = path.read_bytes().split(b"\n")
    is_cut = bool(last) and _is_cut(last)
    if last and not is_cut:
        lines.append(last)
    rows: list[Row] = []
    damage: list[tuple[int, str]] = []
    for number, line in enumerate(lines, 1):
        row = _row(line, identity, fields)
        if isinstance(row, str):
            damage.append((number, row))
        else:
            rows.append(row)
    return rows, damage, is_cut


def _is_cut(last: bytes) -> bool:
    """Whether a line without an end is the beginning of a row; rows are written in ASCII."""
    return last.startswith(b"{") and last.isascii() and b"\0" not in last


def _row(line: bytes, identity: tuple[str, ...], fields: tuple[str, ...]) -> Row | str:
    """The row of a line, or what is wrong with it."""
    if not line.strip():
        return "it is blank"
    try:
        row = json.loads(line.decode())
    except (ValueError, RecursionError):
        return f"it is no JSON: {line[:40]!r}"
    if not isinstance(row, dict):
        return f"it has no fields: {line[:40]!r}"
    missing = [name for name in identity + fields if name not in row]
    if missing:
        return f"it has no field {missing[0]!r}"
    unfit = [name for name in identity if isinstance(row[name], (list, dict))]
    return f"its field {unfit[0]!r} is no single value" if unfit else row


def _line(row: Mapping[str, Any]) -> str:
    return json.dumps(row) + "\n"


def _told_damage(path: Path, damage: list[tuple[int, str]]) -> str:
    """Damaged lines of a file in words: the first, and the number of others."""
    (number, fault), *others = damage
    more = f" (and {len(others)} more such lines)" if others else ""
    return f"{path}, line {number} is no row of results, {fault}{more}"


def _that_counts(environment: Any) -> Any:
    """What of an environment results depend on: all but the kernel of the operating system."""
    if not isinstance(environment, Mapping):
        return None
    return {name: value for name, value in environment.items() if name != "platform"}


def _require_environment(
    path: Path, rows: Iterable[Mapping[str, Any]], environment: Mapping[str, Any]
) -> None:
    now = _flat(json.loads(json.dumps(_that_counts(environment))))
    for row in rows:
        there = _flat(_that_counts(row.get("environment")) or {})
        if told := difference(there, now):
            raise ResultsError(
                f"{path} has rows of another environment: {told}; give another folder with --out, "
                f"or --mixed to go on in this one, and the report says so"
            )


def difference(there: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """Names whose values differ, with the values of the first; empty if all are equal."""
    names = sorted(name for name in there.keys() | now.keys() if there.get(name) != now.get(name))
    if not names:
        return ""
    first = names[0]
    values = f"{there.get(first)!r} there, {now.get(first)!r} now"
    return f"{', '.join(names)} differ ({first}: {values})"


def _flat(values: Mapping[str, Any]) -> dict[str, Any]:
    """Values of a nested mapping by dotted names."""
    flat: dict[str, Any] = {}
    for name, value in values.items():
        inner = _flat(value) if isinstance(value, Mapping) else None
        flat |= (
            {f"{name}.{each}": found for each, found in inner.items()} if inner else {name: value}
        )
    return flat
