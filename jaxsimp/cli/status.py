"""Exit statuses of commands: a user's error is one red line and status 2, Ctrl-C is 130."""

from collections.abc import Callable

from rich.console import Console

REFUSED = 2
"""Exit status for wrong input."""
INTERRUPTED = 130
"""Exit status of a program ended by Ctrl-C, as in shells."""


def exit_status(run: Callable[[], int], interrupted: str = "interrupted") -> int:
    """Run a command, and turn errors and Ctrl-C into an exit status.

    Args:
        run: the command; returns its own exit status. A `ValueError` or an `OSError` that it
            raises is printed to the standard error stream, in one line.
        interrupted: text to print after Ctrl-C.
    """
    try:
        return run()
    except (ValueError, OSError) as error:
        line = " ".join(str(error).split())
        Console(stderr=True).print(
            f"error: {line}", style="red", markup=False, highlight=False, soft_wrap=True
        )
        return REFUSED
    except KeyboardInterrupt:
        print(f"\n{interrupted}")
        return INTERRUPTED
