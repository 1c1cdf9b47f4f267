"""Common parts of studies: each is a dataclass of options with `run`, and a line in run.py."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import ClassVar, Protocol

from rich.console import Console


class StudyOptions(Protocol):
    """Options of a study, as `tyro` reads them from a command line.

    Attributes:
        NAME: name of the study on the command line, and of its folder of results.
    """

    NAME: ClassVar[str]

    def run(self, console: Console) -> None:
        """Run the parts missing from the folder of results, and write the report."""
        ...


def default_folder(name: str, smoke: bool) -> Path:
    """Default folder for the results of a study."""
    return Path("results") / (name + "-smoke" * smoke)


def teller(console: Console) -> Callable[[str], None]:
    """A function that prints a line as it is, whatever is in it."""
    return lambda line: console.print(line, markup=False, highlight=False, soft_wrap=True)


def told_done(console: Console, folder: Path, start: float) -> None:
    """Print the path of the report, and the time since `start`."""
    minutes = (time.perf_counter() - start) / 60
    console.print(f"done in {minutes:.1f} minutes: {folder}/report.md")
