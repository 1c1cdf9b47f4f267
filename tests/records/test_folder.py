"""Results folders: one configuration each, and JSON files that are whole."""

import json
from pathlib import Path

import pytest

from jaxsimp.records import folder as module
from jaxsimp.records.folder import ResultsError, open_folder, write_json

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

    monkeypatch.setattr(module, "write_json", read_only)
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
