"""The console command `jaxsimp`: its verbs, what it loads, and exit statuses."""

import dataclasses
import os
import signal
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


@pytest.mark.parametrize("error", [ValueError("[a]\n  b"), OSError("[a] b"), ImportError("[a] b")])
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


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (OSError(28, "No space left on device", "a/[b].npz"), "No space left on device: a/[b].npz"),
        (OSError(5, "Input/output error"), "Input/output error"),
        (OSError("encoder error"), "encoder error"),
    ],
)
def test_an_error_of_the_machine_is_one_line_and_says_how_to_go_on(error, told, capsys):
    def run():
        raise error

    assert exit_status(run, again="once that is cured, try again") == REFUSED
    assert capsys.readouterr().err == f"error: {told}; once that is cured, try again\n"


SLEEPING = """
import signal, sys, time
from jaxsimp.cli.status import exit_status
def run():
    try:
        print("started", flush=True)
        time.sleep(60)
    finally:
        {last}
{first}
sys.exit(exit_status(run, "stopped; go on with the same command"))
"""


def signalled(number, first="", last="print('put away', flush=True)", times=1):
    """Exit status, output and errors of a command that is sent a signal at work.

    Signals have their default meaning at its start, also where nohup runs the tests.
    """
    first = f"signal.signal(signal.SIGHUP, signal.SIG_DFL); {first}"
    with subprocess.Popen(
        [sys.executable, "-c", SLEEPING.format(first=first, last=last)],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        told = ""
        for _ in range(times):
            told += process.stdout.readline()
            process.send_signal(number)
        out, error = process.communicate()
    return process.returncode, told + out, error


@pytest.mark.parametrize("name", ["INT", "TERM", "HUP"])
def test_a_signal_ends_a_command_in_order(name):
    number = signal.Signals[f"SIG{name}"]
    told = "started\nput away\n\nstopped; go on with the same command\n"
    assert signalled(number) == (128 + number, told, "")


def test_a_second_signal_ends_a_command_at_once():
    last = "print('putting away', flush=True); time.sleep(60)"
    status, told, error = signalled(signal.SIGINT, last=last, times=2)
    assert (status, told, error) == (-signal.SIGINT, "started\nputting away\n", "")


def test_a_signal_that_is_ignored_stays_so():
    # As by nohup: the command goes on, here to the signal after it.
    first = "signal.signal(signal.SIGHUP, signal.SIG_IGN)"
    script = "signal.raise_signal(signal.SIGHUP); signal.raise_signal(signal.SIGTERM)"
    code = SLEEPING.format(first=first, last="pass").replace("time.sleep(60)", script)
    done = python("-c", code)
    assert (done.returncode, done.stderr) == (128 + signal.SIGTERM, "")


def test_handlers_of_signals_are_put_back():
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    during = []
    exit_status(lambda: during.append(signal.getsignal(signal.SIGTERM)) or 0)
    assert before == [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    assert during[0] not in before


@pytest.mark.parametrize("command", [("jaxsimp", "simplify", "a.npz"), ("experiments.run",)])
@pytest.mark.parametrize("name", ["INT", "TERM"])
def test_a_signal_during_the_imports_leaves_no_traceback(tmp_path, command, name):
    number = signal.Signals[f"SIG{name}"]
    (tmp_path / "tyro.py").write_text(f"import signal; signal.raise_signal({int(number)})\n")
    done = subprocess.run(
        [sys.executable, "-m", *command],
        env=os.environ | {"PYTHONPATH": f"{tmp_path}:{ROOT}"},
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stderr) == (128 + number, "")
    assert "interrupted" in done.stdout
