"""Compiling on another core: when it is begun, that it is waited for, and ended."""

import subprocess
import sys

import jax
import pytest

from jaxsimp import compiling, machine
from jaxsimp.cli import beside


@pytest.fixture
def begun(monkeypatch):
    """Processes begun in place of the compilation, which take a while."""
    found, popen = [], subprocess.Popen

    def begin(command, **options):
        assert command[:2] == [sys.executable, "-c"]
        assert options["env"]["JAX_PLATFORMS"] == "cpu"
        found.append(popen([sys.executable, "-c", "import time; time.sleep(0.5)"]))
        return found[-1]

    monkeypatch.setattr(beside.subprocess, "Popen", begin)
    monkeypatch.setattr(compiling, "is_missing", lambda function: True)
    monkeypatch.setattr(machine, "num_cores", lambda: 2)
    return found


def test_it_is_waited_for(begun):
    with beside.contact_compiled_beside():
        assert begun[0].poll() is None
    assert begun[0].returncode == 0


def test_an_error_ends_it(begun):
    with pytest.raises(KeyboardInterrupt), beside.contact_compiled_beside():
        raise KeyboardInterrupt
    assert begun[0].returncode != 0


@pytest.mark.parametrize("reason", ["kept", "one core", "gpu"])
def test_it_is_not_begun_where_it_is_of_no_use(begun, reason, monkeypatch):
    if reason == "kept":
        monkeypatch.setattr(compiling, "is_missing", lambda function: False)
    if reason == "one core":
        monkeypatch.setattr(machine, "num_cores", lambda: 1)
    if reason == "gpu":
        monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    with beside.contact_compiled_beside():
        assert begun == []


def test_the_command_that_it_runs_makes_the_kernel_known():
    # In this process, where it was compiled before: the words name what there is.
    names = {}
    exec(beside.COMPILE.replace("; ", "\nfound = "), names)
    assert names["found"] is True
