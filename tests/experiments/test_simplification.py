"""The study of simplification: its cases, what it leaves behind, and that it goes on."""

import json
import sys
from collections import Counter

import pytest

from experiments import run, simplification, simplification_report
from experiments.ideal_goals import FOLDS, LINES, NOISES
from experiments.settled_goals import SETTLED_FOLDS
from experiments.simplification import CLOTH_LEVELS, ROPE_LEVELS, ROWS_FILE, SimplificationStudy


def study(**changes):
    fields = {
        "methods": ("robust",),
        "first_seed": 0,
        "seeds": 12,
        "rope_sizes": (41,),
        "cloth_sizes": (25, 64),
        "settled_size": 13,
    }
    return SimplificationStudy(**(fields | changes))


def command(*options):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["experiments.run", "simplification", *map(str, options)])
        return run.main()


def test_cases_go_through_every_kind_and_level_of_noise():
    cases = list(study().cases())
    assert len(cases) == len(set(cases))
    by_kind = Counter((case.kind, case.noise, case.level) for case in cases)
    for kind, levels in (("rope", ROPE_LEVELS), ("cloth", CLOTH_LEVELS)):
        assert {key[1:] for key in by_kind if key[0] == kind} == {
            (noise, level) for noise in NOISES for level in levels
        }
    cloths = [case for case in cases if case.kind == "cloth"]
    assert {case.size for case in cloths} == {25, 64}
    assert {case.rounding for case in cloths} == {0.0, 0.004}
    assert 0 <= min(case.gap for case in cloths) < 0.001
    assert 0.009 < max(case.gap for case in cloths) <= 0.01
    assert Counter(case.kind for case in cases) == {
        "rope": 12 * len(LINES),
        "cloth": 2 * 12 * len(FOLDS),
        "settled": 12 * len(SETTLED_FOLDS),
    }


def test_a_case_is_the_same_goal_every_time():
    case = next(case for case in study().cases() if case.kind == "cloth" and case.seed == 3)
    assert (case.make().goal == case.make().goal).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--methods", "best"), "unknown method 'best'; choose from robust, paper"),
        (("--seeds", "0"), "seeds is 0; give a whole number"),
    ],
)
def test_wrong_values_are_named_and_nothing_is_written(options, message, tmp_path, capsys):
    assert command(*options, "--out", tmp_path / "new") == 2
    assert message in " ".join(capsys.readouterr().err.split())
    assert not list(tmp_path.iterdir())


def test_an_unknown_study_is_named_with_the_choices(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["experiments.run", "other"])
    assert run.main() == 2
    assert "unknown study 'other'; choose from paper, goals, simplification" in " ".join(
        capsys.readouterr().err.split()
    )


@pytest.mark.slow
@pytest.mark.long
def test_a_study_leaves_a_report_and_goes_on_after_a_kill(tmp_path, monkeypatch, figures_saved):
    folder = tmp_path / "results"
    options = ("--smoke", "--methods", "robust", "paper", "--out", folder)
    with figures_saved() as figures:
        assert command(*options) == 0
    summary = json.loads((folder / "summary.json").read_text())
    rows = summary["goals"]
    count = len(LINES) + len(FOLDS) + len(SETTLED_FOLDS)
    assert Counter(row["method"] for row in rows) == {"robust": count, "paper": count}
    robust = [row for row in rows if row["method"] == "robust"]
    assert sum(row["right"] for row in robust) >= 0.9 * count
    report = (folder / "report.md").read_text()
    for name in ("rates", "goals", "errors", "models_robust", "models_paper"):
        assert f"figures/{name}.png" in report
        assert (folder / "figures" / f"{name}.png").exists()
    (goals,) = figures["goals.png"].axes
    assert [label.get_text() for label in goals.get_yticklabels()] == ["robust", "paper"]
    ideal = [row for row in rows if row["kind"] != "settled" and row["right"]]
    right = Counter((row["method"], row["name"]) for row in ideal)
    names = [label.get_text() for label in goals.get_xticklabels()]
    assert set(names) == {*LINES, *FOLDS}
    # Each goal once: all or nothing of it is right.
    wanted = [100 * right[method, name] for method in ("robust", "paper") for name in names]
    assert [text.get_text() for text in goals.texts] == [f"{each}" for each in wanted]
    kinds = [axes.get_title() for axes in figures["rates.png"].axes]
    assert kinds == ["ropes, 1 m", "cloths, 0.3 m", "cloths settled in a simulation"]
    for method in ("robust", "paper"):
        titles = [axes.get_title() for axes in figures[f"models_{method}.png"].axes]
        assert len(titles) == len(simplification_report.SHOWN)
        for title, name in zip(titles, simplification_report.SHOWN, strict=True):
            assert title.startswith(f"{name}, ")
            assert title.endswith("key points")
    # Cut in the middle of a line, as by a kill: the rest is run again, and only that.
    lines = (folder / ROWS_FILE).read_text().splitlines(keepends=True)
    (folder / ROWS_FILE).write_text("".join(lines[:-3]) + lines[-3][:20])
    calls, again = [], {}
    plain = simplification.simplify_batch
    monkeypatch.setattr(
        simplification, "simplify_batch", lambda *a, **k: calls.append(1) or plain(*a, **k)
    )
    # Its report has been made once.
    monkeypatch.setattr(
        simplification_report, "write_report", lambda study, summary, folder: again.update(summary)
    )
    assert command(*options) == 0
    assert len(calls) == 3
    assert again["goals"] == rows
