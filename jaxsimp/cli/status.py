"""Exit statuses of commands: an error of the user or the machine is one line and status 2.

Ctrl-C has status 130, SIGTERM 143 and SIGHUP 129, as in shells. This module imports what it needs
late: it is loaded before all else, so that a signal during the imports of a command is told, too.
"""

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any

REFUSED = 2
"""Exit status for wrong input, and for a folder or disk that cannot be written to."""
INTERRUPTED = 130
"""Exit status of a program ended by Ctrl-C, as in shells: 128 + the number of the signal."""
SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
"""Signals that end a command in order."""


class Ended(KeyboardInterrupt):
    """A signal asked the process to end."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


def exit_status(run: Callable[[], int], interrupted: str = "interrupted", again: str = "") -> int:
    """Run a command, and turn errors and signals into an exit status.

    Args:
        run: the command; returns its own exit status. A `ValueError`, an `OSError` or an
            `ImportError` that it raises is printed to the standard error stream, in one line.
        interrupted: text to print after Ctrl-C, SIGTERM or SIGHUP. A second signal ends the
            process at once.
        again: text to print after an `OSError`, such as a full disk: how to go on.
    """
    try:
        with _signals_raise():
            return run()
    except OSError as error:
        _print_error(_told(error) + (again and f"; {again}"))
        return REFUSED
    except (ValueError, ImportError) as error:  # of an extra that is not installed
        _print_error(str(error))
        return REFUSED
    except KeyboardInterrupt as ended:
        _print_last(f"\n{interrupted}")
        return 128 + ended.number if isinstance(ended, Ended) else INTERRUPTED


@contextmanager
def _signals_raise() -> Iterator[None]:
    """Let signals raise `Ended`, as Ctrl-C raises; those that are ignored, as by nohup, stay so.

    A second signal ends the process at once, in the middle of what the first one made it do.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread may set handlers
        return

    def end(number: int, frame: FrameType | None) -> None:
        _set(dict.fromkeys(before, signal.SIG_DFL))
        raise Ended(number)

    handlers = {each: signal.getsignal(each) for each in SIGNALS}
    before = {each: known for each, known in handlers.items() if known != signal.SIG_IGN}
    _set(dict.fromkeys(before, end))
    try:
        yield
    except Ended:
        raise  # the process is about to end
    except BaseException:
        _set(before)
        raise
    _set(before)


def _set(handlers: dict[signal.Signals, Any]) -> None:
    for each, handler in handlers.items():
        signal.signal(each, handler)


def _told(error: OSError) -> str:
    """An error of the operating system, without its number."""
    if error.strerror is None:
        return str(error)
    return f"{error.strerror}: {error.filename}" if error.filename else error.strerror


def _print_error(text: str) -> None:
    from rich.console import Console

    line = " ".join(text.split())
    with suppress(OSError):  # nobody may be there to read it
        Console(stderr=True).print(
            f"error: {line}", style="red", markup=False, highlight=False, soft_wrap=True
        )


def _print_last(text: str) -> None:
    """Print, unless the terminal has gone, as after SIGHUP."""
    try:
        print(text, flush=True)
    except OSError:
        sys.stdout = None  # nothing is left to flush at the end
