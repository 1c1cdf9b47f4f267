"""The console command `jaxsimp VERB ...`: finds the verb, reads its options and runs it."""

import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Any

import jaxsimp
from jaxsimp.cli.status import exit_status

VERBS = ("simplify", "plan")
"""Modules of `jaxsimp.cli` that are verbs."""
DESCRIPTION = """Plan how to grasp and move rope and cloth.

`jaxsimp VERB --help` shows the options of a verb, `jaxsimp --version` the version."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        arguments: arguments after the command's name; those of the process by default.

    Returns:
        The exit status: that of the verb, 2 for wrong input, 130 for Ctrl-C.
    """
    return exit_status(lambda: _run(arguments))


def _run(arguments: Sequence[str] | None) -> int:
    given = list(sys.argv[1:] if arguments is None else arguments)
    if given == ["--version"]:
        print(f"jaxsimp {jaxsimp.__version__}")
        return 0
    options = parse(given)
    from jaxsimp.xla_cache import keep_programs  # late, as JAX is

    keep_programs()
    return int(options.run())


def parse(arguments: Sequence[str]) -> Any:
    """The options of the verb that the command line names.

    Raises:
        SystemExit: if they are invalid (status 2), or request help (status 0).
    """
    import tyro  # late, as are the verbs: a signal meanwhile is told, too

    app = tyro.extras.SubcommandApp()
    named = bool(arguments) and arguments[0] in VERBS
    for verb in VERBS:
        options = import_module(f"jaxsimp.cli.{verb}").Options
        # The list of verbs shows only the first line of each description.
        told = None if named else (options.__doc__ or "").partition("\n")[0]
        app.command(options, name=verb, help=told)
    return app.cli(prog="jaxsimp", description=DESCRIPTION, args=arguments)
