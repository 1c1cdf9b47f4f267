"""Provenance: versions, commit and machine of a result."""

import importlib.metadata
import json
import os
import platform
import shutil
import subprocess
from pathlib import Path

import pytest

from jaxsimp.records import commit
from jaxsimp.records.commit import own_commit
from jaxsimp.records.provenance import environment

ROOT = Path(__file__).parents[2]


def test_environment_says_what_results_depend_on():
    found = environment()
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
    assert environment()["x64"] is True


def git(folder: Path, *command: str) -> str:
    """What git says in a folder, as nobody in particular."""
    asked = ["git", "-C", str(folder), "-c", "user.name=n", "-c", "user.email=e@x", *command]
    return subprocess.run(asked, check=True, capture_output=True, text=True).stdout.strip()


def commit_all(folder: Path) -> str:
    """Make a folder a repository with one commit, and name it."""
    git(folder, "init", "-q")
    git(folder, "add", ".")
    git(folder, "commit", "-q", "--no-verify", "-m", "first")
    return git(folder, "rev-parse", "HEAD")


@pytest.fixture
def clone(tmp_path) -> Path:
    """The files by which a clone of this project is known, not yet in a repository."""
    folder = tmp_path / "clone"
    for name in ("pyproject.toml", ".gitattributes", "jaxsimp/__init__.py"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, folder / name)
    (folder / commit.STAMP).parent.mkdir()
    (folder / commit.STAMP).write_text("$Format:%H$\n")
    return folder


def test_the_commit_is_that_of_this_code():
    assert environment()["commit"] == own_commit(ROOT)


def test_the_commit_of_a_clone_is_named_and_changes_are_marked(clone):
    head = commit_all(clone)
    assert len(head) == 40
    assert own_commit(clone) == head
    (clone / "jaxsimp" / "__init__.py").write_text("changed = True")
    assert own_commit(clone) == head + "+changes"


def test_a_folder_of_results_in_a_clone_is_no_change(clone):
    head = commit_all(clone)
    (clone / "my_results").mkdir()
    (clone / "my_results" / "runs.jsonl").write_text("{}")
    assert own_commit(clone) == head
    (clone / "jaxsimp" / "new.py").write_text("a = 1")
    assert own_commit(clone) == head + "+changes"


def test_the_commit_of_a_worktree_is_its_own(clone, tmp_path):
    commit_all(clone)
    git(clone, "worktree", "add", "-q", str(tmp_path / "worktree"))
    git(tmp_path / "worktree", "commit", "-q", "--allow-empty", "--no-verify", "-m", "second")
    head = git(tmp_path / "worktree", "rev-parse", "HEAD")
    assert head != own_commit(clone)
    assert own_commit(tmp_path / "worktree") == head


def test_an_archive_of_a_repository_has_its_commit(clone, tmp_path):
    head = commit_all(clone)
    git(clone, "archive", "--prefix=taken/", "-o", str(tmp_path / "it.tar"), "HEAD")
    shutil.unpack_archive(tmp_path / "it.tar", tmp_path, filter="data")
    assert own_commit(tmp_path / "taken") == head


def test_a_repository_around_the_code_is_not_asked(clone, tmp_path):
    shutil.copytree(clone, tmp_path / "copied")
    commit_all(tmp_path)
    assert own_commit(tmp_path / "copied") == "unknown"


def test_a_repository_that_holds_a_copy_of_the_package_is_not_asked(clone):
    (clone / "pyproject.toml").write_text('[project]\nname = "theirs"\n')
    commit_all(clone)
    assert own_commit(clone) == "unknown"
    (clone / "pyproject.toml").unlink()
    assert own_commit(clone) == "unknown"


def test_a_hook_of_another_repository_does_not_change_the_commit(clone, tmp_path, monkeypatch):
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "file").write_text("")
    head, _ = commit_all(clone), commit_all(tmp_path / "other")
    monkeypatch.setenv("GIT_DIR", str(tmp_path / "other" / ".git"))
    monkeypatch.setenv("GIT_WORK_TREE", str(tmp_path / "other"))
    monkeypatch.setenv("GIT_INDEX_FILE", str(tmp_path / "other" / ".git" / "index"))
    assert own_commit(clone) == head


def test_the_commit_of_a_clone_of_another_owner_is_named(clone, monkeypatch):
    head = commit_all(clone)
    monkeypatch.setenv("GIT_TEST_ASSUME_DIFFERENT_OWNER", "1")  # git's own tests use it
    with pytest.raises(subprocess.CalledProcessError):
        git(clone, "status")
    assert own_commit(clone) == head


def test_git_that_is_missing_or_finds_no_commit_is_no_error(clone, monkeypatch):
    git(clone, "init", "-q")
    assert own_commit(clone) == "unknown"  # there is no commit yet
    commit_all(clone)
    monkeypatch.setenv("PATH", "")
    assert own_commit(clone) == "unknown"


def test_what_was_stamped_counts(clone):
    commit_all(clone)
    for stamp in ("f" * 40, "f" * 40 + "+changes", "unknown"):
        (clone / commit.STAMP).write_text(stamp + "\n")
        assert own_commit(clone) == stamp
