"""Kill studies at random moments: `python -m tests.kill --kills 100 --seed 0`."""

import shutil
import signal
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from tests.kill.campaign import STUDIES, campaign, content, differences, finish, together


@dataclass(frozen=True)
class Options:
    """Studies killed at random moments and resumed: nothing is lost, and nothing differs.

    Rows (without seconds), plans and figures (bit for bit) and reports (without seconds) are
    compared with those of an undisturbed run.
    """

    kills: int = 100
    """Number of kills of all studies together."""
    seed: int = 0
    """Seed of the moments."""
    studies: tuple[str, ...] = tuple(STUDIES)
    """Studies to kill."""
    signals: tuple[Literal["KILL", "TERM", "INT", "HUP"], ...] = ("KILL",)
    """Signals to end a study with, drawn at random."""
    together: tuple[int, ...] = (2, 4)
    """Numbers of processes to start at once in one folder, after the kills."""


def main() -> int:
    """Run the campaign; the exit status is 1 if something was lost or differs."""
    options, began = tyro.cli(Options), time.perf_counter()
    work = Path(tempfile.mkdtemp(prefix="jaxsimp-kill-"))
    endings = tuple(signal.Signals[f"SIG{name}"] for name in options.signals)
    tally = campaign(options.studies, options.kills, options.seed, work, endings, _tell)
    for number in options.together:
        tally.faults += _together(options.studies[0], number, work)
    _tell(f"kills: {dict(tally.kills)}")
    _tell(f"where: {dict(tally.stages)}")
    _tell(
        f"{sum(tally.kills.values())} kills in {tally.folders} folders, "
        f"{len(tally.faults)} faults, {(time.perf_counter() - began) / 60:.0f} minutes"
    )
    for fault in tally.faults:
        _tell(f"FAULT {fault}")
    if tally.faults:
        _tell(f"everything is in {work}")
        return 1
    shutil.rmtree(work)
    return 0


def _together(name: str, number: int, work: Path) -> list[str]:
    """Faults of processes that are started at once in one folder."""
    programs, alone = work / name / "programs", work / f"alone-{number}"
    folder = work / f"together-{number}"
    finish(name, alone, programs)
    ended = together(name, number, folder, programs)
    done = [error for status, error in ended if status == 0]
    told = [error for status, error in ended if status == 2 and "is in use by process" in error]
    faults = [] if len(done) == 1 and len(told) == number - 1 else [f"together: {ended}"]
    different = differences(content(folder), content(alone))
    _tell(f"{name}: {number} at once; {len(done)} worked, {len(told)} said who does")
    return faults + [f"{folder}: {name} differs" for name in different]


def _tell(line: str) -> None:
    print(line, flush=True)


if __name__ == "__main__":
    sys.exit(main())
