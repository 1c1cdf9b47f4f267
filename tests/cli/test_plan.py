"""The command from a goal to a plan: what it writes, resumes and refuses."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

import jaxsimp as js
from jaxsimp import goal_plan, goals
from jaxsimp.cli.main import main
from jaxsimp.cli.plan import Options
from jaxsimp.cli.plan_goal import body_and_goal
from jaxsimp.engines import least_distance
from jaxsimp.planning import CEM, Joint

ROPE = js.rope(11, 0.4)
L_SHAPE = goals.polyline(ROPE, np.array([[0.0, 0.0], [0.25, 0.0], [0.25, 0.15]]))
LYING = trimesh.transformations.rotation_matrix(np.pi / 2, [1.0, 0.0, 0.0])
SMALL = CEM(num_iterations=3, population=24, initial_populations=1, encoding=Joint())


@pytest.fixture(autouse=True)
def small_search(monkeypatch, tmp_path):
    monkeypatch.setitem(goal_plan.SEARCHES, "default", SMALL)
    monkeypatch.chdir(tmp_path)
    np.save("l.npy", L_SHAPE)


def command(*options):
    """What `jaxsimp plan` does, without another process."""
    return main(["plan", *map(str, options)])


def test_a_goal_becomes_a_folder_with_plan_report_and_figures(tmp_path, capsys):
    status = command("l.npy", "--seeds", 2, "--json", "result.json")
    result = json.loads((tmp_path / "result.json").read_text())
    folder = tmp_path / "l-plan"
    assert json.loads((folder / "result.json").read_text()) == result
    assert result["key_points"] == [0, 6, 10]
    assert result["num_actions"] == 4
    assert result["score"] == max(result["scores"])
    assert len(result["scores"]) == 2
    assert status == (0 if result["success"] else 1)
    assert 0 < result["mujoco_full_score"] <= 1
    scene = js.scene_of_plan(js.load_plan(result["plan"]))
    assert result["least_gripper_distance"] == least_distance(scene.trajectory)
    saved = js.load_plan(result["plan"])
    assert saved.about["score"] == result["score"]
    for name in ("plan.png", "key_points.png"):
        assert (folder / name).read_bytes().startswith(b"\x89PNG")
    assert (folder / "plan.html").read_text().startswith("<!doctype html>")
    assert result["animation"] == "l-plan/plan.html"
    report = (folder / "report.md").read_text()
    assert f"| score of the best plan | {result['score']:.3f} |" in report
    assert "l-plan/report.md" in capsys.readouterr().out


def test_the_same_command_resumes(tmp_path, monkeypatch):
    command("l.npy", "--seeds", 2, "--no-verify")
    folder = tmp_path / "l-plan"
    rows = (folder / "plans.jsonl").read_text()
    planned = []
    original = goal_plan.GoalPlanner.plan

    def watched(self, seed=0, *rest):
        planned.append(seed)
        return original(self, seed, *rest)

    monkeypatch.setattr(goal_plan.GoalPlanner, "plan", watched)
    command("l.npy", "--seeds", 2, "--no-verify")
    assert planned == []
    assert (folder / "plans.jsonl").read_text() == rows
    (folder / "plans" / "1.npz").unlink()
    command("l.npy", "--seeds", 2, "--no-verify")
    assert planned == [1]
    (folder / "plans" / "0.npz").write_bytes(b"no plan")
    command("l.npy", "--seeds", 2, "--no-verify")
    assert planned == [1, 0]
    assert "mujoco_full_score" not in json.loads((folder / "result.json").read_text())


def test_the_best_of_several_seeds_is_that_of_the_highest_merit(tmp_path):
    command("l.npy", "--seeds", 2, "--no-verify")
    folder = tmp_path / "l-plan"
    rows = [json.loads(line) for line in (folder / "plans.jsonl").read_text().splitlines()]
    assert all(row["merit"] == row["score"] for row in rows)  # without a distance of grippers
    other = min(rows, key=lambda row: row["score"])
    other["merit"] = 2.0
    (folder / "plans.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    command("l.npy", "--seeds", 2, "--no-verify")
    assert json.loads((folder / "result.json").read_text())["seed"] == other["seed"]


def test_rows_of_another_environment_are_kept_where_that_is_asked_for(tmp_path, capsys):
    command("l.npy", "--no-verify")
    rows = tmp_path / "l-plan" / "plans.jsonl"
    row = json.loads(rows.read_text())
    row["environment"]["cores"] += 1
    rows.write_text(json.dumps(row) + "\n")
    assert command("l.npy", "--no-verify") == 2
    assert "--mixed to go on" in " ".join(capsys.readouterr().err.split())
    assert command("l.npy", "--no-verify", "--mixed") in (0, 1)


def test_another_goal_has_another_folder(capsys):
    command("l.npy", "--no-verify")
    np.save("l.npy", goals.turn(L_SHAPE, 0.3))
    assert command("l.npy", "--no-verify") == 2
    assert "made with another configuration" in capsys.readouterr().err


def test_named_goals_and_a_start_of_ones_own(tmp_path):
    np.savez("rope.npz", rest=ROPE.rest)
    np.save("start.npy", L_SHAPE + np.array([0.0, 0.1, 0.0]))
    options = ("--body", "rope.npz", "--start", "start.npy", "--actions", 1, "--no-verify")
    command("--letter", "C", *options, "--out", "here")
    saved = js.load_plan(tmp_path / "here" / "plan.npz")
    np.testing.assert_allclose(saved.episode.start[0], L_SHAPE[0] + [0.0, 0.1, 0.0], atol=1e-6)
    np.testing.assert_allclose(saved.episode.goal, goals.letter(saved.body, "C"), atol=1e-6)
    assert len(saved.actions.pick) == 1


def test_a_garment_of_a_file_is_meshed_anew_pressed_and_folded(tmp_path):
    tube = trimesh.creation.cylinder(0.1, 0.3, sections=40, transform=LYING)
    tube.update_faces(np.abs(tube.face_normals[:, 1]) < 0.5)  # without its ends
    tube.subdivide().export("tube.obj")
    options = Options(fold="side", body=Path("tube.obj"), particles=60)
    with pytest.raises(ValueError, match=r"not lie flat. Press it flat \(jaxsimp.press, --press"):
        body_and_goal(options)
    with pytest.warns(UserWarning, match="the mesh lies in layers, .*--pinch 0.09. 3 holds all"):
        body_and_goal(replace(options, press=True))
    body, goal = body_and_goal(replace(options, press=True, pinch=(0.09, 3)))
    assert body.num_particles == pytest.approx(60, rel=0.1)
    # Pressed, the tube is half its circumference wide; folded, half as wide again, in four layers.
    across = np.ptp(body.rest[:, :2], axis=0)
    assert np.abs(across - np.pi * 0.1).min() < 0.03
    assert np.ptp(goal[:, 0]) == pytest.approx(across[0] / 2, rel=0.1)
    assert np.ptp(goal[:, 2]) >= 0.9 * 3 * 2 * body.radius


@pytest.mark.parametrize(
    ("fold", "name"), [("sleeves_in", "t_shirt"), ("leg_over_leg", "trousers")]
)
def test_garments_made_from_dimensions_are_folded_by_name(fold, name):
    body, goal = body_and_goal(Options(fold=fold, particles=80))
    garment = getattr(js, name)(num_particles=80)
    np.testing.assert_array_equal(body.rest, garment.body.rest)
    wanted = goals.fold_sequence(garment.body, getattr(goals, fold)(garment))
    np.testing.assert_array_equal(goal, wanted)


def test_points_of_another_order_are_registered_and_told(tmp_path, capsys):
    np.savez("rope.npz", rest=ROPE.rest)
    np.save("cloud.npy", np.random.default_rng(0).permutation(L_SHAPE))
    command("cloud.npy", "--body", "rope.npz", "--actions", 1, "--no-verify")
    goal = js.load_plan(tmp_path / "cloud-plan" / "plan.npz").episode.goal
    ways = (goal, goal[::-1])  # the ends of a rope are alike
    assert min(np.abs(way - L_SHAPE).max() for way in ways) < 0.02
    assert "hint: " in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ((), "0 goals are given to plan for"),
        (("l.npy", "--letter", "M"), "2 goals are given to plan for"),
        (("--fold", "twice"), "fold is 'twice'"),
        (("--fold", "sleeves_in", "--press"), "folds a t_shirt made from dimensions"),
        (("l.npy", "--press"), "--press and --particles change a body"),
        (("--letter", "M", "--particles", 40), "--press and --particles change a body"),
        (("--fold", "side", "--particles", 2), "particles is 2"),
        (("l.npy", "--planner", "best"), "planner is 'best'"),
        (("l.npy", "--seeds", 0), "seeds is 0"),
        (("l.npy", "--cost", "speed"), "cost is 'speed'"),
        (("l.npy", "--json", "none/result.json"), "none is no folder"),
        (("none.npy",), "none.npy"),
        (("l.npy", "--start", "none.npy"), "none.npy"),
    ],
)
def test_what_is_refused(tmp_path, capsys, options, message):
    assert command(*options) == 2
    assert message in " ".join(capsys.readouterr().err.split())
    assert [path.name for path in tmp_path.iterdir()] == ["l.npy"]
