"""Provenance: versions, commit and machine of a result."""

import importlib.metadata
import json
import os
import platform
import subprocess
from pathlib import Path

from jaxsimp.records import provenance
from jaxsimp.records.provenance import environment


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
    monkeypatch.setattr(provenance, "__file__", str(module))
    commit = environment()["commit"]
    assert len(commit) == 40
    assert set(commit) <= set("0123456789abcdef")
    module.write_text("changed = True")
    assert environment()["commit"] == commit + "+changes"


def test_code_outside_a_repository_has_no_commit(tmp_path, monkeypatch):
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path.parent))
    monkeypatch.setattr(provenance, "__file__", str(tmp_path / "records.py"))
    assert environment()["commit"] == "unknown"


def test_git_that_is_missing_is_no_error(monkeypatch):
    monkeypatch.setenv("PATH", "")
    assert environment()["commit"] == "unknown"
