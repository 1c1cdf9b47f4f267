"""Kills and full disks, at each operation on files of a short study.

The studies themselves are killed at random moments by `python -m tests.kill`, which takes long.
"""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.kill.campaign import differences, stage, untimed, without_columns

ROOT = Path(__file__).parents[2]


def short_study(how: str, folder: Path) -> tuple[int, list[str]]:
    done = subprocess.run(
        [sys.executable, "-m", "tests.kill.short_study", how, str(folder)],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def can_mount(folder: Path) -> bool:
    mount = ["mount", "-t", "tmpfs", "tmpfs", str(folder)]
    try:
        done = subprocess.run(mount, capture_output=True)
    except OSError:
        return False
    return done.returncode == 0 and subprocess.run(["umount", str(folder)]).returncode == 0


def test_a_study_goes_on_after_a_kill_at_any_of_its_operations(tmp_path):
    operations, faults = short_study("kill", tmp_path)
    assert operations > 40
    assert faults == []


def test_a_study_goes_on_after_a_full_disk_of_any_size(tmp_path):
    if not can_mount(tmp_path):
        pytest.skip("needs the right to mount a file system")
    sizes, faults = short_study("fill", tmp_path)
    assert sizes > 8
    assert faults == []


# --- what the campaign compares ------------------------------------------------------------------


def test_times_are_left_out_and_nothing_else():
    rows = [{"plan_seconds": 1.0, "score": 0.5, "config": {"compile_seconds": 2.0, "size": 3}}]
    assert untimed(rows) == [{"score": 0.5, "config": {"size": 3}}]
    report = [
        "words, 3 seconds",
        "| task | seconds to plan | score |",
        "| --- | --- | --- |",
        "| a | 1.0 | 0.5 |",
        "",
        "| seconds | b |",
    ]
    assert without_columns("\n".join(report)) == [
        *("words, 3 seconds", "task | score", "--- | ---", "a | 0.5"),
        *("", "seconds | b"),
    ]


def test_a_file_more_or_less_or_other_differs():
    wanted = {"a": 1, "b": 2, "c": 3}
    assert differences({"a": 1, "b": 0, "d": 4}, wanted) == ["b", "c", "d"]
    assert differences(dict(wanted), wanted) == []


def test_the_stage_of_a_study_is_what_is_in_its_folder(tmp_path):
    found = [stage(tmp_path / "none")]
    for name in ("config.json", "runs.jsonl", "summary.json", "figures", "report.md"):
        (tmp_path / name).touch()
        found.append(stage(tmp_path))
    assert found == [
        *("before the configuration", "before the first row", "rows", "summary", "figures"),
        "report written",
    ]
