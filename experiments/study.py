"""What studies share: each is a dataclass of options that runs itself, and a line in run.py."""

import time
from pathlib import Path
from typing import ClassVar, Protocol

from rich.console import Console


class StudyOptions(Protocol):
    """Options of a study, as `tyro` reads them from a command line.

    Attributes:
        NAME: of the study, on the command line and of its folder of results.
    """

    NAME: ClassVar[str]

    def run(self, console: Console) -> None:
        """Run what is not in the folder of results yet, and write the report."""
        ...


def default_folder(name: str, smoke: bool) -> Path:
    """Where the results of a study go unless it is told otherwise."""
    return Path("results") / (name + "-smoke" * smoke)


def told_done(console: Console, folder: Path, start: float) -> None:
    """Say where the report is, and how long the study took since `start`."""
    minutes = (time.perf_counter() - start) / 60
    console.print(f"done in {minutes:.1f} minutes: {folder}/report.md")
