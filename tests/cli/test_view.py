"""The commands that show and export plans: what they write, and what they refuse."""

import csv
import json

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import trimesh

import jaxsimp as js
from jaxsimp import viz
from jaxsimp.cli.main import main
from jaxsimp.dynamics import Actions
from jaxsimp.engines import MassSprings
from jaxsimp.viz.viewer import Viewer

PLAN = Actions(
    jnp.array([[0, 24], [20, 24]]),
    jnp.array([[[0.02, 0.02, 0.05], [-0.03, 0.0, 0.04]], [[0.01, 0.0, 0.03], [0.02, 0.01, 0.02]]]),
)


@pytest.fixture(scope="module")
def task():
    import dataclasses

    made = js.make_task("cloth_diagonal_folding", 5)
    return dataclasses.replace(made, num_actions=2, action_seconds=0.15, settle_actions=1)


@pytest.fixture(scope="module")
def plan(task, tmp_path_factory):
    """A plan file in a folder of results."""
    path = tmp_path_factory.mktemp("results") / "plans" / "fold.npz"
    path.parent.mkdir()
    episode, engine = task.episode_fn(0), MassSprings()
    done = engine.executor(task)(episode, PLAN)
    found = {"key_points": [0, 4, 20, 24], "costs": [0.2, 0.1]}
    js.save_plan(path, task, episode, PLAN, done, engine=engine, found=found)
    return path


@pytest.fixture(scope="module")
def goal(task, tmp_path_factory):
    path = tmp_path_factory.mktemp("goals") / "goal.npz"
    np.savez(path, positions=task.goal, rest=task.body.rest, faces=task.body.faces)
    return path


def panels(path):
    (line,) = [each for each in path.read_text().splitlines() if each.startswith("const PANELS = ")]
    return json.loads(line.removeprefix("const PANELS = ").removesuffix(";"))


def test_plans_goals_and_folders_are_shown_beside_one_another(plan, goal, tmp_path):
    page, video = tmp_path / "page.html", tmp_path / "video.gif"
    inputs = [str(each) for each in (plan, goal, plan.parents[1])]
    assert main(["view", *inputs, "--html", str(page)]) == 0
    assert main(["view", inputs[0], "--video", str(video), "--speed", "5"]) == 0
    first, second, third = panels(page)
    assert first == third
    assert (first["title"], second["title"]) == ("fold", "goal")
    assert first["keyPoints"] == [0, 4, 20, 24]
    assert first["costs"] == [0.2, 0.1]
    score = js.load_plan(plan).about["score"]
    assert float(first["caption"].split()[1]) == pytest.approx(score, abs=2e-3)
    assert first["times"][-1] == pytest.approx(3 * 0.15, abs=2e-3)
    assert second["times"] == [0.0]
    assert sorted(second["keyPoints"]) == sorted(js.simplify(*_loaded(goal)).particles.tolist())
    assert video.read_bytes()[:6] == b"GIF89a"


def _loaded(goal):
    return js.goals.load_goal(goal)


def test_wrong_paths_and_options_are_refused(plan, tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    (tmp_path / "text.npz").write_text("no archive")
    for arguments, told in (
        (["view", tmp_path / "none.npz"], "none.npz"),
        (["view", tmp_path / "text.npz"], "damaged"),
        (["view", tmp_path / "empty"], "has no plans; give a folder of results"),
        (["view"], "0 scenes are given"),
        (["view", *[plan] * 13, "--html", tmp_path / "x.html"], "13 scenes are given; give 1 to"),
        (["view", plan, "--video", tmp_path / "x.avi"], "is no video"),
        (["view", plan, "--html", plan], "is another file of this command; give another --html"),
        (["view", plan, "--html", tmp_path], "is a folder; give a file with --html"),
        (["export", plan, "--to", "csv", "--out", tmp_path], "is a folder; give a file with --out"),
        (["view", plan, "--fps", "0"], "frames_per_second is 0.0; give"),
        (["export", plan, "--to", "dxf"], "to is 'dxf'; choose from csv, json"),
        (["export", plan, "--to", "csv", "--out", plan], "is another file of this command"),
        (["export", tmp_path / "text.npz", "--to", "csv"], "it is not a saved plan"),
    ):
        assert main(list(map(str, arguments))) == 2, arguments
        assert told in capsys.readouterr().err.replace("\n", " ")
    assert sorted(each.name for each in tmp_path.iterdir()) == ["empty", "text.npz"]


def test_waypoints_are_those_of_the_plan(plan, tmp_path, capsys):
    for suffix in ("csv", "json"):
        out = str(tmp_path / f"plan.{suffix}")
        assert main(["export", str(plan), "--to", suffix, "--out", out]) == 0
    assert "least distance between grippers: 0." in capsys.readouterr().out
    rows = json.loads((tmp_path / "plan.json").read_text())
    with (tmp_path / "plan.csv").open() as file:
        again = list(csv.DictReader(file))
    assert [{name: str(each) for name, each in row.items()} for row in rows] == again
    for picker, particle, moved in (
        (0, 0, PLAN.displacement[0, 0]),
        (0, 20, PLAN.displacement[1, 0]),
        (1, 24, PLAN.displacement[:, 1].sum(axis=0)),
    ):
        own = [row for row in rows if (row["picker"], row["particle"]) == (picker, particle)]
        way = [own[-1][axis] - own[0][axis] for axis in "xyz"]
        np.testing.assert_allclose(way, moved, atol=3e-6)  # rounded to micrometres
        assert {row["gripper"] for row in own[:-1]} == {"closed"}
        assert own[-1]["gripper"] == "open"


def test_keyframes_of_mujoco_are_the_frames_of_the_plan(plan, task, tmp_path):
    out = tmp_path / "plan.xml"
    assert main(["export", str(plan), "--to", "mjcf", "--out", str(out)]) == 0
    model, data = mujoco.MjModel.from_xml_path(str(out)), None
    names = [model.key(index).name for index in range(model.nkey)]
    assert names == ["start", "action_1", "action_2", "settled"]
    assert model.nmocap == 3
    for index, positions in enumerate(js.load_plan(plan).positions):
        data = mujoco.MjData(model)
        mujoco.mj_resetDataKeyframe(model, data, index)
        mujoco.mj_forward(model, data)
        # Six digits in the text.
        np.testing.assert_allclose(data.xpos[1 : 1 + len(positions)], positions, atol=2e-6)


def test_meshes_are_the_frames(plan, tmp_path):
    saved = js.load_plan(plan)
    assert main(["export", str(plan), "--to", "ply", "--out", str(tmp_path / "frames")]) == 0
    paths = sorted((tmp_path / "frames").iterdir())
    count = len(js.scene_of_plan(saved).trajectory.times)
    assert [each.name for each in paths] == [f"frame_{index:04}.ply" for index in range(count)]
    for path, positions in ((paths[0], saved.positions[0]), (paths[-1], saved.positions[-1])):
        mesh = trimesh.load(path, process=False)
        np.testing.assert_allclose(mesh.vertices, positions, atol=1e-5)
        assert len(mesh.faces) == len(saved.body.faces)
    assert main(["export", str(plan), "--to", "glb", "--out", str(tmp_path / "end.glb")]) == 0
    (end,) = trimesh.load(tmp_path / "end.glb", process=False).geometry.values()
    x, y, z = saved.positions[-1].T
    np.testing.assert_allclose(end.vertices, np.stack([y, z, x], axis=1), atol=1e-5)  # y is up


def test_a_view_in_a_browser_is_served_and_ends(plan, monkeypatch, capsys):
    pytest.importorskip("viser")
    import urllib.request

    seen = []

    def serve(viewer):
        assert isinstance(viewer, Viewer)
        with urllib.request.urlopen(viewer.address, timeout=30) as answer:
            seen.append(answer.status)
        (stage,) = viewer._stages
        before = stage._bodies[0].vertices.copy()
        viewer._play.value = False
        viewer.tick(1.0)
        assert viewer._time.value == 0.0
        viewer._play.value, viewer._speed.value = True, 0.5
        viewer.tick(0.4)
        assert viewer._time.value == pytest.approx(0.2, abs=1e-3)
        viewer.seek(0.2)
        scene = js.scene_of_plan(js.load_plan(plan))
        wanted = viz.at_time(scene.trajectory, 0.2)[0]
        np.testing.assert_allclose(stage._bodies[0].vertices, wanted, atol=1e-6)
        np.testing.assert_allclose(stage._points.points, wanted[scene.key_points], atol=1e-6)
        assert np.abs(stage._bodies[0].vertices - before).max() > 0.01
        assert len(stage._moving) == 2 + len(viz.past_paths(scene.trajectory, 0.2))
        viewer._set_visible("pickers", False)
        assert not stage.groups["pickers"].visible
        raise KeyboardInterrupt

    monkeypatch.setattr("jaxsimp.viz.serve", serve)
    assert main(["view", str(plan), "--port", "18080"]) == 130
    assert seen == [200]
    assert "in a browser; Ctrl-C ends" in capsys.readouterr().out
    with pytest.raises(OSError, match="refused"):
        urllib.request.urlopen("http://localhost:18080", timeout=5)
