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
        console: where it is shown.
        remaining: whether the time is what is left, or what has passed: an estimate is of use
            where the steps take about as long.
    """
    time: ProgressColumn = TimeRemainingColumn() if remaining else TimeElapsedColumn()
    return Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), time, console=console
    )
