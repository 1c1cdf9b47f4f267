"""Run a study: `python -m experiments.run`. All options: `python -m experiments.run --help`."""

import inspect
import sys

import tyro
from rich.console import Console

from experiments.goals import GoalsOptions
from experiments.paper import PaperOptions
from experiments.simplification import SimplificationOptions
from experiments.study import StudyOptions
from experiments.transfer import TransferOptions
from jaxsimp.cli.status import exit_status

STUDIES: dict[str, type[StudyOptions]] = {
    options.NAME: options
    for options in (PaperOptions, GoalsOptions, SimplificationOptions, TransferOptions)
}
"""Options of the studies by name; the first study is the default."""


def main() -> int:
    """Run the command line; the exit status is 0, 2 for a wrong request, 130 for Ctrl-C."""
    return exit_status(_run, "interrupted; the same command resumes it")


def _run() -> int:
    name, arguments = _study(sys.argv[1:])
    options = tyro.cli(
        STUDIES[name],
        prog=f"python -m experiments.run {name}",
        args=arguments,
        description=f"{inspect.getdoc(STUDIES[name])}\n\nStudies: {', '.join(STUDIES)}.",
    )
    options.run(Console())
    return 0


def _study(arguments: list[str]) -> tuple[str, list[str]]:
    """The name of the study, from the first argument if given, and the other arguments."""
    if not arguments or arguments[0].startswith("-"):
        return next(iter(STUDIES)), arguments
    name, *others = arguments
    if name not in STUDIES:
        raise ValueError(f"unknown study {name!r}; choose from {', '.join(STUDIES)}")
    return name, others


if __name__ == "__main__":
    sys.exit(main())
