"""The command: what a study leaves behind, going on after a kill, and wrong requests."""

import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from experiments import plan_options, plan_report, run
from experiments.goals import GoalsOptions
from experiments.paper import PaperOptions
from experiments.plan_study import ACTION_SPACES, IDENTITY
from experiments.planners import PLANNERS, counted_rollouts, with_encoding
from experiments.simplification import SimplificationOptions
from jaxsimp import records
from jaxsimp.planning import CEM, ENCODINGS, Planner, StagedPlanner
from jaxsimp.records import load_plan
from jaxsimp.tasks import make_task, score

ROOT = Path(__file__).parents[2]
TASKS = ("rope_folding", "cloth_diagonal_folding")
OPTIONS = (
    *("--tasks", *TASKS, "--seeds", "2", "--resolution", "9", "--num-actions", "1"),
    *("--planners", "cem_24", "--pick-encodings", "categorical"),
    *("--population", "4", "--num-iterations", "2"),
)
TIMINGS = ("plan_seconds", "compile_seconds", "environment")


def command(*options: str) -> int:
    """What `python -m experiments.run` does, without another process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["experiments.run", *map(str, options)])
        return run.main()


def finished(folder: Path) -> dict:
    return json.loads((folder / "summary.json").read_text())


def untimed(rows: list[dict]) -> list[dict]:
    return [{name: row[name] for name in row if name not in TIMINGS} for row in rows]


# --- what a study leaves behind -------------------------------------------------------------------


@pytest.mark.slow
def test_summary_has_its_schema(folder):
    summary = finished(folder)
    assert summary.keys() == {"environment", "models", "runs"}
    assert {"versions", "commit", "device", "cores"} <= summary["environment"].keys()
    assert [model["task"] for model in summary["models"]] == list(TASKS)
    for model in summary["models"]:
        assert model["method"]
        assert 0.5 < model["goal_settled_score"] <= model["goal_score"] <= 1
        assert len(model["sizes"]) == len(model["errors"]) > 0
        # The first size that fits is the one chosen; others are there to be shown.
        fits = [error < model["threshold"] for error in model["errors"]]
        assert len(model["key_points"]) == model["sizes"][fits.index(True)]
        particles = make_task(model["task"], 9).body.num_particles
        assert set(model["key_points"]) <= set(range(particles))


@pytest.mark.slow
def test_runs_have_their_schema(folder):
    runs = finished(folder)["runs"]
    combinations = [
        (task, "cem_24", space, "categorical", seed)
        for task in TASKS
        for space in ACTION_SPACES
        for seed in range(2)
    ]
    found = [tuple(row[name] for name in IDENTITY) for row in runs]
    assert found == combinations
    for row in runs:
        assert row["num_particles"] == (9 if row["task"] == "rope_folding" else 81)
        assert 2 <= row["num_key_points"] < row["num_particles"]
        # The first round has four populations of 4.
        assert row["rollouts_per_question"] == [4, 8, 12, 16, 20]
        assert len(row["cost_per_question"]) == 5
        assert np.all(np.diff(row["cost_per_question"]) <= 0)
        assert row["success"] == (row["final_score"] >= 0.9)
        assert row["rollouts"] == row["counted_rollouts"] == 20
        assert row["non_finite"] == 0
        assert row["plan_seconds"] > 0
        assert row["compile_seconds"] >= 0
        (cem,) = row["config"]["search"]
        assert (cem["algorithm"], cem["population"], cem["num_iterations"]) == ("CEM", 4, 2)
        assert row["config"]["num_actions"] == 1
        assert row["environment"]["versions"]["jax"]


@pytest.mark.slow
def test_plans_load_and_end_in_the_score_of_their_run(folder):
    summary = finished(folder)
    key_points = {model["task"]: model["key_points"] for model in summary["models"]}
    for row in summary["runs"]:
        plan = load_plan(folder / row["plan"])
        task = make_task(row["task"], 9)
        assert plan.positions.shape == (3, task.body.num_particles, 3)
        last = np.asarray(plan.positions[-1], np.float32)
        episode = task.episode_fn(row["seed"])
        found = score(task, episode, jnp.asarray(last))
        # float32, compiled with other code around it
        assert row["final_score"] == pytest.approx(float(found), abs=1e-5)
        if row["action_space"] == "key_points":
            picked = set(np.asarray(plan.actions.pick).ravel().tolist())
            assert picked <= {*key_points[row["task"]], -1}


@pytest.mark.slow
def test_plans_are_scored_with_self_contact_unless_told_otherwise(folder, tmp_path):
    with_it = [row for row in finished(folder)["runs"] if row["task"] == TASKS[1]]
    options = (*OPTIONS, "--tasks", TASKS[1], "--no-self-contact")
    assert command(*options, "--out", tmp_path / "without") == 0
    without = finished(tmp_path / "without")["runs"]
    assert {type(row["missed_contacts"]) for row in with_it} == {int}
    assert {row["missed_contacts"] for row in without} == {0}
    # The search is the same.
    assert [row["final_cost"] for row in without] == [row["final_cost"] for row in with_it]
    for path, words in (
        (folder, "touches itself"),
        (tmp_path / "without", "passes through itself"),
    ):
        assert words in (path / "report.md").read_text()


@pytest.mark.slow
def test_figures_show_the_runs_and_the_report_shows_the_figures(results):
    folder, figures = results
    summary = finished(folder)
    names = {"model_errors", "models", "costs", *(f"plans_{name}" for name in TASKS)}
    assert {path.stem for path in (folder / "figures").iterdir()} == names
    assert set(figures) == {f"{name}.png" for name in names}
    report = (folder / "report.md").read_text()
    for name in names:
        assert f"(figures/{name}.png)" in report
    for task in TASKS:
        assert f"| {task} |" in report
    assert not list(folder.rglob("*.part"))

    errors, models, costs = (figures[f"{n}.png"].axes for n in ("model_errors", "models", "costs"))
    for model, error, shown in zip(summary["models"], errors, models, strict=True):
        title, number = model["task"].replace("_", " "), len(model["key_points"])
        assert error.get_title() == title
        np.testing.assert_allclose(error.lines[0].get_xdata(), model["sizes"])
        np.testing.assert_allclose(error.lines[0].get_ydata(), 1e3 * np.array(model["errors"]))
        assert shown.get_title() == f"{title}: {number} key points"
        # The last of what is drawn are the stars on the key points.
        assert len(shown.collections[-1].get_offsets()) == number
    for task, cost in zip(TASKS, costs, strict=True):
        runs = [row for row in summary["runs"] if row["task"] == task]
        drawn = [line.get_ydata() for line in cost.lines]
        # The mean of both seeds, for each of both action spaces.
        paths = np.array([row["cost_per_question"] for row in runs]).reshape(2, 2, -1)
        np.testing.assert_allclose(drawn, paths.mean(axis=1))
        titles = [axes.get_title() for axes in figures[f"plans_{task}.png"].axes]
        shown = plan_report._typical_seed(runs)
        scores = [row["final_score"] for row in runs if row["seed"] == shown]
        rows = [["start", "action 1", f"settled, score {each:.2f}", "goal"] for each in scores]
        assert titles == [title for row in rows for title in row]


# --- going on where it was ------------------------------------------------------------------------


@pytest.mark.slow
def test_a_finished_study_is_not_run_again(folder, tmp_path):
    copy = Path(shutil.copytree(folder, tmp_path / "copy"))
    (copy / "summary.json").unlink()
    before = (copy / "runs.jsonl").read_bytes()
    assert command(*OPTIONS, "--out", copy) == 0
    assert (copy / "runs.jsonl").read_bytes() == before
    assert finished(copy)["runs"] == finished(folder)["runs"]


@pytest.mark.slow
def test_a_study_cut_short_in_a_row_goes_on_to_the_same_runs(folder, tmp_path):
    # As a kill leaves it: five rows and a piece of the sixth, its plan half written.
    copy = Path(shutil.copytree(folder, tmp_path / "copy"))
    for name in ("summary.json", "report.md"):
        (copy / name).unlink()
    lines = (copy / "runs.jsonl").read_text().splitlines(keepends=True)
    (copy / "runs.jsonl").write_text("".join(lines[:5]) + lines[5][: len(lines[5]) // 2])
    for row in map(json.loads, lines[5:]):
        (copy / row["plan"]).unlink()
    (copy / "plans" / "cloth.npz.part").write_bytes(b"half")
    assert command(*OPTIONS, "--out", copy) == 0
    assert untimed(finished(copy)["runs"]) == untimed(finished(folder)["runs"])
    assert (copy / "runs.jsonl").read_text().splitlines(keepends=True)[:5] == lines[:5]
    for row in finished(copy)["runs"]:
        with np.load(copy / row["plan"]) as redone, np.load(folder / row["plan"]) as once:
            np.testing.assert_array_equal(redone["positions"], once["positions"])


@pytest.mark.slow
@pytest.mark.long
def test_a_killed_process_goes_on_to_the_same_runs(folder, tmp_path):
    out, rows = tmp_path / "killed", tmp_path / "killed" / "runs.jsonl"
    # A copy of what is compiled: a file that the kill cuts short must not be read by others.
    programs = shutil.copytree(os.environ["JAX_COMPILATION_CACHE_DIR"], tmp_path / "programs")
    environment = os.environ | {"JAX_PLATFORMS": "cpu", "JAX_COMPILATION_CACHE_DIR": str(programs)}
    with subprocess.Popen(
        [sys.executable, "-m", "experiments.run", *OPTIONS, "--out", out],
        cwd=ROOT,
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    ) as process:
        while process.poll() is None and not (rows.exists() and rows.stat().st_size):
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL)
    assert process.returncode == -signal.SIGKILL
    left = len(rows.read_text().splitlines())
    assert 1 <= left < 8
    assert not (out / "summary.json").exists()
    assert command(*OPTIONS, "--out", out) == 0
    assert untimed(finished(out)["runs"]) == untimed(finished(folder)["runs"])


@pytest.mark.slow
def test_damage_is_told_set_aside_and_made_again(folder, tmp_path, capsys):
    copy = Path(shutil.copytree(folder, tmp_path / "copy"))
    rows = [json.loads(line) for line in (copy / "runs.jsonl").read_text().splitlines()]
    missing, damaged, other, swapped = (copy / row["plan"] for row in rows[:4])
    missing.unlink()
    damaged.write_bytes(b"no plan")
    shutil.copy(copy / rows[-1]["plan"], other)  # of another shape: a cloth's
    shutil.copy(folder / rows[2]["plan"], swapped)  # of the same shape, with another score
    with (copy / "runs.jsonl").open("a") as file:
        file.write(json.dumps(rows[5]) + "\n\n")
    assert command(*OPTIONS, "--out", copy) == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "runs.jsonl, line 10 is no row of results, it is blank; the file is kept as" in told
    assert f"{missing} is missing; it is made again" in told
    assert f"{damaged} cannot be read" in told
    assert f"{other} has positions of shape (3, 81, 3)" in told
    assert f"{swapped} has another score than its row (kept as {swapped.name}.damaged-1)" in told
    assert untimed(finished(copy)["runs"]) == untimed(finished(folder)["runs"])
    for row in rows:
        assert (copy / row["plan"]).read_bytes() == (folder / row["plan"]).read_bytes()
    kept = [path.name for path in copy.rglob("*.damaged-*")]
    assert sorted(kept) == sorted(
        ["runs.jsonl.damaged-1", *(f"{path.name}.damaged-1" for path in (damaged, other, swapped))]
    )


@pytest.mark.slow
def test_another_environment_is_refused_or_told_in_the_report(
    folder, tmp_path, capsys, monkeypatch
):
    copy = Path(shutil.copytree(folder, tmp_path / "copy"))
    before = (copy / "runs.jsonl").read_bytes()
    (copy / "runs.jsonl").write_bytes(before.replace(b'"cores": ', b'"cores": 1', 1))
    assert command(*OPTIONS, "--out", copy) == 2
    assert "has rows of another environment: cores differ (cores: 1" in capsys.readouterr().err
    assert command(*OPTIONS, "--out", copy, "--mixed") == 0
    report = (copy / "report.md").read_text()
    assert "**The rows are of 2 environments (`--mixed`)**" in report
    assert "\n- 1 rows: Commit" in report
    assert "\n- 7 rows: Commit" in report
    assert "(`--mixed`)" not in (folder / "report.md").read_text()


def test_a_study_that_is_running_is_not_run_a_second_time(tmp_path, capsys):
    study = PaperOptions(tasks=("rope_folding",), resolution=9).configuration()
    options = ("--tasks", "rope_folding", "--resolution", "9")
    with records.open_folder(tmp_path / "new", study.identity()):
        assert command(*options, "--out", tmp_path / "new") == 2
    assert f"is in use by process {os.getpid()}" in capsys.readouterr().err


@pytest.mark.parametrize("damaged", ["", "[1]", '[{"task": "t"}]', "{}{", "\x00"])
def test_damaged_replays_are_told_and_left_out(tmp_path, damaged):
    (tmp_path / "transfer.json").write_text(damaged)
    told = []
    assert plan_report._replayed(tmp_path, told.append) == []
    assert f"{tmp_path / 'transfer.json'} is damaged" in told[0]
    assert f"`python -m experiments.run transfer --plans {tmp_path}` makes it again" in told[0]
    assert (tmp_path / "transfer.json.damaged-1").read_text() == damaged
    assert not (tmp_path / "transfer.json").exists()


def test_a_full_disk_is_one_line_that_says_how_to_go_on(tmp_path, capsys, monkeypatch):
    def full(*args, **options):
        raise OSError(28, "No space left on device", "plans/a.npz")

    monkeypatch.setattr(plan_options, "run_study", full)
    assert command(*OPTIONS, "--out", tmp_path / "new") == 2
    assert capsys.readouterr().err == (
        "error: No space left on device: plans/a.npz; once that is cured, the same command "
        "resumes it\n"
    )


def test_ctrl_c_has_its_exit_status_and_says_how_to_go_on(tmp_path, monkeypatch, capsys):
    def interrupt(*args, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(plan_options, "run_study", interrupt)
    assert command(*OPTIONS, "--out", tmp_path / "new") == 130
    assert "resumes" in capsys.readouterr().out


# --- wrong requests -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--tasks", "rope_tying"), "unknown task 'rope_tying'; choose from rope_straightening"),
        (("--action-spaces", "corners"), "unknown action space 'corners'; choose from key_points"),
        (("--pick-encodings", "uniform"), "unknown pick encoding 'uniform'; choose from"),
        (("--planners", "fast"), "unknown planner 'fast'; choose from default"),
        (("--first-seed", "-1"), "seed is -1; give a whole number from 0"),
        (("--first-seed", "4294967290"), "seed is 4294967299; give a whole number from 0"),
        (("--seeds", "0"), "seeds is 0; give a whole number"),
        (("--seeds", "-1", "--smoke"), "seeds is -1; give a whole number"),
        (("--num-actions", "0"), "num_actions is 0; give a whole number"),
        (("--population", "-5"), "population is -5; give a whole number from 1"),
        (("--num-iterations", "0"), "num_iterations is 0; give a whole number from 1"),
        (("--elite-fraction", "2"), "elite_fraction is 2.0; give"),
        (("--smoothing", "1"), "smoothing is 1.0; give"),
        (("--initial-spread", "nan"), "initial_spread is nan; give"),
        (("--resolution", "3"), "resolution is 3; give a whole number from 5"),
        (("--resolution", "0"), "resolution is 0; give a whole number from 5"),
        (("--tasks", "rope_folding", "rope_folding"), "task 'rope_folding' is given twice"),
        (("--pick-encodings", "categorical", "categorical"), "'categorical' is given twice"),
    ],
)
def test_a_wrong_value_is_named_with_a_remedy_and_nothing_is_written(
    tmp_path, capsys, options, message
):
    assert command(*options, "--out", tmp_path / "new") == 2
    error = " ".join(capsys.readouterr().err.split())  # as the terminal's width breaks it
    assert error.startswith("error: ")
    assert message in error
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("options", [("--no-such-option",), ("--seeds", "many")])
def test_options_that_do_not_parse_end_with_status_2(options, capsys):
    with pytest.raises(SystemExit) as stopped:
        command(*options)
    assert stopped.value.code == 2


def test_folders_that_cannot_be_used_end_with_status_2(tmp_path, capsys):
    (tmp_path / "file").write_text("mine")
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "thesis.tex").write_text("mine")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "config.json").write_text('{"seeds": 7}')
    before = sorted(tmp_path.rglob("*"))
    told = {
        "file": "is a file",
        "file/below": "cannot be written to",
        "foreign": "holds files",
        "other": "made with another configuration",
    }
    for name, message in told.items():
        assert command(*OPTIONS, "--out", tmp_path / name) == 2
        error = " ".join(capsys.readouterr().err.split())
        assert message in error
        assert "--out" in error
    assert sorted(tmp_path.rglob("*")) == before


def test_the_command_ends_with_its_status(tmp_path):
    # In a process of its own: the exit status and the stream of the message.
    done = subprocess.run(
        [sys.executable, "-m", "experiments.run", "--seeds", "0", "--out", tmp_path / "new"],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2
    assert "seeds is 0" in done.stderr
    assert "Traceback" not in done.stderr
    assert done.stdout == ""


def test_list_names_everything(capsys):
    assert command("--list") == 0
    told = capsys.readouterr().out
    for name in (*TASKS, *PLANNERS, *ACTION_SPACES, *ENCODINGS):
        assert name in told


# --- configuration --------------------------------------------------------------------------------


def test_options_replace_the_settings_of_the_planners():
    study = PaperOptions(
        planners=("paper",),
        population=11,
        smoothing=0.3,
        keep_best=True,
        returns="best",
        num_actions=3,
    ).configuration()
    task = study.task("rope_folding")
    assert study.search(task, "paper") == CEM(
        num_iterations=20,
        population=11,
        initial_populations=1,
        elite_fraction=0.1,
        smoothing=0.3,
        initial_spread=0.5**0.5,
        keep_best=True,
        returns="best",
    )
    assert task.num_actions == 3
    # In a sequence they are those of its CEM.
    study = PaperOptions(population=11).configuration()
    search = study.search(task, "default").algorithms
    whole = PaperOptions().configuration().search(task, "default").algorithms
    assert search == (dataclasses.replace(whole[0], population=11), *whole[1:])


@pytest.mark.parametrize("name", ["rope_folding", "cloth_side_folding"])
def test_what_is_compared_has_the_same_price(name):
    study = PaperOptions(planners=tuple(PLANNERS)).configuration()
    prices = {}
    for planner in ("default", "without_descent", "without_reranking", "cem"):
        search = study.search(study.task(name, planner), planner)
        prices[planner] = counted_rollouts(search)[-1]
        other = with_encoding(search, ENCODINGS["gaussian_index"])
        assert counted_rollouts(other)[-1] == prices[planner]
    # Rounds are of 128: none has more than the default, nor less by more than a round.
    assert all(prices["default"] - 128 < price for price in prices.values())
    assert max(prices.values()) <= prices["default"] + 16


def test_seeds_start_where_they_are_told_to():
    study = PaperOptions(first_seed=1000, seeds=2).configuration()
    assert {run.seed for run in study.runs()} == {1000, 1001}
    assert SimplificationOptions(first_seed=7, seeds=1).configuration().first_seed == 7


def test_the_papers_study_compares_the_joint_encoding_with_the_papers():
    runs = PaperOptions(seeds=1, tasks=("rope_folding",)).configuration().runs()
    encodings = ("joint", "gaussian_index")
    assert [run[2:] for run in runs] == [
        (space, each, 0) for space in ACTION_SPACES for each in encodings
    ]


def test_the_paper_planner_is_the_authors():
    # Figures of the author's runs: horizon 15, 0.08 m an axis a step; 70 and 333 plans a round
    # of 20, a tenth of them elites, no smoothing, variance 0.5, the mean returned.
    study = PaperOptions(planners=("paper",)).configuration()
    for name, population, elites in [
        ("rope_straightening", 70, 7),
        ("cloth_side_folding", 333, 33),
    ]:
        task = study.task(name)
        config = study.search(task, "paper")
        assert (task.num_actions, task.limits) == (15, (0.08, 0.08, 0.08))
        assert task.running_weight == 1  # the sum of all costs
        assert (config.population, config.num_elites) == (population, elites)
        assert (config.num_iterations, config.smoothing, config.returns) == (20, 0.0, "mean")
        assert config.initial_spread**2 == pytest.approx(0.5)
        assert not config.keep_best


def test_studies_that_plan_otherwise_have_another_folder():
    for planning, name in (("nominal", "goals"), ("mixed", "goals-mixed")):
        options = GoalsOptions(planning=planning)
        assert options.folder().name == name
        assert options.configuration().planning == planning


def test_a_smoke_run_is_small():
    study = PaperOptions(smoke=True).configuration()
    assert study.seeds == 2
    assert study.task("cloth_side_folding").body.num_particles == 81
    assert PaperOptions(smoke=True).folder() != PaperOptions().folder()


def test_goals_of_several_folds_are_planned_in_stages_and_fine_cloths_from_coarse_ones():
    study = GoalsOptions(tasks=("cloth_quarter_fold",), resolution=9).configuration()
    made = study.planner("cloth_quarter_fold", "default")
    assert isinstance(made, StagedPlanner)
    assert study.task("cloth_quarter_fold").num_actions == made.task.num_actions == 2 + 4 + 2
    one = GoalsOptions(tasks=("cloth_quarter_fold",), planners=("one_piece",), resolution=9)
    assert type(one.configuration().planner("cloth_quarter_fold", "one_piece")) is Planner
    assert one.configuration().task("cloth_quarter_fold").num_actions == 6

    fine = PaperOptions(tasks=("cloth_side_folding",), resolution=90).configuration()
    planners = fine.planner("cloth_side_folding", "default").planners
    assert [planner.task.body.shape[0] for planner in planners] == [25, 50, 90]
    # Not those of other planners, nor of ropes.
    assert type(fine.planner("cloth_side_folding", "cem")) is Planner
    rope = PaperOptions(tasks=("rope_folding",), resolution=90).configuration()
    assert type(rope.planner("rope_folding", "default")) is Planner
