"""One process at a time works in a results folder; the others are told which."""

import getpass
import json
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path

from jaxsimp.records.files import write_json

LOCK_FILE, HOLDER_FILE = ".lock", ".holder.json"
PATIENCE = 1.0
"""Seconds to wait for a process that is about to end."""


class ResultsError(ValueError):
    """A results folder is not usable; the message gives the reason and a remedy."""


@contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Hold a folder while the context lasts.

    The lock is the operating system's, on a file that stays in the folder: it ends with the
    process, however that ends.

    Raises:
        ResultsError: if another process holds the folder, or the folder cannot be written to.
    """
    import filelock

    lock = filelock.FileLock(folder / LOCK_FILE, timeout=PATIENCE)
    try:
        lock.acquire()
    except filelock.Timeout as error:
        raise ResultsError(
            f"{folder} is in use by {_holder(folder)}; wait until it has ended, or give another "
            f"folder with --out"
        ) from error
    except OSError as error:
        raise not_writable(folder, error) from error
    try:
        try:
            write_json(folder / HOLDER_FILE, _this_process())
        except OSError as error:
            raise not_writable(folder, error) from error
        yield
    finally:
        with suppress(OSError):  # the folder may have vanished
            (folder / HOLDER_FILE).unlink()
        with suppress(OSError):
            lock.release()


def not_writable(folder: Path, error: OSError) -> ResultsError:
    """The error of a folder that cannot be written to."""
    return ResultsError(
        f"{folder} cannot be written to ({error.strerror}); cure that, or give another folder "
        f"with --out"
    )


def _this_process() -> dict[str, str | int]:
    try:
        user = getpass.getuser()
    except (KeyError, OSError):  # a number without a name, as in containers
        user = ""
    since = datetime.now(UTC).isoformat(sep=" ", timespec="seconds")
    return {"process": os.getpid(), "host": socket.gethostname(), "user": user, "since": since}


def _holder(folder: Path) -> str:
    """The process that holds a folder, in words."""
    try:
        told = json.loads((folder / HOLDER_FILE).read_text())
        user = f" of the user {told['user']}" if told["user"] else ""
        return f"process {told['process']} on {told['host']}{user}, since {told['since']}"
    except (OSError, ValueError, KeyError, TypeError):  # it has just begun, or just ended
        return "another process"
