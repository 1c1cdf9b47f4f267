"""Files are whole or absent, whatever fails; damaged ones are kept under another name."""

import json
import os
from pathlib import Path

import pytest

from jaxsimp.records.files import set_aside, whole_file, write_json, write_text


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_file_is_never_written_under_its_own_name(tmp_path):
    # A kill in the middle of a write finds another name there; its suffix tells the format.
    (tmp_path / "a.png").write_text("old")
    with whole_file(tmp_path / "a.png") as part:
        part.write_text("half")
        assert part.name == "a.png"
        assert (tmp_path / "a.png").read_text() == "old"
    assert (tmp_path / "a.png").read_text() == "half"
    assert names(tmp_path) == ["a.png"]


@pytest.mark.parametrize("failing", ["write", "fsync"])
def test_a_full_disk_leaves_the_old_file_and_names_it(tmp_path, monkeypatch, failing):
    path = tmp_path / "summary.json"
    write_json(path, {"old": 1})

    def full(*_):
        raise OSError(28, "No space left on device")

    def half(self, text, **_):
        with self.open("w") as file:
            file.write(text[: len(text) // 2])
        full()

    if failing == "write":
        monkeypatch.setattr(Path, "write_text", half)
    else:
        monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left on device") as raised:
        write_json(path, {"new": 2})
    assert raised.value.filename == str(path)
    assert json.loads(path.read_text()) == {"old": 1}
    assert names(tmp_path) == ["summary.json"]


def test_an_error_in_between_leaves_the_old_file(tmp_path):
    write_text(tmp_path / "a", "old")

    def interrupted():
        with whole_file(tmp_path / "a") as part:
            part.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert (tmp_path / "a").read_text() == "old"
    assert names(tmp_path) == ["a"]


def test_json_that_cannot_be_written_leaves_the_old(tmp_path):
    path = tmp_path / "summary.json"
    write_json(path, {"old": 1})
    with pytest.raises(TypeError):
        write_json(path, {"new": object()})
    assert json.loads(path.read_text()) == {"old": 1}


def test_a_folder_that_has_vanished_is_named(tmp_path):
    with pytest.raises(FileNotFoundError) as raised:
        write_text(tmp_path / "gone" / "a", "new")
    assert raised.value.filename == str(tmp_path / "gone" / "a")


def test_damaged_files_are_kept_under_numbers_that_are_free(tmp_path):
    for number, text in enumerate(["first", "second"], 1):
        (tmp_path / "a.json").write_text(text)
        assert set_aside(tmp_path / "a.json") == tmp_path / f"a.json.damaged-{number}"
    kept = {name: (tmp_path / name).read_text() for name in names(tmp_path)}
    assert kept == {"a.json": "second", "a.json.damaged-1": "first", "a.json.damaged-2": "second"}
