"""A study without numbers, killed at each of its operations on files, or on a full disk.

Run as a program, it forks for each kill. It prints, as JSON, the number of operations and the
faults: folders in which the study could not go on, or that differ from an undisturbed one.
"""

import json
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path

from jaxsimp.cli.status import exit_status
from jaxsimp.records.files import whole_file, write_json, write_text
from jaxsimp.records.folder import open_folder
from jaxsimp.records.rows import RowFile

SEEDS = range(3)
WATCHED = ("open", "os.rename", "os.remove", "os.rmdir", "os.mkdir", "os.truncate", "shutil.rmtree")


def study(folder: Path) -> int:
    """Rows, a plan each, a figure and a report, as the studies write them."""
    with open_folder(folder, {"seeds": len(SEEDS)}):
        rows = RowFile(folder / "runs.jsonl", ("seed",))
        rows.resume({}, mixed=True, fault=lambda row: _fault(folder, row))
        (folder / "plans").mkdir(exist_ok=True)
        for (seed,) in rows.left([(seed,) for seed in SEEDS]):
            with whole_file(folder / "plans" / f"{seed}.npz") as part:
                part.write_bytes(bytes(10_000))
            rows.append({"seed": seed, "plan": f"{seed}.npz"})
        write_json(folder / "summary.json", rows.in_order([(seed,) for seed in SEEDS]))
        write_text(folder / "report.md", "done\n")
    return 0


def _fault(folder: Path, row: dict) -> str | None:
    plan = folder / "plans" / row["plan"]
    return None if plan.exists() else f"{plan} is missing"


def content(folder: Path) -> dict[str, str]:
    """Text of the files by name, without the one that is locked."""
    files = [path for path in folder.rglob("*") if path.is_file() and path.name != ".lock"]
    return {path.relative_to(folder).as_posix(): path.read_bytes().decode() for path in files}


def kill_at(operation: int, folder: Path) -> None:
    """Kill this process before an operation on files of a folder, counted from 1."""
    left = [operation]

    def hook(event: str, arguments: tuple) -> None:
        if event in WATCHED and str(folder) in str(arguments[0]):
            left[0] -= 1
            if left[0] == 0:
                os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(hook)


def in_child(run: Callable[[], int]) -> int:
    """Run in a process of its own, and return how it ended, as `subprocess` tells it."""
    child = os.fork()
    if child == 0:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        os._exit(run())
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def killed(operation: int, folder: Path) -> int:
    """Run the study, killed before an operation."""
    return in_child(lambda: (kill_at(operation, folder), study(folder))[1])


def kill_everywhere(work: Path) -> tuple[int, list[str]]:
    """Number of operations of the study, and faults after a kill, or two, before each."""
    in_child(lambda: study(work / "undisturbed"))
    wanted, faults, operation = content(work / "undisturbed"), [], 1
    while True:
        folder = work / str(operation)
        if killed(operation, folder) == 0:
            return operation - 1, faults
        killed(1 + operation % 7, folder)  # while it resumes, too
        if in_child(lambda folder=folder: study(folder)) or content(folder) != wanted:
            faults.append(f"{operation}: {sorted(content(folder))}")
        operation += 1


def fill_everywhere(work: Path) -> tuple[int, list[str]]:
    """Sizes of a disk, in blocks, on which the study is full, and faults once there is room."""
    in_child(lambda: study(work / "undisturbed"))
    wanted, faults, blocks = content(work / "undisturbed"), [], 1
    while True:
        disk = work / f"disk-{blocks}"
        disk.mkdir()
        os.system(f"mount -t tmpfs -o size={4 * blocks}k tmpfs {disk}")
        try:
            folder = disk / "results"
            status = in_child(lambda folder=folder: exit_status(lambda: study(folder)))
            if status == 0:
                return blocks - 1, faults
            os.system(f"mount -o remount,size=1m {disk}")
            again = in_child(lambda folder=folder: study(folder))
            if status != 2 or again or content(folder) != wanted:
                faults.append(f"{blocks}: {status}, then {again}")
        finally:
            os.system(f"umount {disk}")
        blocks += 1


if __name__ == "__main__":
    how = {"kill": kill_everywhere, "fill": fill_everywhere}[sys.argv[1]]
    print(json.dumps(how(Path(sys.argv[2]))))
