"""The progress bar of studies and benchmarks."""

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)


def progress_bar(console: Console, *, remaining: bool = True) -> Progress:
    """A bar with its description, the number of steps done, and a time.

    Args:
        console: console that shows the bar.
        remaining: whether to show the remaining time instead of the elapsed time; the estimate
            assumes steps of similar duration.
    """
    time: ProgressColumn = TimeRemainingColumn() if remaining else TimeElapsedColumn()
    return Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), time, console=console
    )
