"""Studies killed at random moments, and what they leave beside an undisturbed run's."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).parents[2]
PLANNING = (
    *("--seeds", "1", "--resolution", "9", "--num-actions", "1"),
    *("--planners", "cem_24", "--population", "4", "--num-iterations", "1"),
)
STUDIES = {
    "paper": (
        *("--tasks", "cloth_side_folding", "--pick-encodings", "categorical"),
        *PLANNING,
    ),
    "goals": ("--tasks", "rope_letter_m", *PLANNING),
    "simplification": ("--smoke", "--methods", "paper"),
    "transfer": ("--tasks", "rope_straightening", *PLANNING),
}
"""Each study at a size that takes seconds once its programs are compiled."""
TIMES = ("plan_seconds", "compile_seconds")
COLUMNS = ("seconds to plan", "compile seconds, all runs")
"""What differs from run to run: fields of rows, and columns of reports."""
ENDINGS = (signal.SIGKILL,)


def start(name: str, folder: Path, programs: Path) -> subprocess.Popen[str]:
    """Start a study, with a folder of its own for the programs that JAX compiles."""
    environment = os.environ | {
        "JAX_PLATFORMS": "cpu",
        "JAX_COMPILATION_CACHE_DIR": str(programs),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "0",
        "MPLBACKEND": "Agg",
    }
    return subprocess.Popen(
        [sys.executable, "-m", "experiments.run", name, *STUDIES[name], "--out", str(folder)],
        cwd=ROOT,
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=_heed_signals,
    )


def _heed_signals() -> None:
    """Undo what a shell does to commands in the background: they ignore Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def finish(name: str, folder: Path, programs: Path) -> float:
    """Run a study to its end, and return the seconds that it took.

    Raises:
        AssertionError: if it fails.
    """
    began = time.perf_counter()
    process = start(name, folder, programs)
    _, told = process.communicate()
    assert process.returncode == 0, f"{name} in {folder} ended with {process.returncode}: {told}"
    return time.perf_counter() - began


def content(folder: Path) -> dict[str, Any]:
    """What a finished study has left, by file, without the times in it."""
    found: dict[str, Any] = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_dir() or name == ".lock":
            continue
        if path.suffix == ".jsonl":
            rows = [untimed(json.loads(line)) for line in path.read_text().splitlines()]
            found[name] = sorted(rows, key=json.dumps)
        elif path.suffix == ".json":
            found[name] = untimed(json.loads(path.read_text()))
        elif path.suffix == ".md":
            found[name] = without_columns(path.read_text())
        else:
            found[name] = path.read_bytes()
    return found


def untimed(value: Any) -> Any:
    """JSON without the fields of times."""
    if isinstance(value, dict):
        return {name: untimed(each) for name, each in value.items() if name not in TIMES}
    return [untimed(each) for each in value] if isinstance(value, list) else value


def without_columns(report: str) -> list[str]:
    """Lines of a report, its tables without the columns of times."""
    lines, left_out = [], []
    for line in report.splitlines():
        if not line.startswith("|"):
            left_out = []
            lines.append(line)
            continue
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        left_out = left_out or [cells.index(name) for name in COLUMNS if name in cells]
        lines.append(" | ".join(c for i, c in enumerate(cells) if i not in left_out))
    return lines


def differences(found: dict[str, Any], wanted: dict[str, Any]) -> list[str]:
    """Names of files that differ, are missing, or should not be there."""
    return sorted(
        name for name in found.keys() | wanted.keys() if found.get(name) != wanted.get(name)
    )


def stage(folder: Path) -> str:
    """How far a study has come, by what is in its folder."""
    if not (folder / "config.json").exists():
        return "before the configuration"
    if (folder / "report.md").exists():
        return "report written"
    if (folder / "figures").exists():
        return "figures"
    if (folder / "summary.json").exists():
        return "summary"
    return "rows" if any(folder.glob("*.jsonl")) else "before the first row"


@dataclass
class Tally:
    """What a campaign has done."""

    kills: Counter[str] = field(default_factory=Counter)
    stages: Counter[str] = field(default_factory=Counter)
    folders: int = 0
    faults: list[str] = field(default_factory=list)


def campaign(
    names: tuple[str, ...],
    kills: int,
    seed: int,
    work: Path,
    endings: tuple[signal.Signals, ...] = ENDINGS,
    tell: Callable[[str], None] = print,
) -> Tally:
    """Kill studies at random moments, several times a folder, finish them, and compare.

    Half of the moments are uniform over the time that a whole run takes. The others are those of a
    change in the folder, drawn at random, and up to 10 ms later: in the middle of writing.

    Args:
        names: studies, of `STUDIES`.
        kills: number of kills of all studies together.
        seed: seed of the moments.
        work: a new folder for everything.
        endings: signals to end a study with, drawn at random.
        tell: prints a line.
    """
    rng, tally = np.random.default_rng(seed), Tally()
    for index, name in enumerate(names):
        share = kills * (index + 1) // len(names) - kills * index // len(names)
        programs, undisturbed = work / name / "programs", work / name / "undisturbed"
        tell(f"{name}: undisturbed, {finish(name, undisturbed, programs):.0f} s")
        wanted = content(undisturbed)
        shutil.rmtree(undisturbed)
        # The second run compiles nothing, as those that are killed, and must give the same bits.
        seconds = finish(name, undisturbed, programs)
        tell(f"{name}: again, without compiling, {seconds:.0f} s")
        _compare(tally, undisturbed, wanted, tell)
        while share > 0:
            folder = work / name / f"killed-{tally.folders}"
            tally.folders += 1
            for _ in range(min(share, int(rng.integers(1, 6)))):
                ending = endings[rng.integers(len(endings))]
                share -= _disturb(name, folder, programs, seconds, ending, rng, tally, tell)
            with _copied(programs) as own:
                try:
                    finish(name, folder, own)
                    _compare(tally, folder, wanted, tell)
                except (AssertionError, ValueError) as error:
                    tally.faults.append(str(error))
                    tell(f"FAULT {error}")
            tell(f"{name}: {folder.name} finished; {sum(tally.kills.values())} kills so far")
    return tally


def _compare(
    tally: Tally, folder: Path, wanted: dict[str, Any], tell: Callable[[str], None]
) -> None:
    different = differences(content(folder), wanted)
    if different:
        tally.faults.append(f"{folder}: {', '.join(different)} differ")
        tell(f"FAULT {tally.faults[-1]}")


@contextmanager
def _copied(programs: Path) -> Iterator[Path]:
    """A copy of the compiled programs: a kill may cut short what JAX adds to it."""
    own = Path(shutil.copytree(programs, programs.with_name("programs-own")))
    yield own
    shutil.rmtree(own)


def _disturb(
    name: str,
    folder: Path,
    programs: Path,
    seconds: float,
    ending: signal.Signals,
    rng: np.random.Generator,
    tally: Tally,
    tell: Callable[[str], None],
) -> bool:
    """Start a study and end it at a random moment; whether it had not ended before."""
    with _copied(programs) as own:
        began, by_change = time.perf_counter(), bool(rng.integers(2))
        moment, changes = rng.uniform(0.0, seconds), int(rng.integers(1, 40))
        process = start(name, folder, own)
        if by_change:
            _await_changes(process, folder, changes)
            time.sleep(rng.uniform(0.0, 0.01))
        else:
            while process.poll() is None and time.perf_counter() - began < moment:
                time.sleep(0.002)
        hit = process.poll() is None
        os.killpg(process.pid, ending) if hit else None
        _, told = process.communicate()
    if not hit or process.returncode == 0:
        return False  # it was done before
    tally.kills[f"{name}, {ending.name}"] += 1
    tally.stages[stage(folder)] += 1
    when = f"change {changes}" if by_change else f"{moment:.1f} s"
    tell(f"{name}: {folder.name}, {ending.name} at {when}: {stage(folder)}")
    in_order = process.returncode in (-ending, 128 + ending)
    if not in_order or re.search("Traceback|Exception ignored", told):
        tally.faults.append(f"{name}, {ending.name} at {when}: {process.returncode}, {told}")
        tell(f"FAULT {tally.faults[-1]}")
    return True


def _await_changes(process: subprocess.Popen[str], folder: Path, number: int) -> None:
    """Wait until the names or sizes of files in a folder have changed a number of times."""
    last, changes = _listing(folder), 0
    while process.poll() is None and changes < number:
        now = _listing(folder)
        changes, last = changes + (now != last), now
        time.sleep(0.001)


def _listing(folder: Path) -> list[tuple[str, int]]:
    found = []
    for parent, folders, files in os.walk(folder):  # passes over folders that have gone meanwhile
        for name in folders + files:
            with suppress(OSError):
                found.append((f"{parent}/{name}", os.stat(f"{parent}/{name}").st_size))
    return sorted(found)


def together(name: str, processes: int, folder: Path, programs: Path) -> list[tuple[int, str]]:
    """Exit status and error of processes that start a study at once in one folder."""
    started = [start(name, folder, programs) for _ in range(processes)]
    told = [process.communicate()[1] for process in started]
    return [(process.returncode, error) for process, error in zip(started, told, strict=True)]
