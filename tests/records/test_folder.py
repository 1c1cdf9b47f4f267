"""Results folders: one configuration each, rows that survive a kill, provenance."""

import importlib.metadata
import json
import os
import platform
import subprocess
from pathlib import Path

import pytest

from jaxsimp.records import folder as records
from jaxsimp.records.folder import ResultsError, append_row, open_folder, read_rows, write_json

CONFIG = {"tasks": ("a", "b"), "seeds": 3, "quick": True, "settings": {"population": 8}}


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


# --- folders -------------------------------------------------------------------------------------


def test_a_new_folder_is_made_and_opens_again_for_its_configuration(tmp_path):
    folder = tmp_path / "some" / "where"
    for _ in range(2):
        open_folder(folder, CONFIG)
        assert names(folder) == ["config.json"]
        assert json.loads((folder / "config.json").read_text()) == {**CONFIG, "tasks": ["a", "b"]}


def test_an_empty_folder_is_used(tmp_path):
    open_folder(tmp_path, CONFIG)
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
    open_folder(tmp_path, CONFIG)
    before = (tmp_path / "config.json").read_text()
    with pytest.raises(ResultsError, match=f"{told}.* --out"):
        open_folder(tmp_path, {**CONFIG, **changes})
    assert names(tmp_path) == ["config.json"]
    assert (tmp_path / "config.json").read_text() == before


def test_a_file_in_place_of_the_folder_is_refused(tmp_path):
    (tmp_path / "taken").write_text("mine")
    with pytest.raises(ResultsError, match=r"taken is a file; give a folder with --out"):
        open_folder(tmp_path / "taken", CONFIG)
    assert (tmp_path / "taken").read_text() == "mine"


def test_a_folder_under_a_file_is_refused(tmp_path):
    (tmp_path / "taken").write_text("mine")
    with pytest.raises(ResultsError, match=r"cannot be written to .*Not a directory.* --out"):
        open_folder(tmp_path / "taken" / "results", CONFIG)
    assert names(tmp_path) == ["taken"]


def test_a_folder_that_cannot_be_written_to_is_refused(tmp_path, monkeypatch):
    # Not by permission bits, which bind no test that runs as root.
    def read_only(path, value):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(records, "write_json", read_only)
    with pytest.raises(ResultsError, match=r"cannot be written to \(Permission denied\).* --out"):
        open_folder(tmp_path, CONFIG)
    assert names(tmp_path) == []


def test_a_folder_of_something_else_is_refused(tmp_path):
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(ResultsError, match=r"holds files but no config\.json.* --out"):
        open_folder(tmp_path, CONFIG)
    assert names(tmp_path) == ["thesis.tex"]


@pytest.mark.parametrize("content", ["{", "[1, 2]", "", '"text"', "\x00\x01"])
def test_a_configuration_of_something_else_is_refused(tmp_path, content):
    (tmp_path / "config.json").write_text(content)
    with pytest.raises(ResultsError, match=r"config\.json .*--out"):
        open_folder(tmp_path, CONFIG)
    assert (tmp_path / "config.json").read_text() == content


# --- files ---------------------------------------------------------------------------------------


def test_json_is_written_whole_or_not_at_all(tmp_path, monkeypatch):
    path = tmp_path / "summary.json"
    write_json(path, {"old": 1})

    def full(self, text):
        with self.open("w") as file:
            file.write(text[: len(text) // 2])
        raise OSError("no space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(OSError, match="no space"):
        write_json(path, {"new": 2})
    assert json.loads(path.read_text()) == {"old": 1}


def test_json_is_never_written_under_its_own_name(tmp_path, monkeypatch):
    # A kill in the middle of a write finds another name there.
    written, write_text = [], Path.write_text
    monkeypatch.setattr(
        Path, "write_text", lambda self, text: written.append(self) or write_text(self, text)
    )
    write_json(tmp_path / "summary.json", {"new": 2})
    assert written
    assert tmp_path / "summary.json" not in written
    assert names(tmp_path) == ["summary.json"]


def test_json_that_cannot_be_written_leaves_the_old(tmp_path):
    path = tmp_path / "summary.json"
    write_json(path, {"old": 1})
    with pytest.raises(TypeError):
        write_json(path, {"new": object()})
    assert json.loads(path.read_text()) == {"old": 1}


ROWS = [{"seed": 0, "name": "ü\u2028 \n"}, {"seed": 1, "cost": None}, {"seed": 2}]


def test_rows_come_back_in_order(tmp_path):
    path = tmp_path / "runs.jsonl"
    assert read_rows(path) == []
    for row in ROWS:
        append_row(path, row)
    assert read_rows(path) == ROWS
    assert len(path.read_text().split("\n")) == len(ROWS) + 1


def test_a_row_cut_short_at_any_byte_is_dropped_and_the_file_can_be_continued(tmp_path):
    path = tmp_path / "runs.jsonl"
    for row in ROWS:
        append_row(path, row)
    whole = path.read_bytes()
    ends = [0, *(i + 1 for i, byte in enumerate(whole) if byte == ord("\n"))]
    for size in range(len(whole) + 1):
        path.write_bytes(whole[:size])
        complete = sum(end <= size for end in ends) - 1
        assert read_rows(path) == ROWS[:complete]
        assert path.stat().st_size == ends[complete]
        append_row(path, {"more": 1})
        assert read_rows(path) == [*ROWS[:complete], {"more": 1}]


# --- provenance ----------------------------------------------------------------------------------


def test_environment_says_what_results_depend_on():
    found = records.environment()
    assert json.loads(json.dumps(found)) == found
    assert found["python"] == platform.python_version()
    for name in ("jax", "numpy", "scipy", "proxsuite"):
        assert found["versions"][name] == importlib.metadata.version(name)
    assert found["cores"] == len(os.sched_getaffinity(0))
    assert found["device"] == "cpu"
    assert found["num_devices"] == 1
    assert found["x64"] is False
    assert found["processor"]
    assert found["platform"] == platform.platform()


def test_environment_says_when_results_are_in_float64(x64):
    assert records.environment()["x64"] is True


def repository(folder: Path) -> Path:
    """A package of one module in a git repository with one commit."""
    module = folder / "experiments" / "records.py"
    module.parent.mkdir()
    module.write_text("")
    git = ["git", "-C", str(folder), "-c", "user.name=n", "-c", "user.email=e@x"]
    subprocess.run([*git, "init", "-q"], check=True)
    subprocess.run([*git, "add", "."], check=True)
    subprocess.run([*git, "commit", "-q", "--no-verify", "-m", "first"], check=True)
    return module


def test_the_commit_is_named_and_changes_are_marked(tmp_path, monkeypatch):
    module = repository(tmp_path)
    monkeypatch.setattr(records, "__file__", str(module))
    commit = records.environment()["commit"]
    assert len(commit) == 40
    assert set(commit) <= set("0123456789abcdef")
    module.write_text("changed = True")
    assert records.environment()["commit"] == commit + "+changes"


def test_code_outside_a_repository_has_no_commit(tmp_path, monkeypatch):
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path.parent))
    monkeypatch.setattr(records, "__file__", str(tmp_path / "records.py"))
    assert records.environment()["commit"] == "unknown"


def test_git_that_is_missing_is_no_error(monkeypatch):
    monkeypatch.setenv("PATH", "")
    assert records.environment()["commit"] == "unknown"
