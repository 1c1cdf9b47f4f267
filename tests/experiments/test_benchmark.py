"""The benchmark: its rows, its arithmetic, what it refuses, and that it catches a wrong engine."""

import dataclasses
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from experiments.benchmark import __main__ as command
from experiments.benchmark import checks, rollouts
from experiments.benchmark.figures import save_figures
from experiments.benchmark.measure import (
    COLUMNS,
    QUICK,
    fit_exponent,
    make_row,
    prepare,
    time_in_turns,
)
from experiments.benchmark.peers import ENGINES
from experiments.benchmark.peers.workload import UnavailableError

TINY = dataclasses.replace(
    QUICK,
    repeats=2,
    kinds=("rope",),
    rope=9,
    side=5,
    population=4,
    num_actions=1,
    action_steps=6,
    chunk_sizes=(1,),
    growth=(1, 2),
    sides=(5, 6),
    populations=(64, 128),
    horizons=(2, 4),
    cem_side=5,
    cem_iterations=2,
    goals=(3,),
    contact_sides=(5,),
)

# Most of the time here is compilation of code that then runs for a millisecond.


def run(*options: object) -> int:
    """What `python -m experiments.benchmark` does, without another process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["experiments.benchmark", *map(str, options)])
        patch.setattr(command, "QUICK", TINY)
        return command.main()


def only(*names: str) -> list[str]:
    return [word for name in names for word in ("--only", name)]


@pytest.fixture(scope="module")
def without_peers():
    """The engines that need no compiler of their own: the others take seconds to start."""
    with pytest.MonkeyPatch.context() as patch:
        patch.delitem(ENGINES, "taichi")
        patch.delitem(ENGINES, "warp")
        yield


Results = tuple[tuple[str, ...], Path, dict[str, Figure]]
"""Names of sections, where their results are, and their figures."""


@pytest.fixture(scope="module")
def measure(without_peers, tmp_path_factory, figures_saved):
    """A tiny run of some sections."""

    def measured(*names: str) -> Results:
        folder = tmp_path_factory.mktemp("results")
        options = ("--json", folder / "rows.json", "--figures", folder / "figures")
        with figures_saved() as figures:
            assert run("--quick", *only(*names), *options) == 0
        return names, folder, figures

    return measured


@pytest.fixture(scope="module")
def results(measure):
    return measure("rollout", "engines", "line_fit")


@pytest.fixture(scope="module")
def slow_results(measure):
    return measure("population", "cem", "scaling", "contact_population")


# --- rows -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "fixture", ["results", pytest.param("slow_results", marks=pytest.mark.slow)]
)
def test_rows_have_their_columns(fixture, request):
    names, folder, _ = request.getfixturevalue(fixture)
    written = json.loads((folder / "rows.json").read_text())
    assert written.keys() == {"environment", "rows"}
    assert written["environment"]["versions"]["jax"]
    rows = written["rows"]
    assert list(dict.fromkeys(row["section"] for row in rows)) == list(names)
    for row in rows:
        assert row.keys() > set(COLUMNS)
        assert isinstance(row["engine"], str)
        assert row["device"] == "cpu"
        for name in ("compile_seconds", "run_seconds", "particle_steps_per_second", "error"):
            assert row[name] is None or isinstance(row[name], float)
            assert row[name] is None or row[name] >= 0
        if row["section"] != "line_fit" and row["run_seconds"] is not None:
            assert row["particle_steps_per_second"] > 0
            assert row["population"] >= 1


def test_engines_have_errors_and_ratios(results):
    rows = of_section(results, "engines")
    assert [(row["engine"], row["layout"]) for row in rows] == [
        kind_and_layout[:2] for kind_and_layout in ENGINES.values()
    ]
    for row in rows:
        assert row["name"] == "population_rollout"
        if row["not_timed"] is None:
            assert row["error"] <= checks.TOLERANCE
            assert row["ratio_to_jaxsimp"] > 0
    assert rows[0]["engine"] == "jaxsimp"
    assert rows[0]["ratio_to_jaxsimp"] == 1


@pytest.mark.slow
def test_a_plan_reports_its_cores_and_its_score(slow_results):
    iteration, plan = of_section(slow_results, "cem")
    assert 0 < iteration["cpu_share"] <= 1.1  # clocks of two kinds
    assert plan["rollouts"] == 8
    assert plan["score"] <= 1
    # The same rate from times of different parts.
    assert plan["run_seconds"] > iteration["run_seconds"]


@pytest.mark.slow
def test_many_folds_are_compared_with_those_of_a_body_that_passes_through_itself(slow_results):
    without, touching = of_section(slow_results, "contact_population")
    assert without["population"] == touching["population"] == TINY.population
    assert without["ratio_to_without"] is None
    assert touching["ratio_to_without"] > 0


@pytest.mark.slow
def test_sweeps_change_one_size_each(slow_results):
    rows = of_section(slow_results, "scaling")
    work = [row["particle_steps"] for row in rows]
    assert len(rows) == 6
    assert [row["name"] for row in rows[::2]] == [
        f"scaling_{swept}" for swept in ("particles", "population", "horizon")
    ]
    assert work[1] / work[0] == pytest.approx(36 / 25)
    assert work[3] / work[2] == work[5] / work[4] == 2
    assert all(isinstance(row["exponent"], float) for row in rows)


def test_lines_are_fitted_right_by_every_backend(results):
    for row in of_section(results, "line_fit"):
        assert row["error"] < 1e-5  # float32, of metres


@pytest.mark.slow
def test_layouts_give_the_same_motion(slow_results):
    rows = of_section(slow_results, "population")
    assert len(rows) >= 2
    assert all(row["error"] <= checks.TOLERANCE for row in rows)


def of_section(results, name):
    rows = json.loads((results[1] / "rows.json").read_text())["rows"]
    return [row for row in rows if row["section"] == name]


def written(results) -> list[str]:
    return sorted(path.name for path in (results[1] / "figures").iterdir())


def test_engines_are_drawn_as_bars_of_their_speed(results):
    assert written(results) == ["engines.png"]
    (axes,) = results[2]["engines.png"].axes
    rows = [row for row in of_section(results, "engines") if row["run_seconds"]]
    rows.sort(key=lambda row: row["particle_steps_per_second"])
    speeds = [bar.get_width() for bar in axes.patches]
    assert speeds == pytest.approx([row["particle_steps_per_second"] / 1e6 for row in rows])
    assert "1 ×" in [text.get_text().strip() for text in axes.texts]
    names = [label.get_text().split("\n")[0] for label in axes.get_yticklabels()]
    assert names == [row["engine"].replace("_", " ") for row in rows]


@pytest.mark.slow
def test_layouts_and_sweeps_are_drawn_as_lines(slow_results):
    assert written(slow_results) == ["population.png", "scaling.png"]
    (layouts,), (scaling,) = (slow_results[2][name].axes for name in written(slow_results))
    rows = of_section(slow_results, "population")
    drawn = sorted(speed for line in layouts.lines for speed in line.get_ydata())
    wanted = sorted(row["particle_steps_per_second"] / 1e6 for row in rows)
    assert drawn == pytest.approx(wanted)
    rows = of_section(slow_results, "scaling")
    assert len(scaling.lines) == 3
    for line, sweep in zip(scaling.lines, (rows[0:2], rows[2:4], rows[4:6]), strict=True):
        assert list(line.get_xdata()) == [row["particle_steps"] for row in sweep]
        assert list(line.get_ydata()) == [row["run_seconds"] for row in sweep]
        assert f"exponent {sweep[0]['exponent']:.2f}" in line.get_label()


def test_no_figure_is_drawn_of_what_was_not_timed(tmp_path):
    save_figures([make_row("population_rollout", section="engines")], tmp_path / "new")
    assert list((tmp_path / "new").iterdir()) == []


def test_the_table_shows_what_some_row_has(capsys):
    rows = [make_row("a", error=1e-6), make_row("b", run_seconds=0.25, note="slow")]
    made = command.table("title", rows)
    assert [column.header for column in made.columns] == ["name", "run (ms)", "error (m)", "note"]
    assert list(made.columns[1].cells) == ["", "250"]


# --- a wrong engine -------------------------------------------------------------------------------


def broken(workload):
    stiffer = dataclasses.replace(workload.body, stiffness=1.5 * workload.body.stiffness)
    return ENGINES["numpy"][2](dataclasses.replace(workload, body=stiffer))


def failing(workload):
    return lambda: np.full((workload.population, workload.body.num_particles, 3), np.nan)


def absent(workload):
    raise UnavailableError("no such library")


@pytest.mark.parametrize(
    ("engine", "reason"),
    [(broken, "positions are wrong"), (failing, "positions are wrong"), (absent, "no such")],
)
def test_an_engine_that_is_wrong_or_absent_is_reported_and_not_timed(
    without_peers, monkeypatch, engine, reason
):
    for name in ("c", "c_1_thread", "edge_list_vmap"):
        monkeypatch.delitem(ENGINES, name)
    monkeypatch.setitem(ENGINES, engine.__name__, (engine.__name__, "", engine))
    row = list(rollouts.engines(TINY))[-1]
    assert row["engine"] == engine.__name__
    assert reason in row["not_timed"]
    assert row["run_seconds"] is None
    assert row["ratio_to_jaxsimp"] is None
    if engine is broken:
        assert row["error"] > checks.TOLERANCE
    json.dumps(row, allow_nan=False)


# --- arithmetic -----------------------------------------------------------------------------------


@pytest.mark.parametrize("exponent", [-1.0, 0.5, 1.0, 2.3])
def test_exponents_are_recovered(exponent):
    sizes = np.array([1, 2, 10, 70])
    assert fit_exponent(sizes, 3.0 * sizes**exponent) == pytest.approx(exponent, abs=1e-12)


@pytest.mark.parametrize(("sizes", "values"), [([1], [1]), ([1, 2], [0, 1]), ([-1, 2], [1, 1])])
def test_an_exponent_of_too_little_is_refused(sizes, values):
    with pytest.raises(ValueError, match="two or more, above zero"):
        fit_exponent(sizes, values)


def test_runs_take_turns():
    order = []
    seconds = time_in_turns([lambda: order.append("a"), lambda: order.append("b")], repeats=3)
    assert order == ["a", "b"] * 3
    assert seconds.shape == (3, 2)
    assert (seconds >= 0).all()


def test_the_peak_is_that_of_the_run():
    megabytes = 64

    def make():
        np.ones(4 * megabytes * 125_000).sum()  # in use before the run, not in it
        return lambda: np.ones(megabytes * 125_000).sum()

    peak = prepare(make).peak_megabytes
    if peak is None:
        pytest.skip("the system does not tell")
    assert megabytes * 0.9 < peak < megabytes * 1.5


# --- wrong requests -------------------------------------------------------------------------------


def test_wrong_requests_are_refused_before_anything_runs(tmp_path, monkeypatch, capsys):
    (tmp_path / "file").write_text("mine")
    monkeypatch.setattr(command, "run", lambda *_: pytest.fail("it ran"))
    for options, message in [
        (only("speed"), "unknown section 'speed'; choose from step, rollout, population, storage"),
        (("--json", tmp_path / "none" / "rows.json"), "is no folder"),
        (("--json", tmp_path), "is a folder; give a file"),
        (("--figures", tmp_path / "file"), "is a file; give a folder"),
    ]:
        assert run(*options) == 2
        assert message in " ".join(capsys.readouterr().err.split())
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_ctrl_c_has_its_exit_status(monkeypatch, capsys):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "run", interrupt)
    assert run("--quick") == 130
    assert "interrupted" in capsys.readouterr().out
