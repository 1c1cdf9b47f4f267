"""The study of transfer: what it leaves behind, going on, replaying an earlier study's plans."""

import dataclasses
import json
import shutil
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import run, transfer, transfer_report
from experiments.scripted import SCRIPTS, scripted_plan
from experiments.transfer import planned_study, replay_path
from jaxsimp.engines import Execution, MassSprings, make_ensemble
from jaxsimp.engines.mujoco.model import VARIANTS
from jaxsimp.planning import Planner
from jaxsimp.records import load_plan, lock, read_rows, save_plan
from jaxsimp.tasks import make_task, score, task_names

TASKS = ("rope_straightening", "cloth_diagonal_folding")
OPTIONS = (
    *("transfer", "--tasks", *TASKS, "--seeds", "1", "--resolution", "7", "--num-actions", "1"),
    *("--planners", "cem_24", "--population", "4", "--num-iterations", "1"),
)


def command(*options: str) -> int:
    """What `python -m experiments.run` does, without another process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["experiments.run", *map(str, options)])
        return run.main()


def finished(folder: Path) -> dict:
    return json.loads((folder / "summary.json").read_text())


@pytest.fixture
def without_pictures(monkeypatch):
    """Reports that show no plans: drawing them takes half the time of a study."""
    monkeypatch.setattr(transfer_report, "_shown", lambda rows: {})


@pytest.mark.slow
def test_summary_has_its_schema(folder):
    summary = finished(folder)
    assert summary.keys() == {"environment", "transfer", "scripted"}
    assert summary["environment"]["versions"]["mujoco"]
    fields = {
        *("task", "seed", "action_space", "final_score", "mujoco_fast_score"),
        *("mujoco_full_score", "warnings", "planning"),
    }
    for name, space in (("transfer", "key_points"), ("scripted", "scripted")):
        rows = summary[name]
        assert [row["task"] for row in rows] == list(TASKS)
        for row in rows:
            assert fields <= row.keys()
            assert row["action_space"] == space
            assert row["warnings"] == []
    assert {row["planning"] for row in summary["transfer"]} == {"nominal"}


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["fast", "full"])
def test_scores_are_those_of_the_settled_positions(folder, variant):
    summary = finished(folder)
    for row in [*summary["transfer"], *summary["scripted"]]:
        task, episode = make_task(row["task"], 7), make_task(row["task"], 7).episode_fn(0)
        for path, found in (
            (folder / row["plan"], row["final_score"]),
            (replay_path(folder, row, variant), row[f"mujoco_{variant}_score"]),
        ):
            last = load_plan(path).positions[-1]
            expected = float(score(task, episode, jnp.asarray(last, dtype=float)))
            assert found == pytest.approx(expected, abs=1e-5)  # float32, compiled otherwise


@pytest.mark.slow
def test_figures_show_the_scores_and_the_report_shows_the_figures(results):
    folder, figures = results
    summary = finished(folder)
    report = (folder / "report.md").read_text()
    names = {path.stem for path in (folder / "figures").iterdir()}
    shown = {f"{kind}_{task}" for kind in ("median", "worst", "by_hand") for task in TASKS}
    assert names == {"transfer", *shown}
    for name in names:
        assert f"(figures/{name}.png)" in report
    for task in TASKS:
        assert report.count(f"| {task} |") == 2
    # There is one plan of each kind.
    for index, task in enumerate(TASKS):
        found, by_hand = summary["transfer"][index], summary["scripted"][index]
        *_, first, second = figures["transfer.png"].axes[index].lines
        for line, row in ((first, found), (second, by_hand)):
            drawn = [line.get_xdata()[0], line.get_ydata()[0]]
            assert drawn == [row["final_score"], row["mujoco_full_score"]]
        for kind, row in (("median", found), ("worst", found), ("by_hand", by_hand)):
            titles = [axes.get_title() for axes in figures[f"{kind}_{task}.png"].axes]
            scores = [row[f"{engine}_score"] for engine in ("final", "mujoco_fast", "mujoco_full")]
            assert [title for title in titles if title.startswith("settled")] == [
                f"settled, score {score:.2f}" for score in scores
            ]


@pytest.mark.slow
@pytest.mark.usefixtures("without_pictures")
def test_a_study_cut_short_goes_on_to_the_same_rows(folder, tmp_path):
    copy = Path(shutil.copytree(folder, tmp_path / "copy"))
    (copy / "summary.json").unlink()
    lines = (copy / "replays.jsonl").read_text().splitlines(keepends=True)
    (copy / "replays.jsonl").write_text("".join(lines[:2]) + lines[2][:20])
    assert command(*OPTIONS, "--out", copy) == 0
    assert finished(copy)["transfer"] == finished(folder)["transfer"]
    assert finished(copy)["scripted"] == finished(folder)["scripted"]


@pytest.mark.slow
@pytest.mark.usefixtures("without_pictures")
def test_plans_of_an_earlier_study_are_replayed(folder, tmp_path):
    # The folder of a study of transfer holds plans as any other study's does, but for the
    # configuration, which is the one of the study inside.
    source = Path(shutil.copytree(folder, tmp_path / "paper"))
    config = json.loads((source / "config.json").read_text())
    (source / "config.json").write_text(json.dumps(config["plans"]))
    runs = read_rows(source / "runs.jsonl")
    (source / "summary.json").write_text(
        json.dumps({"environment": finished(folder)["environment"], "models": [], "runs": runs})
    )
    out = tmp_path / "again"
    assert command("transfer", "--plans", source, "--out", out) == 0
    assert not (out / "runs.jsonl").exists()
    assert finished(out)["transfer"] == finished(folder)["transfer"]
    # The report of the earlier study has the scores in MuJoCo, too.
    report = (source / "report.md").read_text().splitlines()
    assert "in MuJoCo, full: median (range)" in next(line for line in report if "rollouts" in line)
    for row in finished(out)["transfer"]:
        (line,) = (line for line in report if line.startswith(f"| {row['task']} | key points"))
        assert line.endswith("| {0:.3f} ({0:.3f} to {0:.3f}) |".format(row["mujoco_full_score"]))


@pytest.mark.slow
@pytest.mark.usefixtures("without_pictures")
def test_damaged_plans_and_replays_are_made_again(folder, tmp_path, capsys):
    copy = Path(shutil.copytree(folder, tmp_path / "copy"))
    found, by_hand = finished(folder)["transfer"], finished(folder)["scripted"]
    (copy / by_hand[0]["plan"]).write_bytes(b"no plan")
    replay_path(copy, found[0], "fast").unlink()
    replay_path(copy, found[1], "full").write_bytes(b"no plan")
    with (copy / "replays.jsonl").open("a") as file:
        file.write("!!\n")
    assert command(*OPTIONS, "--out", copy) == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "replays.jsonl, line 5 is no row of results, it is no JSON: b'!!'" in told
    assert told.count("is made again") == 4
    assert finished(copy)["transfer"] == found
    assert finished(copy)["scripted"] == by_hand
    for row in [*found, *by_hand]:
        paths = [Path(row["plan"]), *(replay_path(Path(), row, name) for name in VARIANTS)]
        for path in paths:
            assert (copy / path).read_bytes() == (folder / path).read_bytes()


@pytest.mark.slow
def test_earlier_plans_that_are_damaged_are_refused(folder, tmp_path):
    source = Path(shutil.copytree(folder, tmp_path / "paper"))
    study = transfer.TransferOptions(
        tasks=TASKS, planners=("cem_24",), seeds=1, resolution=7, num_actions=1
    )
    planned = study.transfer().plans
    first = transfer._earlier_runs(planned, source)[0]
    (source / "runs.jsonl").write_text((source / "runs.jsonl").read_text() * 2)
    assert len(transfer._earlier_runs(planned, source)) == len(TASKS)  # each once
    (source / first["plan"]).unlink()
    with pytest.raises(ValueError, match=r"npz is missing; run its study again"):
        transfer._earlier_runs(planned, source)


def test_the_folder_of_the_plans_is_left_while_it_is_in_use(tmp_path, monkeypatch):
    monkeypatch.setattr(lock, "PATIENCE", 0.0)
    with lock.lock_folder(tmp_path), pytest.raises(ValueError, match="in use by process"):
        transfer._add_to_report(None, {"transfer": []}, tmp_path, print)
    assert not (tmp_path / "transfer.json").exists()


@pytest.mark.parametrize("damaged", ["", "[]", '{"runs": []}'])
def test_a_damaged_summary_of_the_plans_is_told(tmp_path, damaged):
    (tmp_path / "summary.json").write_text(damaged)
    told = []
    transfer._add_to_report(None, {"transfer": []}, tmp_path, told.append)
    assert "summary.json is damaged" in told[0]
    assert "run the study of these plans again" in told[0]
    assert (tmp_path / "transfer.json").exists()


@pytest.mark.slow
@pytest.mark.usefixtures("without_pictures")
@pytest.mark.long
def test_robust_plans_are_judged_in_an_ensemble(tmp_path):
    options = (*OPTIONS, "--tasks", "rope_folding", "--planning", "robust")
    out = tmp_path / "robust"
    assert command(*options, "--out", out) == 0
    (row,), (by_hand,) = finished(out)["transfer"], finished(out)["scripted"]
    assert (row["planning"], by_hand["planning"]) == ("robust", "scripted")
    assert "| rope_folding | cem_24 | key points | robust |" in (out / "report.md").read_text()
    # The search's cost of the plan is the one of the ensemble, not that of the body's own physics.
    task = make_task("rope_folding", 7)
    task = dataclasses.replace(task, num_actions=1, running_weight=1.0)
    plan = jax.tree.map(lambda array: array[None], load_plan(out / row["plan"]).actions)
    robust, nominal = (
        Planner(task, engine).costs(task.episode_fn(0), plan)[0]
        for engine in (make_ensemble(task, 4), MassSprings())
    )
    (found,) = read_rows(out / "runs.jsonl")
    assert found["final_cost"] == pytest.approx(robust, rel=1e-5)  # float32
    assert found["final_cost"] != pytest.approx(nominal, rel=1e-3)


def test_what_judges_plans_is_part_of_what_a_study_is():
    options = [
        transfer.TransferOptions(smoke=True, planning=each)
        for each in ("nominal", "robust", "self_contact", "mixed")
    ]
    nominal, robust, touching = (each.transfer().identity()["plans"] for each in options[:3])
    assert {name for name in nominal if nominal[name] != robust[name]} == {"planning", "ensemble"}
    assert {name for name in nominal if nominal[name] != touching[name]} == {"planning", "search"}
    rounds = [
        each["search"]["rope_folding, default"][0]["num_iterations"] for each in (nominal, touching)
    ]
    assert rounds == [3, 2]  # half of them, for each takes longer
    assert robust["ensemble"]["size"] == 4
    assert [each.folder().name for each in options] == [
        "transfer-smoke",
        "transfer-robust-smoke",
        "transfer-self_contact-smoke",
        "transfer-mixed-smoke",
    ]


@pytest.mark.slow
@pytest.mark.usefixtures("without_pictures")
def test_plans_with_self_contact_are_those_of_its_physics(tmp_path):
    out = tmp_path / "touching"
    options = (*OPTIONS, "--tasks", "rope_folding", "--planning", "self_contact")
    assert command(*options, "--out", out) == 0
    (row,) = finished(out)["transfer"]
    (found,) = read_rows(out / "runs.jsonl")
    assert row["planning"] == "self_contact"
    task = dataclasses.replace(make_task("rope_folding", 7), num_actions=1)
    plan = load_plan(out / row["plan"]).actions
    execution = MassSprings(self_contact=True).executor(task)(task.episode_fn(0), plan)
    assert execution.missed is not None
    assert found["final_score"] == pytest.approx(execution.score, abs=1e-5)  # float32


@pytest.mark.slow
def test_a_plan_is_replayed_from_the_start_that_it_was_made_for(tmp_path, monkeypatch):
    monkeypatch.setattr(transfer, "VARIANTS", {"fast": VARIANTS["fast"]})
    (tmp_path / transfer.REPLAYS_FOLDER).mkdir()
    task, seed = make_task("cloth_side_folding", 5), 3
    episode = task.episode_fn(seed)
    plan, path = scripted_plan(task, episode), tmp_path / "plan.npz"
    nothing = Execution(np.zeros((task.num_actions + 2, 25, 3)), 0.0)
    save_plan(path, task, episode, plan, nothing, engine=MassSprings())
    row = {"task": task.name, "action_space": "scripted", "seed": seed, "plan": path.name}
    (done,) = transfer._replay_task(task, [transfer.Case(row, path)], tmp_path)
    assert done["mujoco_fast_status"] == "FINE"
    frames = load_plan(replay_path(tmp_path, row, "fast")).positions
    np.testing.assert_allclose(frames[0], task.episode_fn(seed).start, atol=1e-7)  # float32


def test_robust_is_refused_for_plans_that_are_found(tmp_path, capsys):
    assert (
        command("transfer", "--planning", "robust", "--plans", tmp_path, "--out", tmp_path / "new")
        == 2
    )
    assert "--planning robust finds plans" in " ".join(capsys.readouterr().err.split())


def test_a_folder_without_plans_is_refused(tmp_path, capsys):
    with pytest.raises(ValueError, match="holds no plans"):
        planned_study(tmp_path)
    assert command("transfer", "--plans", tmp_path, "--out", tmp_path / "new") == 2
    assert "holds no plans" in " ".join(
        capsys.readouterr().err.split()
    )  # as the terminal breaks it
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("name", task_names("paper"))
def test_a_scripted_plan_is_within_the_limits_of_its_task(name):
    task = make_task(name, quick=True)
    for seed in range(3):
        plan = scripted_plan(task, task.episode_fn(seed))
        assert plan.pick.shape == (task.num_actions, task.num_pickers)
        # A diagonal fold of a cloth that is turned by 45 degrees is longer than two actions
        # reach, by a fifteenth; that is clipped.
        assert np.all(np.abs(plan.displacement) <= 1.07 * np.asarray(task.limits))


def test_a_scripted_fold_ends_above_its_goal():
    task = make_task("cloth_diagonal_folding", quick=True)
    episode = task.episode_fn(3)
    plan = scripted_plan(task, episode)
    end = np.asarray(episode.start)[0] + np.asarray(plan.displacement)[:, 0].sum(axis=0)
    expected = np.asarray(episode.goal)[0] + [0.0, 0.0, 3 * task.body.radius]
    np.testing.assert_allclose(end, expected, rtol=0, atol=1e-6)  # float32


def test_a_task_without_a_script_is_refused():
    task = make_task("rope_letter_m", 9)
    assert task.name not in SCRIPTS
    with pytest.raises(ValueError, match="no plan is scripted for 'rope_letter_m'; choose one"):
        scripted_plan(task, task.episode_fn(0))
