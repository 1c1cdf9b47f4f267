"""The console command `jaxsimp`: its verbs, what it loads, and exit statuses."""

import dataclasses
import os
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

import jaxsimp
from jaxsimp.cli import main as cli
from jaxsimp.cli.status import INTERRUPTED, REFUSED, exit_status

ROOT = Path(__file__).parents[2]


def python(*arguments):
    return subprocess.run(
        [sys.executable, *arguments],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )


def test_every_verb_is_a_module_with_options_that_run():
    for verb in cli.VERBS:
        options = import_module(f"jaxsimp.cli.{verb}").Options
        assert dataclasses.is_dataclass(options)
        assert callable(options.run)


def test_help_lists_every_verb_with_one_line(capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main(["--help"])
    assert ended.value.code == 0
    told = capsys.readouterr().out
    assert all(verb in told for verb in cli.VERBS)
    assert "--version" in told
    assert "positions" not in told  # of a goal's file, in the help of `simplify`


@pytest.mark.parametrize("verb", cli.VERBS)
def test_a_verb_has_help_of_its_own(verb, capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main([verb, "--help"])
    assert ended.value.code == 0
    told = capsys.readouterr().out
    assert f"usage: jaxsimp {verb}" in told
    described = " ".join(import_module(f"jaxsimp.cli.{verb}").Options.__doc__.split())
    assert described in " ".join(told.split())


def test_the_version_is_the_packages(capsys):
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"jaxsimp {jaxsimp.__version__}\n"


@pytest.mark.parametrize("arguments", [[], ["simplfy"], ["simplify", "--no-such-option"]])
def test_a_wrong_command_line_has_exit_status_2(arguments, capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main(arguments)
    assert ended.value.code == 2
    assert capsys.readouterr().out == ""


def test_help_loads_no_library_of_numbers():
    code = """
import sys
from jaxsimp.cli.main import main
try:
    main(["simplify", "--help"])
finally:
    print([name for name in ("jax", "numpy", "scipy", "matplotlib") if name in sys.modules])
"""
    assert python("-c", code).stdout.endswith("\n[]\n")


def test_the_package_runs_as_the_command():
    done = python("-m", "jaxsimp", "--version")
    assert (done.returncode, done.stdout) == (0, f"jaxsimp {jaxsimp.__version__}\n")
    done = python("-m", "jaxsimp", "simplify")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "error: no goal is given; name at least one file\n"


# --- exit statuses -------------------------------------------------------------------------------


@pytest.mark.parametrize("status", [0, 1])
def test_a_command_keeps_its_own_status(status, capsys):
    assert exit_status(lambda: status) == status
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize("error", [ValueError("[a]\n  b"), OSError("[a] b")])
def test_a_users_error_is_one_line_whatever_is_in_it(error, capsys):
    def run():
        raise error

    assert exit_status(run) == REFUSED == 2
    assert capsys.readouterr() == ("", "error: [a] b\n")


def test_an_error_of_ours_is_raised():
    def run():
        raise KeyError("ours")

    with pytest.raises(KeyError):
        exit_status(run)


def test_an_interrupted_command_says_so(capsys):
    def run():
        raise KeyboardInterrupt

    assert exit_status(run, "stopped; go on with the same command") == INTERRUPTED == 130
    assert capsys.readouterr().out == "\nstopped; go on with the same command\n"
