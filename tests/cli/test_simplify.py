"""The command for goals in files: what it finds and writes, and what it refuses to read."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

import jaxsimp
from jaxsimp import goals
from jaxsimp.bodies import cloth, rope
from jaxsimp.cli import simplify
from jaxsimp.cli.main import main
from jaxsimp.simplification import Workspace, simplify_batch

ROOT = Path(__file__).parents[2]
ROPE, CLOTH = rope(), cloth()
LEG = 0.0125 * np.abs(np.arange(41) - 20)  # from the middle of the rope
LETTERS = {
    "V": np.stack([0.6 * np.sign(np.arange(41) - 20) * LEG, 0.8 * LEG, 0 * LEG], axis=1),
    "M": goals.letter(ROPE, "M"),
    "S": goals.letter(ROPE, "S"),
}
DIAGONAL = goals.fold_sequence(CLOTH, goals.rectangle_folds(CLOTH, "diagonal"))
CORNERS = [0, 24, 600, 624]
"""The diagonal fold's two triangles need the four corners, two of them on each other."""
SCHEMA = {
    "goal": str,
    "status": str,
    "key_points": list,
    "num_key_points": int,
    "positions": list,
    "method": str,
    "algorithm": str,
    "tolerance": float,
    "max_error": float,
    "rms_error": float,
    "certified": bool,
    "errors": dict,
    "seconds": float,
    "num_particles": int,
    "environment": dict,
}


def command(*options):
    """What `jaxsimp simplify` does, without another process."""
    return main(["simplify", *map(str, options)])


def save(path, **arrays):
    np.savez(path, **arrays)
    return path


@pytest.fixture
def letters(tmp_path):
    """Files of letters, of one body since each says how it is at rest."""
    return [
        save(tmp_path / f"{name}.npz", positions=goal, rest=ROPE.rest)
        for name, goal in LETTERS.items()
    ]


@pytest.fixture
def diagonal(tmp_path):
    return save(tmp_path / "fold.npz", positions=DIAGONAL, rest=CLOTH.rest, faces=CLOTH.faces)


@pytest.fixture
def result(tmp_path):
    """Runs the command, and gives its exit status and the JSON."""
    path = tmp_path / "result.json"
    return lambda *options: (command(*options, "--json", path), json.loads(path.read_text()))


# --- what it finds -------------------------------------------------------------------------------


def test_a_rope_is_simplified_as_by_the_library(letters, result):
    status, found = result(letters[1])
    (model,) = simplify_batch(ROPE, LETTERS["M"][None])
    assert status == 0
    assert {name: type(value) for name, value in found.items()} == SCHEMA
    assert found["goal"] == str(letters[1])
    assert found["status"] == "FITS"
    assert found["key_points"] == model.particles.tolist()
    assert found["num_key_points"] == len(found["key_points"]) == len(found["positions"]) == 5
    np.testing.assert_allclose(found["positions"], model.positions, atol=1e-9)
    assert (found["algorithm"], found["certified"]) == (model.method, True)
    assert found["tolerance"] == pytest.approx(0.015 * 0.5)
    assert found["errors"] == {str(s): e for s, e in zip(model.sizes, model.errors, strict=True)}
    assert found["errors"]["5"] < found["tolerance"] <= found["errors"]["4"]
    assert 0 < found["rms_error"] <= found["max_error"]
    assert found["seconds"] > 0
    assert found["num_particles"] == 41
    assert found["environment"]["versions"]["jax"]


def test_a_folded_cloth_has_its_corners(diagonal, result):
    status, found = result(diagonal)
    assert status == 0
    assert {name: type(value) for name, value in found.items()} == SCHEMA
    assert found["key_points"] == CORNERS
    # The model's corners are fitted to all particles; creases are lifted by 2 mm, a radius.
    np.testing.assert_allclose(found["positions"], DIAGONAL[CORNERS], atol=0.0021)
    assert found["tolerance"] == pytest.approx(0.03)


def test_a_cloth_needs_no_rest_coordinates(tmp_path, result):
    goal = save(tmp_path / "fold.npz", positions=DIAGONAL, faces=CLOTH.faces)
    status, found = result(goal)
    assert (status, found["key_points"]) == (0, CORNERS)


@pytest.mark.parametrize(
    ("of_body", "of_goal"), [("obj", "ply"), ("ply", "off"), ("off", "glb"), ("glb", "obj")]
)
def test_a_mesh_is_a_goal_of_a_body(of_body, of_goal, tmp_path, result):
    body, goal = tmp_path / f"body.{of_body}", tmp_path / f"goal.{of_goal}"
    trimesh.Trimesh(CLOTH.rest, CLOTH.faces, process=False).export(body)
    trimesh.Trimesh(DIAGONAL, CLOTH.faces, process=False).export(goal)
    status, found = result(goal, "--body", body)
    assert (status, found["key_points"]) == (0, CORNERS)


def test_a_body_may_be_an_npz_file(tmp_path, result):
    body = save(tmp_path / "cloth.npz", rest=CLOTH.rest[:, :2], faces=CLOTH.faces)
    goal = save(tmp_path / "goal.npz", positions=DIAGONAL)
    assert result(goal, "--body", body)[1]["key_points"] == CORNERS
    body = save(tmp_path / "rope.npz", rest=ROPE.rest)
    goal = save(tmp_path / "goal.npz", positions=LETTERS["V"])
    assert result(goal, "--body", body)[1]["key_points"] == [0, 20, 40]


def test_method_and_tolerance_are_used(letters, result):
    (model,) = simplify_batch(ROPE, LETTERS["M"][None], method="paper", tolerance=0.03)
    _, found = result(letters[1], "--method", "paper", "--tolerance", 0.03)
    assert found["key_points"] == model.particles.tolist()
    assert (found["algorithm"], found["tolerance"]) == (model.method, 0.03)
    assert not found["certified"]


def test_a_goal_without_a_model_has_exit_status_1(tmp_path, letters, result, capsys):
    wild = np.random.default_rng(0).uniform(0, 0.012, (41, 3)) + ROPE.rest
    goal = save(tmp_path / "wild.npz", positions=wild, rest=ROPE.rest)
    status, (first, second) = result(letters[0], goal, "--tolerance", 2e-3)
    assert status == 1
    assert (first["status"], second["status"]) == ("FITS", "NO_FIT")
    assert min(second["errors"].values()) >= 2e-3
    told = capsys.readouterr().out
    assert "NO_FIT" in told
    assert "…" not in told  # long paths are folded, not cut


def test_sizes_without_a_model_are_null():
    (model,) = simplify_batch(ROPE, LETTERS["V"][None])
    none = replace(model, sizes=(2, 3), errors=(np.inf, 0.0))
    found = simplify.row(
        simplify.SimplifiedGoal(Path("V.npz"), ROPE, LETTERS["V"], none, 1.0), "robust"
    )
    assert found["errors"] == {"2": None, "3": 0.0}


# --- workspaces ----------------------------------------------------------------------------------


def test_a_workspace_is_that_of_the_library(tmp_path, result):
    goal = LETTERS["V"] + [0.0, 0.1, -0.002]
    path = save(tmp_path / "low.npz", positions=goal, rest=ROPE.rest)
    limits = ("--lower", "-inf", "0.11", "-1", "--upper", "0.14", "inf", "inf")
    status, found = result(
        path, "--tolerance", 0.02, "--above-table", "--max-stretch", 0.05, *limits
    )
    workspace = Workspace(
        lower=(-np.inf, 0.11, -1.0),
        upper=(0.14, np.inf, np.inf),
        above_table=True,
        max_stretch=0.05,
    )
    (model,) = simplify_batch(ROPE, goal[None], tolerance=0.02, workspace=workspace)
    assert (status, found["status"]) == (0, "FITS")
    assert found["positions"] == model.positions.tolist()
    assert min(z for _, _, z in found["positions"]) == pytest.approx(ROPE.radius, abs=1e-7)
    assert min(y for _, y, _ in found["positions"]) == pytest.approx(0.11, abs=1e-7)
    assert max(x for x, _, _ in found["positions"]) <= 0.14 + 1e-7


def test_ends_are_fixed(letters, result):
    goal = LETTERS["M"]
    _, found = result(letters[1], "--fixed-ends")
    np.testing.assert_allclose(np.array(found["positions"])[[0, -1]], goal[[0, -1]], atol=1e-7)
    assert np.abs(np.array(result(letters[1])[1]["positions"])[0] - goal[0]).max() > 1e-5


def test_a_goal_that_no_workspace_holds_is_infeasible(
    letters, result, tmp_path, capsys, figures_saved
):
    options = ("--fixed-ends", "--upper", "1", "0.01", "1", "--figure", tmp_path / "goal.png")
    with figures_saved() as figures:
        status, found = result(letters[0], *options)
    model, errors = figures["goal.png"].axes
    rope, stars = model.lines[0], model.collections[-1]
    np.testing.assert_allclose(np.transpose(rope.get_data_3d()), LETTERS["V"])
    assert len(stars.get_offsets()) == 0  # the goal without a model
    assert not errors.lines  # no size was tried
    assert status == 1
    assert found.keys() == SCHEMA.keys()
    assert found["status"] == "INFEASIBLE"
    assert (found["key_points"], found["positions"], found["errors"]) == ([], [], {})
    assert (found["max_error"], found["rms_error"], found["certified"]) == (None, None, False)
    assert "INFEASIBLE" in capsys.readouterr().out


def test_a_workspace_of_a_surface_is_refused(diagonal, tmp_path, capsys):
    told = refused(capsys, tmp_path, diagonal, "--above-table", "--json", tmp_path / "out.json")
    assert "above_table" in told
    assert "is a surface of 1152 triangles; only models of ropes keep to a workspace" in told


# --- many files ----------------------------------------------------------------------------------


def test_files_of_one_body_are_one_batch_with_the_same_results(letters, result, monkeypatch):
    alone = [result(path)[1] for path in letters]
    sizes = []

    def counted(body, batch, **options):
        sizes.append(len(batch))
        return simplify_batch(body, batch, **options)

    monkeypatch.setattr(jaxsimp, "simplify_batch", counted)
    status, together = result(*letters)
    assert (status, sizes) == (0, [3])
    for one, other in zip(alone, together, strict=True):
        assert one["goal"] == other["goal"]
        assert one["key_points"] == other["key_points"]
        assert one["certified"] == other["certified"]
        # The search is in float32, and sums in another order in a batch of another size.
        np.testing.assert_allclose(one["positions"], other["positions"], atol=1e-6)
        assert one["errors"] == pytest.approx(other["errors"], abs=1e-6)


def test_bodies_may_be_mixed_and_goals_keep_their_order(letters, diagonal, result):
    order = [letters[0], diagonal, letters[2], letters[0]]
    _, found = result(*order)
    assert [each["goal"] for each in found] == [str(path) for path in order]
    assert [each["num_particles"] for each in found] == [41, 625, 41, 41]
    assert found[0]["key_points"] == found[3]["key_points"]


def test_files_of_the_same_name_both_appear(tmp_path, capsys, monkeypatch):
    paths = []
    for folder, letter in (("one", "V"), ("two", "M")):
        (tmp_path / folder).mkdir()
        paths.append(save(tmp_path / folder / "[b]goal.npz", positions=LETTERS[letter]))
    monkeypatch.chdir(tmp_path)
    names = [str(path.relative_to(tmp_path)) for path in paths]
    drawn = []
    monkeypatch.setattr("jaxsimp.viz.figures._title", lambda name: drawn.append(name) or name)
    assert command(*names, "--figure", "all.png", "--json", "all.json") == 0
    assert drawn == names
    told = capsys.readouterr().out
    assert all(name in told for name in names)
    assert [each["goal"] for each in json.loads(Path("all.json").read_text())] == names


# --- pictures ------------------------------------------------------------------------------------


def test_the_picture_shows_models_and_errors_beside_each_other(
    letters, diagonal, tmp_path, figures_saved
):
    paths = [*letters[:2], diagonal]
    with figures_saved() as figures:
        options = ("--figure", tmp_path / "goals.png", "--json", tmp_path / "goals.json")
        assert command(*paths, *options) == 0
    found = json.loads((tmp_path / "goals.json").read_text())
    models, errors = figures["goals.png"].axes[::2], figures["goals.png"].axes[1::2]
    for path, row, model, error in zip(paths, found, models, errors, strict=True):
        assert model.get_title() == path.stem
        stars = np.transpose(model.collections[-1]._offsets3d)
        np.testing.assert_allclose(stars, row["positions"])
        drawn = dict(zip(*error.lines[0].get_data(), strict=True))
        wanted = {int(size): 1e3 * value for size, value in row["errors"].items()}
        assert drawn == pytest.approx(wanted)
    assert (tmp_path / "goals.png").exists()


def test_files_of_another_unit_and_axis_are_taken_with_their_options(tmp_path, capsys):
    small = cloth((5, 5))
    stored = 1000 * small.rest[:, [0, 2, 1]] * np.array([1.0, 1.0, -1.0])
    for name in ("body.obj", "goal.obj"):
        trimesh.Trimesh(stored, small.faces, process=False).export(tmp_path / name)
    out = tmp_path / "out.json"
    files = (tmp_path / "goal.obj", "--body", tmp_path / "body.obj", "--json", out)
    told = refused(capsys, tmp_path, *files)
    assert "body.obj: the largest extent of the mesh is 300 m" in told
    assert "millimetres? scale=0.001" in told
    assert command(*files, "--scale", "0.001") == 2
    told = capsys.readouterr().err
    assert told.startswith(f"hint: {tmp_path / 'body.obj'} is flat and stands on edge, 0.3 m high")
    assert "under the table" in told
    assert command(*files, "--scale", "0.001", "--up", "y") == 0
    assert capsys.readouterr().err == ""
    wanted = jaxsimp.simplify(small, small.rest)
    assert json.loads(out.read_text())["key_points"] == wanted.particles.tolist()
    assert "up is 'w'; choose from x, y, z" in refused(capsys, tmp_path, *files, "--up", "w")
    assert "scale is 0.0; give a number" in refused(capsys, tmp_path, *files, "--scale", "0")


# --- refusals ------------------------------------------------------------------------------------


RAISED = CLOTH.rest + np.array([0.0, 0.0, 0.002])


def npz(**arrays):
    """Writes a file that has these arrays."""
    return lambda path: np.savez(path, **arrays)


def changed(index, value):
    positions = DIAGONAL.copy()
    positions[index] = value
    return npz(positions=positions, rest=CLOTH.rest, faces=CLOTH.faces)


WRONG = {
    "missing": (
        lambda path: None,
        "there is no such file; give an .npz file, written with np.savez",
    ),
    "text": (lambda path: path.write_text("positions"), "it is damaged, or is no .npz file"),
    "empty": (
        npz(goal=DIAGONAL),
        "it has no array 'positions' (it has goal); give an .npz file",
    ),
    "nan": (changed((7, 1), np.nan), "positions of particle 7 is"),
    "count": (
        npz(positions=DIAGONAL[:-1], rest=CLOTH.rest, faces=CLOTH.faces),
        "rest has 625 rows and positions has 624",
    ),
    "under": (changed((5, 2), -0.1), "particle 5 is 0.1 m under the table, which is at z = 0"),
    "stretched": (
        npz(positions=2 * RAISED, rest=CLOTH.rest, faces=CLOTH.faces),
        "m long between them. Give the goal in metres",
    ),
}


def refused(capsys, tmp_path, *options):
    """The one line that the command says, after checking that it wrote nothing."""
    before = sorted(tmp_path.rglob("*"))
    assert command(*options) == 2
    told = capsys.readouterr()
    assert told.out == ""
    assert told.err.startswith("error: ")
    assert told.err.count("\n") == 1
    assert sorted(tmp_path.rglob("*")) == before
    return told.err


@pytest.mark.parametrize("fault", WRONG)
def test_a_wrong_goal_is_named_with_the_reason(fault, letters, tmp_path, capsys):
    write, message = WRONG[fault]
    path = tmp_path / f"{fault}.npz"
    write(path)
    # It is refused whatever stands beside it, before anything is written.
    out = ("--json", tmp_path / "out.json", "--figure", tmp_path / "out.png")
    told = refused(capsys, tmp_path, letters[0], path, *out)
    assert f"error: {path}: " in told
    assert message in told


def test_a_goal_of_another_count_than_the_body_is_refused(letters, tmp_path, capsys):
    body = tmp_path / "body.ply"
    trimesh.Trimesh(CLOTH.rest, CLOTH.faces, process=False).export(body)
    told = refused(capsys, tmp_path, letters[0], "--body", body)
    assert "V.npz: the goal has shape (41, 3); give shape (625, 3), one row of x, y, z" in told


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("body.obj", "body.obj cannot be read as a mesh: it has no points ('v x y z'), or is no"),
        ("body.xyz", "body.xyz cannot be read as a mesh"),
        ("body.npz", "body.npz: it is damaged, or is no .npz file; give an .npz file, written"),
        ("missing.ply", "missing.ply cannot be read as a mesh: there is no such file"),
    ],
)
def test_a_body_that_is_none_is_refused(name, message, letters, tmp_path, capsys):
    if name.startswith("body"):
        (tmp_path / name).write_text("no mesh\n\nat all")
    assert message in refused(capsys, tmp_path, letters[0], "--body", tmp_path / name)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--method", "best"), "method is 'best'; choose from robust, paper"),
        (("--tolerance", "0"), "tolerance is 0.0; give a number from 1e-09 to 5 m"),
        (("--tolerance", "-1e-3"), "tolerance is -0.001; give a number from"),
        (("--tolerance", "nan"), "tolerance is nan; give a number from"),
        (("--max-stretch", "-0.1"), "max_stretch is -0.1; give a number from 0 to 10 of the"),
        (("--lower", "0", "0", "1", "--upper", "1", "1", "0"), "give an upper bound above the"),
        (("--json", "none/out.json"), "none is no folder; make it, or give another --json"),
        (("--figure", "none/out.png"), "none is no folder; make it, or give another --figure"),
        (("--json", "."), ". is a folder; give a file with --json"),
        (("--json", "V.npz"), "V.npz is another file of this command; give another --json"),
        (("--json", "a.png", "--figure", "a.png"), "a.png is another file of this command"),
        (("--figure", "out.txt"), "out.txt is no picture; give --figure a file in .jpg, .pdf"),
        ((*["V.npz"] * 40, "--figure", "out.png"), "41 goals are given; a picture shows 40"),
        (("--json", "a" * 256), "File name too long"),
        (("--figure", "\0.png"), "); give another --figure"),
    ],
)
def test_wrong_options_are_refused(options, message, letters, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert message in refused(capsys, tmp_path, "V.npz", *options)


def test_a_refusal_is_one_line_whatever_the_path(tmp_path, capsys):
    assert "two lines.npz: there is no such file" in refused(
        capsys, tmp_path, tmp_path / "two\nlines.npz"
    )


def test_no_goal_is_refused(tmp_path, capsys):
    assert "no goal is given; name at least one file" in refused(capsys, tmp_path)


@pytest.mark.slow
@pytest.mark.usefixtures("letters")
def test_the_command_runs_in_a_process_of_its_own(tmp_path):
    done = subprocess.run(
        [
            *(sys.executable, "-m", "jaxsimp", "simplify", "V.npz", "M.npz"),
            *("--json", "out.json", "--figure", "out.png"),
        ],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    words = [line for line in done.stderr.splitlines() if "jaxsimp: compiling " not in line]
    assert (done.returncode, words) == (0, [])
    # What people read has what they came for.
    for told in ("V.npz", "M.npz", "FITS", "0 20 40", "certified", "yes"):
        assert told in done.stdout
    assert [each["num_key_points"] for each in json.loads((tmp_path / "out.json").read_text())] == [
        3,
        5,
    ]
    assert (tmp_path / "out.png").exists()
    done = subprocess.run(
        [sys.executable, "-m", "jaxsimp", "simplify", "missing.npz"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1
