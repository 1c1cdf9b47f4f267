"""Commands: `jaxsimp simplify ...` and `python -m experiments.run ...`, in this process."""

import contextlib
import io
import sys
from collections.abc import Iterator
from typing import Any
from unittest.mock import patch

import numpy as np
from hypothesis import strategies as st

from jaxsimp import records
from jaxsimp.cli.main import main as jaxsimp_main
from tests.fuzz.core import Door, Parameter
from tests.fuzz.doors.goals import BODY_FILES, ODD, SURELY_WRONG, WHOLE
from tests.fuzz.files import FOLDER, FileCase, files
from tests.fuzz.valid import both

REFUSED = 2
ODD_NUMBERS = (
    "nan",
    "inf",
    "-inf",
    "-1",
    "0",
    "x",
    "",
    "1e300",
    "1e-300",
    "1j",
    "0x10",
    "2.5",
    "99999999999999999999",
    "1,5",
    "--",
    "٣",
)


class Opened(BaseException):
    """A study was accepted: its folder of results is open, and its runs would begin."""


def _captured(main: Any, arguments: list[str]) -> tuple[int, str, str]:
    """Status, standard output and standard error of a command."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            status = main(arguments)
        except SystemExit as stop:
            status = stop.code
        except Opened:
            status = 0
    return status, out.getvalue(), err.getvalue()


def _result(status: Any, out: str, err: str) -> tuple[int, str]:
    """A status of 0 or 1 with the output; a refusal as the error that it stands for."""
    assert status in (0, 1, REFUSED), f"the status is {status}"
    if status != REFUSED:
        assert "Traceback" not in err, "a traceback"
        return status, out
    if not err.startswith("error: "):
        assert err.strip() or out.strip(), "refused without a word"  # by the reader of options
        raise ValueError(f"--option: give {err}; {out}, or see --help")
    assert err.strip().count("\n") == 0, "a refusal of several lines"
    raise ValueError(err.removeprefix("error: ").strip())


def _simplify(goal: FileCase, body: FileCase | None = None, **options: Any) -> tuple[int, str]:
    arguments = ["simplify", str(goal.path())]
    for name, value in options.items():
        option = f"--{name.replace('_', '-')}"
        if value is True:
            arguments.append(option)
        elif isinstance(value, tuple):
            arguments += [option, *value]
        elif value is not None:
            arguments += [option, str(value)]
    if body is not None:
        arguments += ["--body", str(body.path())]
    return _result(*_captured(jaxsimp_main, arguments))


def _number_text(*good: str) -> Parameter:
    return Parameter(st.sampled_from(good), st.sampled_from(ODD_NUMBERS))


def _places(*good: str) -> Parameter:
    odd = (FOLDER, FOLDER / "no" / "x.png", FOLDER / "x.xyz", "", FOLDER / "fuzz.npz", "\0")
    return Parameter(
        st.sampled_from([FOLDER / name for name in good]), st.sampled_from([str(e) for e in odd])
    )


def _is_positive(text: Any, *, zero: bool = False) -> bool | None:
    try:
        value = float(text)
    except ValueError:
        return False
    return None if np.isfinite(value) and (value > 0 or (zero and value == 0)) else False


def _are_bounds(bounds: Any) -> bool | None:
    if bounds is None:
        return None
    try:
        values = [float(each) for each in bounds]
    except ValueError:
        return False
    return None if len(values) == 3 and not np.isnan(values).any() else False


def _is_simplify(
    goal: FileCase,
    body: Any = None,
    method: str = "robust",
    tolerance: str | None = None,
    lower: Any = None,
    max_stretch: str | None = None,
    **_: Any,
) -> bool | None:
    verdicts = [
        None if tolerance is None else _is_positive(tolerance),
        None if max_stretch is None else _is_positive(max_stretch, zero=True),
        _are_bounds(lower),
        None if method in ("robust", "paper", "meshlab") else False,
        False if goal.damage == "odd" and goal.source in SURELY_WRONG and body is None else None,
        False if goal.content is None or goal.damage in ("a folder", "empty", "noise") else None,
    ]
    is_plain = (
        not goal.damage
        and not _
        and all(each is None for each in (body, tolerance, lower, max_stretch))
    )
    return False if False in verdicts else (True if is_plain and method == "robust" else None)


def _check_printed(result: Any, goal: FileCase, **_: Any) -> None:
    status, out = result
    assert "key points" in out, "no table is printed"
    assert ("NO_FIT" in out or "INFEASIBLE" in out) == (status == 1), f"status {status}: {out}"


@contextlib.contextmanager
def _without_runs() -> Iterator[None]:
    """Studies end when their folder is open, before they begin to run."""
    real = records.open_folder

    def opened(*arguments: Any, **options: Any) -> Any:
        found = real(*arguments, **options)
        with found if hasattr(found, "__enter__") else contextlib.nullcontext():
            raise Opened

    with patch.object(records, "open_folder", opened):
        yield


def _run_study(arguments: list[str]) -> int:
    from experiments import run

    with patch.object(sys, "argv", ["run", *arguments]), _without_runs():
        return run.main()


def _study(study: str = "paper", **options: Any) -> tuple[int, str]:
    import shutil

    FOLDER.mkdir(exist_ok=True)
    out = FOLDER / "study"
    shutil.rmtree(out, ignore_errors=True)
    arguments = [study]
    for name, value in {"out": str(out), **options}.items():
        option = f"--{name.replace('_', '-')}"
        if value is True:
            arguments.append(option)
        elif isinstance(value, tuple):
            arguments += [option, *map(str, value)]
        else:
            arguments += [option, str(value)]
    return _result(*_captured(_run_study, arguments))


WHOLE_NUMBERS = (
    "seeds",
    "resolution",
    "num_iterations",
    "population",
    "num_actions",
    "initial_populations",
)
CHOICES = {
    "method": ("robust", "paper", "meshlab"),
    "planners": ("default", "without_descent", "without_reranking", "cem", "cem_24", "paper"),
    "returns": ("best", "mean"),
    "planning": ("nominal", "robust", "self_contact", "mixed"),
    "study": ("paper", "goals", "transfer"),
}
RANGES = {"elite_fraction": (1e-6, 1.0), "smoothing": (0.0, 1.0), "initial_spread": (1e-6, 1e3)}


def _is_study(**given: Any) -> bool | None:
    verdicts: list[bool | None] = [True]
    for name, value in given.items():
        if name in CHOICES:
            verdicts.append(value in CHOICES[name])
        elif name in WHOLE_NUMBERS:
            is_whole = str(value).isdigit()  # in any script, as Python reads them
            verdicts.append(is_whole and 1 <= int(value) < 2**31)
            verdicts.append(not (name == "resolution" and is_whole and int(value) < 5))
        elif name == "first_seed":
            is_seed = str(value).isdigit() and int(value) < 2**32
            verdicts.append(None if is_seed and int(value) > 2**31 else is_seed)
        elif name in RANGES:
            low, high = RANGES[name]
            number = _is_positive(value, zero=name == "smoothing")
            verdicts.append(number is not False and low <= float(value) <= high)
            verdicts.append(not (name == "smoothing" and number is None and float(value) >= 1))
        elif name == "tasks":
            verdicts.append(bool(value) and set(value) == {"rope_folding"})
            verdicts.append(None if len(value) > 1 else True)
        elif name == "out":
            verdicts.append(None if "\0" not in value else False)
        else:
            verdicts.append(None)
    return both(*verdicts)


def _choice_text(name: str) -> Parameter:
    return Parameter(st.sampled_from(CHOICES[name]), st.sampled_from(("unknown", "", "Robust")))


DOORS = (
    Door(
        "commands.simplify",
        _simplify,
        {
            "goal": files(WHOLE, ODD),
            "body": Parameter(
                st.just(None),
                files(BODY_FILES, ODD).hostile.map(
                    lambda case: FileCase(
                        f"body-{case.name}", case.content, case.damage, case.source
                    )
                ),
            ),
            "method": Parameter(
                st.sampled_from(("robust", "paper")), st.sampled_from(("unknown", "", "ROBUST"))
            ),
            "tolerance": _number_text("0.005", "0.02"),
            "lower": Parameter(
                st.just(("-1", "-1", "-inf")),
                st.tuples(*(st.sampled_from(ODD_NUMBERS),) * 3) | st.just(("1",)),
            ),
            "max_stretch": _number_text("0.05", "0"),
            "above_table": Parameter(st.booleans(), st.just(True)),
            "json": _places("found.json"),
            "figure": _places("found.png"),
        },
        _is_simplify,
        _check_printed,
        weight=8,
    ),
    Door(
        "commands.study",
        _study,
        {
            "study": Parameter(
                st.sampled_from(CHOICES["study"]), st.sampled_from(("unknown", "", "-x"))
            ),
            "tasks": Parameter(
                st.just(("rope_folding",)),
                st.sampled_from((("unknown",), (), ("rope_folding", ""), ("rope_folding",) * 2)),
            ),
            "seeds": _number_text("1", "3"),
            "resolution": _number_text("9", "11"),
            "num_iterations": _number_text("2"),
            "population": _number_text("16"),
            "initial_populations": _number_text("2"),
            "num_actions": _number_text("2"),
            "elite_fraction": _number_text("0.1", "1.0"),
            "smoothing": _number_text("0.1", "0.0"),
            "initial_spread": _number_text("0.7"),
            "method": _choice_text("method"),
            "planners": _choice_text("planners"),
            "first_seed": _number_text("1", "3"),
            "returns": _choice_text("returns"),
            "planning": _choice_text("planning"),
            "out": Parameter(
                st.just(str(FOLDER / "study")),
                st.sampled_from(("", "\0", "/proc/none", "x" * 5000, str(FOLDER / "fuzz.npz"))),
            ),
        },
        _is_study,
        weight=10,
    ),
)
