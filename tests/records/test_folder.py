"""Results folders: one configuration each, one process at a time, and what a kill leaves."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from jaxsimp.records import folder as module
from jaxsimp.records import lock as lock_module
from jaxsimp.records.folder import open_folder
from jaxsimp.records.lock import ResultsError, lock_folder

ROOT = Path(__file__).parents[2]
CONFIG = {"tasks": ("a", "b"), "seeds": 3, "quick": True, "settings": {"population": 8}}


def names(folder: Path) -> list[str]:
    """Names of the files in a folder, without the one that is locked."""
    return sorted(path.name for path in folder.iterdir() if path.name != ".lock")


def opened(folder: Path, config: dict = CONFIG) -> None:
    with open_folder(folder, config):
        pass


# --- folders -------------------------------------------------------------------------------------


def test_a_new_folder_is_made_and_opens_again_for_its_configuration(tmp_path):
    folder = tmp_path / "some" / "where"
    for _ in range(2):
        opened(folder)
        assert names(folder) == ["config.json"]
        assert json.loads((folder / "config.json").read_text()) == {**CONFIG, "tasks": ["a", "b"]}


def test_an_empty_folder_is_used(tmp_path):
    opened(tmp_path)
    assert names(tmp_path) == ["config.json"]


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"seeds": 4}, r"seeds differ \(seeds: 3 there, 4 now\)"),
        ({"settings": {"population": 9}}, "settings"),
        ({"new": 1}, r"new: None there, 1 now"),
    ],
)
def test_another_configuration_is_refused(tmp_path, changes, told):
    opened(tmp_path)
    before = (tmp_path / "config.json").read_text()
    with pytest.raises(ResultsError, match=f"{told}.* --out"):
        opened(tmp_path, {**CONFIG, **changes})
    assert names(tmp_path) == ["config.json"]
    assert (tmp_path / "config.json").read_text() == before


def test_a_file_in_place_of_the_folder_is_refused(tmp_path):
    (tmp_path / "taken").write_text("mine")
    with pytest.raises(ResultsError, match=r"taken is a file; give a folder with --out"):
        opened(tmp_path / "taken")
    assert (tmp_path / "taken").read_text() == "mine"


def test_a_folder_under_a_file_is_refused(tmp_path):
    (tmp_path / "taken").write_text("mine")
    with pytest.raises(ResultsError, match=r"cannot be written to .*Not a directory.* --out"):
        opened(tmp_path / "taken" / "results")
    assert names(tmp_path) == ["taken"]


def test_a_folder_that_cannot_be_written_to_is_refused(tmp_path, monkeypatch):
    # Not by permission bits, which bind no test that runs as root.
    def read_only(path, value):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(module, "write_json", read_only)
    with pytest.raises(ResultsError, match=r"cannot be written to \(Permission denied\).* --out"):
        opened(tmp_path)
    assert names(tmp_path) == []


def test_a_folder_of_something_else_is_refused(tmp_path):
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(ResultsError, match=r"holds files but no config\.json.* --out"):
        opened(tmp_path)
    assert names(tmp_path) == ["thesis.tex"]


@pytest.mark.parametrize("content", ["{", "[1, 2]", "", '"text"', "\x00\x01"])
def test_a_configuration_of_something_else_is_refused(tmp_path, content):
    (tmp_path / "config.json").write_text(content)
    told = r"config\.json is damaged, or not .*; put back a copy of the file, or .*--out"
    with pytest.raises(ResultsError, match=told):
        opened(tmp_path)
    assert (tmp_path / "config.json").read_text() == content


@pytest.mark.parametrize(
    "left", ["config.json.part", ".part-xyz/config.json", ".lock", ".holder.json"]
)
def test_what_a_kill_leaves_before_the_configuration_does_not_spoil_the_folder(tmp_path, left):
    (tmp_path / left).parent.mkdir(exist_ok=True)
    (tmp_path / left).write_text('{"ta')
    opened(tmp_path)
    assert names(tmp_path) == ["config.json"]
    assert json.loads((tmp_path / "config.json").read_text())["seeds"] == 3


def test_what_a_kill_leaves_of_files_being_written_is_removed(tmp_path):
    opened(tmp_path)
    for left in ("plans/.part-a/x.npz", "figures/.part-b/y.png", "summary.json.part"):
        (tmp_path / left).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / left).write_text("half")
    (tmp_path / "plans" / "x.npz").write_text("whole")
    opened(tmp_path)
    files = [path for path in tmp_path.rglob("*") if path.is_file() and path.name != ".lock"]
    assert sorted(path.name for path in files) == ["config.json", "x.npz"]
    assert not list(tmp_path.rglob(".part-*"))


def test_a_part_of_somebody_elses_is_not_taken_for_ours(tmp_path):
    (tmp_path / "thesis.part").write_text("mine")
    with pytest.raises(ResultsError, match="holds files but no config"):
        opened(tmp_path)
    assert names(tmp_path) == ["thesis.part"]


def test_the_configuration_is_written_once(tmp_path):
    opened(tmp_path)
    before = (tmp_path / "config.json").stat()
    opened(tmp_path)
    assert (tmp_path / "config.json").stat().st_ino == before.st_ino


# --- one process at a time ------------------------------------------------------------------------


def test_a_second_process_is_told_who_holds_the_folder(tmp_path, monkeypatch):
    monkeypatch.setattr(lock_module, "PATIENCE", 0.0)
    code = """
import sys
from pathlib import Path
from jaxsimp.records.lock import lock_folder
with lock_folder(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""
    command = [sys.executable, "-c", code, str(tmp_path)]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "LOGNAME": "somebody"}
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, env=environment, **pipes) as holder:
        assert holder.stdout.readline() == "held\n"
        told = (
            rf"in use by process {holder.pid} on {os.uname().nodename} of the user somebody, since "
            r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d\+00:00; wait until it has ended, or .*--out"
        )
        with pytest.raises(ResultsError, match=told):
            opened(tmp_path)
        holder.kill()
        holder.wait()
    opened(tmp_path)  # a kill frees the folder, and leaves the name of the holder behind
    assert names(tmp_path) == ["config.json"]


def test_the_holder_is_unknown_while_it_begins(tmp_path, monkeypatch):
    monkeypatch.setattr(lock_module, "PATIENCE", 0.0)
    with lock_folder(tmp_path):
        (tmp_path / ".holder.json").write_text("{")
        with pytest.raises(ResultsError, match="in use by another process; wait"):
            opened(tmp_path)


def test_a_user_without_a_name_holds_a_folder_too(tmp_path, monkeypatch):
    def nobody():
        raise KeyError("getpwuid(): uid not found: 12345")

    monkeypatch.setattr(lock_module.getpass, "getuser", nobody)
    with lock_folder(tmp_path):
        told = lock_module._holder(tmp_path)
        assert told.startswith(f"process {os.getpid()} on {os.uname().nodename}, since ")


def test_a_refused_process_leaves_the_holders_files(tmp_path, monkeypatch):
    monkeypatch.setattr(lock_module, "PATIENCE", 0.0)
    with open_folder(tmp_path, CONFIG):
        (tmp_path / ".part-a").mkdir()
        with pytest.raises(ResultsError, match="in use"):
            opened(tmp_path)
        assert names(tmp_path) == [".holder.json", ".part-a", "config.json"]


def test_a_folder_that_vanishes_meanwhile_is_no_further_error(tmp_path):
    def removed_at_work():
        with open_folder(tmp_path / "new", CONFIG):
            shutil.rmtree(tmp_path / "new")
            raise ValueError("mine")

    with pytest.raises(ValueError, match="mine"):
        removed_at_work()


def test_a_path_that_no_folder_can_have_is_refused():
    with pytest.raises(
        ValueError, match=r"can be no file \(.*embedded null.*\); give another folder"
    ):
        opened(Path("\0"))
