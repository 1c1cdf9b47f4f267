"""Files that are whole or absent, whatever ends the process, and damaged ones set aside."""

import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path

PART = ".part-"
"""How the name of a folder begins in which a file is written until it is whole."""


@contextmanager
def whole_file(path: str | Path) -> Iterator[Path]:
    """A path to write to; the file gets its own name when it is whole.

    The path has the name of the file, in a folder of its own beside it: libraries tell the format
    by the name. A kill leaves that folder, which `remove_parts` knows.

    Args:
        path: path of the file.

    Raises:
        OSError: if the file cannot be written; then what `path` held before is untouched.
    """
    path = Path(path)
    part: Path | None = None
    try:
        part = Path(tempfile.mkdtemp(prefix=PART, dir=path.parent))
        yield part / path.name
        with (part / path.name).open("rb") as file:
            os.fsync(file.fileno())
        os.replace(part / path.name, path)
    except OSError as error:
        if error.errno is None:
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        if part is not None:
            shutil.rmtree(part, ignore_errors=True)


def write_text(path: str | Path, text: str) -> None:
    """Write a text file: under its name it is complete or absent."""
    with whole_file(path) as part:
        part.write_text(text, encoding="utf-8")


def write_json(path: str | Path, value: object) -> None:
    """Write a JSON file: under its name it is complete or absent."""
    write_text(path, json.dumps(value, indent=1) + "\n")


def set_aside(path: Path) -> Path:
    """Copy a damaged file to another name, with a number that is free, and return that path.

    The file stays until its caller replaces it, so that a kill loses nothing.
    """
    free = (path.with_name(f"{path.name}.damaged-{number}") for number in count(1))
    kept = next(each for each in free if not each.exists())
    with whole_file(kept) as part:
        shutil.copyfile(path, part)
    return kept


def remove_parts(folder: Path) -> None:
    """Remove what a kill left of files that were being written in a folder, or in one below."""
    for part in list(folder.rglob(f"{PART}*")):
        shutil.rmtree(part, ignore_errors=True)
    for old in list(folder.rglob("*.part")):  # of version 0.1
        old.unlink(missing_ok=True)
