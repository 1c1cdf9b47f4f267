"""The README and the pages of docs/: their Python runs, and their commands can be read.

Python blocks of a page run in one namespace, from top to bottom, as they stand. So that this does
not take minutes, tasks and searches are made at a small scale (`SMALL`). Commands are not run:
their options are read by the parsers of the commands.
"""

import importlib.util
import re
import shlex
import sys
from functools import partial
from pathlib import Path

import jax
import pytest
import tyro

import jaxsimp
import jaxsimp.planning
import jaxsimp.tasks
from jaxsimp.tasks import registry

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
SMALL = {
    "make_task": {"quick": True},
    "CEM": {"population": 16},
    "plan": {"search": "cem"},
}
"""Functions of the face that blocks call at another size than the reader: arguments by default."""


def blocks(page: Path, *languages: str) -> list[tuple[int, str]]:
    """The fenced blocks of a page in these languages: first line of the code, and the code."""
    text = page.read_text()
    return [
        (text.count("\n", 0, found.start(2)) + 1, found[2])
        for found in FENCE.finditer(text)
        if found[1] in languages
    ]


def commands(page: Path) -> list[tuple[int, list[str]]]:
    """Commands of ours in the console blocks of a page: line, and words from the program on.

    The program is "jaxsimp", or the module of `python -m` where that is ours.
    """
    found = []
    for first, text in blocks(page, "", "sh", "console", "bash"):
        lines = text.replace("\\\n", "  ").splitlines()
        for number, line in enumerate(lines, start=first):
            for command in line.split("&&"):
                words = shlex.split(command.removeprefix("$ "), comments=True)
                program = Path(words[0]).name if words else ""
                if program == "jaxsimp":
                    found.append((number, ["jaxsimp", *words[1:]]))
                elif program.startswith("python") and words[1] == "-m":
                    found.append((number, words[2:]))
    ours = re.compile(r"(jaxsimp|experiments)(\.|$)")
    return [(number, words) for number, words in found if ours.match(words[0])]


class Read(BaseException):
    """Raised in place of running a command whose options could be read."""


def read(words: list[str], monkeypatch) -> None:
    """Read a command's options as the command does, and end there.

    Raises:
        Read: if the command understands them.
        SystemExit: if it does not.
    """
    parse = tyro.cli

    def read_only(*arguments, **options):
        raise Read(parse(*arguments, **options))

    program, *options = words
    spec = importlib.util.find_spec(program)
    assert spec is not None, f"there is no module {program}"
    name = program if spec.submodule_search_locations is None else f"{program}.__main__"
    monkeypatch.setattr(tyro, "cli", read_only)
    monkeypatch.setattr(sys, "argv", [program, *options])
    importlib.import_module(name).main()


CODE = [page for page in PAGES if blocks(page, "python")]
COMMANDS = [(page, *command) for page in PAGES for command in commands(page)]


def place(value: object) -> str:
    return str(value.relative_to(ROOT)) if isinstance(value, Path) else str(value)


def test_there_are_blocks_of_both_kinds():
    assert PAGES[0] in CODE
    assert {words[0] for _, _, words in COMMANDS} >= {"jaxsimp", "experiments.run"}


@pytest.mark.slow  # they plan, and calibrate
@pytest.mark.parametrize("page", CODE, ids=place)
def test_python_blocks_run(page, monkeypatch, tmp_path):
    for name, options in SMALL.items():
        small = partial(getattr(jaxsimp, name), **options)
        for module in (jaxsimp, jaxsimp.planning, jaxsimp.tasks):
            if hasattr(module, name):
                monkeypatch.setattr(module, name, small)
    monkeypatch.chdir(tmp_path)  # for files that they write
    monkeypatch.setattr(registry, "_REGISTRY", dict(registry._REGISTRY))  # for their tasks
    namespace = {"__name__": "__main__"}
    with jax.numpy_rank_promotion("allow"):  # as readers have it
        for line, code in blocks(page, "python"):
            # Empty lines first, so that a traceback has the line of the page.
            exec(compile("\n" * (line - 1) + code, str(page), "exec"), namespace)


@pytest.mark.parametrize(
    ("page", "line", "words"), COMMANDS, ids=[f"{place(page)}:{line}" for page, line, _ in COMMANDS]
)
def test_the_options_of_a_command_are_its_own(page, line, words, monkeypatch):
    with pytest.raises(Read):
        read(words, monkeypatch)


@pytest.mark.parametrize(
    "words",
    [
        ["jaxsimp", "simplify", "goal.npz", "--no-such-option"],
        ["jaxsimp", "no-such-verb"],
        ["experiments.run", "paper", "--no-such-option"],
        ["experiments.benchmark", "--seeds", "3"],
        ["experiments.physics", "--out"],
    ],
)
def test_wrong_options_are_noticed(words, monkeypatch):
    with pytest.raises(SystemExit) as ended:
        read(words, monkeypatch)
    assert ended.value.code == 2
