"""Run a study: `python -m experiments.run`. All options: `python -m experiments.run --help`."""

import sys
from typing import TYPE_CHECKING

from jaxsimp.cli.status import exit_status

if TYPE_CHECKING:
    from experiments.study import StudyOptions

STUDIES = {
    "paper": "PaperOptions",
    "goals": "GoalsOptions",
    "simplification": "SimplificationOptions",
    "transfer": "TransferOptions",
}
"""The class of options of each study, in the module of its name; the first study is the default.

It is imported when the study runs: the imports take seconds, in which a signal is told, too.
"""


def main() -> int:
    """Run the command line.

    Returns:
        The exit status: 0; 2 for a wrong request, or a folder or disk that cannot be used; 130
        for Ctrl-C, 143 for SIGTERM, 129 for SIGHUP.
    """
    resumed = "the same command resumes it"
    return exit_status(_run, f"interrupted; {resumed}", f"once that is cured, {resumed}")


def _run() -> int:
    name, arguments = _study(sys.argv[1:])
    import inspect
    from importlib import import_module

    import tyro
    from rich.console import Console

    from jaxsimp.xla_cache import keep_programs

    study: type[StudyOptions] = getattr(import_module(f"experiments.{name}"), STUDIES[name])
    options = tyro.cli(
        study,
        prog=f"python -m experiments.run {name}",
        args=arguments,
        description=f"{inspect.getdoc(study)}\n\nStudies: {', '.join(STUDIES)}.",
    )
    keep_programs()
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
