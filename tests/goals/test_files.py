"""Goals from files: what was written comes back, with its body; what cannot be is named."""

import re

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from jaxsimp import goals
from jaxsimp.bodies import cloth, rope
from jaxsimp.bodies.garments import t_shirt
from jaxsimp.goals.files import load_body

CLOTH = cloth((6, 5), (0.3, 0.2))
FOLDED = goals.fold(CLOTH, goals.flat(CLOTH), np.zeros(2), np.array([0.3, 1.0]))
SHIRT = t_shirt(num_particles=150)
SLEEVES = goals.fold_sequence(SHIRT.body, goals.sleeves_in(SHIRT))


def save(path, **arrays):
    np.savez(path, **arrays)
    return path


@given(seed=st.integers(0, 10**6))
def test_a_goal_of_a_body_comes_back_to_the_bit(seed, tmp_path):
    noise = np.random.default_rng(seed).normal(scale=1e-3, size=FOLDED.shape)
    path = save(tmp_path / "goal.npz", positions=FOLDED + noise)
    body, goal = goals.load_goal(path, CLOTH)
    assert body is CLOTH
    np.testing.assert_array_equal(goal, FOLDED + noise)


@pytest.mark.parametrize("suffix", ["obj", "ply", "off", "glb"])
@pytest.mark.parametrize(("body", "wanted"), [(CLOTH, FOLDED), (SHIRT.body, SLEEVES)])
def test_a_mesh_file_holds_the_particles_in_order(suffix, body, wanted, tmp_path):
    path = tmp_path / f"goal.{suffix}"
    trimesh.Trimesh(wanted, body.faces, process=False).export(path)
    found, goal = goals.load_goal(str(path), body)
    assert found is body
    np.testing.assert_allclose(goal, wanted, atol=1e-6)  # float32 or 8 digits


def test_particles_that_coincide_in_a_mesh_file_are_not_welded(tmp_path):
    flat = CLOTH.rest.copy()
    flat[:, 0] = np.abs(flat[:, 0])  # two layers in one
    trimesh.Trimesh(flat, CLOTH.faces, process=False).export(tmp_path / "goal.ply")
    np.testing.assert_allclose(goals.load_goal(tmp_path / "goal.ply", CLOTH)[1], flat, atol=1e-6)


@pytest.mark.parametrize("axes", [2, 3])
def test_a_file_with_rest_and_faces_defines_a_sheet(axes, tmp_path):
    body = SHIRT.body
    path = save(
        tmp_path / "goal.npz", positions=SLEEVES, rest=body.rest[:, :axes] + 3.0, faces=body.faces
    )
    found, goal = goals.load_goal(path)
    np.testing.assert_allclose(found.rest, body.rest, atol=1e-12)
    np.testing.assert_array_equal(found.faces, body.faces)
    np.testing.assert_array_equal(goal, SLEEVES)


def test_a_file_with_rest_alone_defines_a_rope(tmp_path):
    rest = np.array([[0.0, 0.0], [0.1, 0.0], [0.15, 0.0], [0.25, 0.1]])
    positions = np.array([[0.0, 0, 0], [0, 0.1, 0], [0, 0.15, 0], [0.1, 0.2, 0]])
    body, _ = goals.load_goal(save(tmp_path / "goal.npz", positions=positions, rest=rest))
    assert body.name == "rope"
    steps = np.diff(body.rest[:, :2], axis=0)
    np.testing.assert_allclose(steps, np.diff(rest, axis=0), atol=1e-15)
    stretch = np.abs(np.diff(body.springs, axis=1))[:, 0] == 1
    np.testing.assert_allclose(
        body.rest_length[stretch], np.linalg.norm(np.diff(rest, axis=0), axis=1), rtol=1e-12
    )


@given(count=st.integers(21, 60), length=st.floats(0.2, 1.0), letter=st.sampled_from("SMU"))
def test_positions_alone_define_a_straight_rope(count, length, letter, tmp_path):
    positions = goals.letter(rope(count, length), letter)
    body, goal = goals.load_goal(save(tmp_path / "goal.npz", positions=positions))
    np.testing.assert_array_equal(goal, positions)
    spacing = np.median(np.linalg.norm(np.diff(positions, axis=0), axis=1))
    np.testing.assert_allclose(np.diff(body.rest[:, 0]), spacing, rtol=1e-9)
    np.testing.assert_array_equal(body.rest[:, 1:], 0.0)
    np.testing.assert_allclose(body.mass.sum(), rope().mass.sum(), rtol=1e-12)


def test_a_sheet_without_rest_is_laid_flat(tmp_path):
    line = np.array([0.0, 1.0])  # along the edges of the middle row
    body = cloth((7, 5), (0.3, 0.2))
    half = goals.fold(body, goals.flat(body), np.zeros(2), line)
    path = save(tmp_path / "goal.npz", positions=half, faces=body.faces)
    made, goal = goals.load_goal(path)
    np.testing.assert_array_equal(goal, half)
    np.testing.assert_array_equal(made.faces, body.faces)
    # A thickness of 4 mm lies on the crease; the long side is along x in both.
    a, b = made.rest[:, :2], body.rest[:, :2]
    assert min(np.abs(a - b).max(), np.abs(a + b).max()) < 1e-3
    np.testing.assert_array_equal(made.rest[:, 2], 0.0)


def test_a_sheet_without_rest_is_refused_if_creases_make_it_too_small(tmp_path):
    path = save(tmp_path / "goal.npz", positions=FOLDED, faces=CLOTH.faces)
    message = r"only .* m long between them.* laid flat from this goal, .*: add rest, or give"
    with pytest.raises(ValueError, match=message):
        goals.load_goal(path)
    found, _ = goals.load_goal(
        save(tmp_path / "goal.npz", positions=FOLDED, faces=CLOTH.faces, rest=CLOTH.rest)
    )
    np.testing.assert_allclose(found.rest, CLOTH.rest, atol=1e-12)


# --- bodies --------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", ["obj", "ply", "stl", "off", "glb"])
def test_a_mesh_file_is_a_body_at_rest(suffix, tmp_path):
    path = tmp_path / f"body.{suffix}"
    trimesh.Trimesh(SHIRT.body.rest, SHIRT.body.faces, process=False).export(path)
    body = load_body(path)
    if suffix == "stl":  # its points are those of its triangles, and welded
        assert (body.num_particles, len(body.faces)) == (150, len(SHIRT.body.faces))
        return
    np.testing.assert_array_equal(body.faces, SHIRT.body.faces)
    np.testing.assert_allclose(body.rest, SHIRT.body.rest, atol=1e-6)  # float32 or 8 digits


@pytest.mark.parametrize("axes", [2, 3])
def test_an_npz_file_is_a_body_at_rest(axes, tmp_path):
    path = save(tmp_path / "body.npz", rest=CLOTH.rest[:, :axes], faces=CLOTH.faces)
    body = load_body(path)
    np.testing.assert_array_equal(body.faces, CLOTH.faces)
    np.testing.assert_allclose(body.rest, CLOTH.rest, atol=1e-12)
    line = load_body(save(tmp_path / "rope.npz", rest=rope().rest[:, :axes]))
    assert (line.name, line.num_particles) == ("rope", 41)
    np.testing.assert_allclose(line.rest, rope().rest, atol=1e-12)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        (
            {"positions": CLOTH.rest},
            r"it has no array 'rest' \(it has positions\); give an .npz file, written with np",
        ),
        ({"rest": CLOTH.rest[:, :1]}, r"rest has shape \(30, 1\)"),
        (
            {"rest": CLOTH.rest, "faces": CLOTH.faces + 1},
            "a triangle names 30; the ids of 30 points are 0 to 29",
        ),
        (
            {"rest": np.concatenate([CLOTH.rest, CLOTH.rest[:2]]), "faces": CLOTH.faces},
            "2 of 32 particles coincide",
        ),
    ],
)
def test_a_file_that_is_no_body_is_refused(arrays, message, tmp_path):
    path = save(tmp_path / "body.npz", **arrays)
    with pytest.raises(ValueError, match=r"body\.npz: .*" + message):
        load_body(path)


def test_whole_numbers_are_positions_too(tmp_path):
    positions = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0]], dtype=np.int32)
    _, goal = goals.load_goal(save(tmp_path / "goal.npz", positions=positions))
    assert goal.dtype == np.float64


# --- refusals ------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", ["npz", "obj", "ply", "glb", "csv", ""])
@given(content=st.binary(max_size=200))
def test_random_bytes_are_refused_by_name(suffix, content, tmp_path, capfd):
    path = tmp_path / f"goal.{suffix}"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=re.escape(str(path))):
        goals.load_goal(path, CLOTH)
    assert capfd.readouterr() == ("", "")


def test_an_array_of_objects_is_not_unpickled(tmp_path):
    path = save(tmp_path / "goal.npz", positions=np.array([{}], dtype=object))
    with pytest.raises(
        ValueError, match=r"goal\.npz: positions is of object; give an array of real"
    ):
        goals.load_goal(path, CLOTH)


@pytest.mark.parametrize("name", ["missing.npz", "missing.obj"])
def test_a_file_that_is_missing_is_named(name, tmp_path):
    with pytest.raises(ValueError, match=f"{name}.*: there is no such file; give an"):
        goals.load_goal(tmp_path / name, CLOTH)


NAN = float("nan")
LINE = np.stack([0.1 * np.arange(4), np.zeros(4), np.zeros(4)], axis=1)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        (
            {"goal": LINE},
            r"no array 'positions' \(it has goal\); give an .npz file, written with np\.savez",
        ),
        ({"positions": LINE[:, :2]}, r"positions has shape \(4, 2\); give shape \(N, 3\)"),
        ({"positions": LINE[0]}, r"positions has shape \(3,\)"),
        ({"positions": LINE.astype(str)}, "positions is of <U32; give an array of real numbers"),
        ({"positions": LINE.astype(complex)}, "positions is of complex128"),
        (
            {"positions": LINE * NAN},
            r"positions of particle 0 is \[nan, nan, nan\] \(4 such particles\)",
        ),
        ({"positions": LINE * 0}, r"is 0 m; give particles that are apart, in order"),
        (
            {"positions": LINE[:1]},
            "positions has 1 rows; a rope has at least 2 particles: give more",
        ),
        (
            {"positions": LINE, "rest": LINE[:3]},
            "rest has 3 rows and positions has 4; give one row for each",
        ),
        ({"positions": LINE, "rest": LINE[:, :1]}, r"rest has shape \(4, 1\)"),
        (
            {"positions": LINE, "rest": LINE * 0},
            "particles 0 and 1 of the rope are",
        ),
        ({"positions": LINE - [0, 0, 1.0]}, "goal of particle 0 is 1 m under the table"),
        ({"positions": 2 * LINE, "rest": LINE}, "the rope is only .* m long between them"),
        (
            {"positions": FOLDED, "faces": CLOTH.faces[:20]},
            "the sheet must be a disc.* add rest, or give",
        ),
        (
            {"positions": FOLDED, "rest": CLOTH.rest - np.inf, "faces": CLOTH.faces},
            r"rest of particle 0 is \[-inf",
        ),
        (
            {"positions": FOLDED, "rest": CLOTH.rest, "faces": CLOTH.faces * 1.0},
            r"faces is an array of float64, shape \(40, 3\); give an array of whole",
        ),
        (
            {"positions": FOLDED, "rest": CLOTH.rest, "faces": CLOTH.faces[:, :2]},
            r"faces has shape \(40, 2\)",
        ),
        (
            {"positions": FOLDED, "rest": CLOTH.rest, "faces": CLOTH.faces + 1},
            "a triangle names 30; the ids of 30 points are 0 to 29",
        ),
        (
            {
                "positions": np.concatenate([FOLDED, FOLDED[:2]]),
                "rest": np.concatenate([CLOTH.rest, CLOTH.rest[:2]]),
                "faces": CLOTH.faces,
            },
            r"2 of 32 particles coincide with others at rest, or belong to no triangle",
        ),
    ],
)
@pytest.mark.usefixtures("unchecked_shapes")
def test_a_file_that_defines_no_body_and_goal_is_refused(arrays, message, tmp_path):
    path = save(tmp_path / "goal.npz", **arrays)
    with pytest.raises(ValueError, match=r"goal\.npz: .*" + message):
        goals.load_goal(path)


def test_a_goal_of_another_body_is_refused(tmp_path):
    path = save(tmp_path / "goal.npz", positions=FOLDED)
    with pytest.raises(ValueError, match=r"goal\.npz: the curve through the points"):
        goals.load_goal(path, rope())
    with pytest.raises(ValueError, match=r"goal\.npz: laid flat, .* beyond the T-shirt"):
        goals.load_goal(path, SHIRT.body)


def test_a_mesh_that_repeats_its_points_is_registered(tmp_path):
    stl = tmp_path / "goal.stl"
    trimesh.Trimesh(FOLDED, CLOTH.faces, process=False).export(stl)
    with pytest.warns(UserWarning, match=r"its 120 points are not the 30 particles of the cloth"):
        _, goal = goals.load_goal(stl, CLOTH, start=FOLDED)
    np.testing.assert_allclose(goal, FOLDED, atol=1e-6)  # float32


def test_an_unordered_cloud_in_millimetres_with_y_up_is_registered(tmp_path):
    bent = goals.flat(CLOTH)
    bent[:, 2] += 0.02 * np.cos(bent[:, 0] / 0.2)
    order = np.random.default_rng(0).permutation(len(bent))
    y_up = 1e3 * bent[order][:, [0, 2, 1]] * [1, 1, -1]
    np.save(tmp_path / "goal.npy", y_up)
    with pytest.warns(UserWarning, match="were registered to them, within .* 4 ways fit"):
        _, goal = goals.load_goal(tmp_path / "goal.npy", CLOTH, scale=1e-3, up="y", start=bent)
    np.testing.assert_allclose(goal, bent, atol=1e-12)


def test_a_frame_of_several_is_chosen(tmp_path):
    frames = np.stack([goals.flat(CLOTH), goals.flat(CLOTH) + 0.01, FOLDED])
    np.save(tmp_path / "frames.npy", frames)
    np.testing.assert_array_equal(goals.load_goal(tmp_path / "frames.npy", CLOTH)[1], FOLDED)
    for frame in (0, 1, -3):
        _, goal = goals.load_goal(tmp_path / "frames.npy", CLOTH, frame=frame)
        np.testing.assert_array_equal(goal, frames[frame])
    with pytest.raises(ValueError, match="frame is 3; give a whole number from -3 to 2"):
        goals.load_goal(tmp_path / "frames.npy", CLOTH, frame=3)
    np.save(tmp_path / "none.npy", frames[:0])
    with pytest.raises(ValueError, match="the number of frames is 0"):
        goals.load_goal(tmp_path / "none.npy", CLOTH)


def test_a_mesh_file_alone_is_no_goal(tmp_path):
    path = tmp_path / "goal.ply"
    trimesh.Trimesh(FOLDED, CLOTH.faces, process=False).export(path)
    with pytest.raises(ValueError, match=r"goal\.ply: a mesh does not say how it is at rest"):
        goals.load_goal(path)
