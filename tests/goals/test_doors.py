"""What may be given by mistake instead of a goal: clouds, other units and axes, other files."""

import io
import re
import zipfile

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxsimp import goals
from jaxsimp.bodies import Garment, cloth, from_mesh, rope, t_shirt
from jaxsimp.goals import load_body, load_goal

ROPE = rope(41)
CLOTH = cloth((6, 5), (0.3, 0.2))
LETTER = goals.letter(ROPE, "S")
FOLDED = goals.fold(CLOTH, goals.flat(CLOTH), np.zeros(2), np.array([0.3, 1.0]))
seeds = st.integers(0, 10**6)


def save(path, **arrays):
    np.savez(path, **arrays)
    return path


# --- ropes in order ------------------------------------------------------------------------------


def accordion(body, strands: int):
    """A rope folded to and fro, strands a thickness apart; creases lie anywhere."""
    along = body.rest[:, 0] - body.rest[0, 0]
    length = body.size / strands
    x = np.abs((along / length + 1) % 2 - 1) * length
    y = 2 * body.radius * (along // length)
    return np.stack([x, y, np.full_like(x, body.radius)], axis=1)


def coil(body, radius: float):
    angle = (body.rest[:, 0] - body.rest[0, 0]) / radius
    height = body.radius * (1 + angle / np.pi)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)


def wander(body, rng):
    """A rope of which each step goes another way."""
    steps = rng.normal(size=(body.num_particles - 1, 3))
    steps *= body.spacing / np.linalg.norm(steps, axis=1, keepdims=True)
    points = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    return points - [0, 0, points[:, 2].min() - body.radius]


@given(
    count=st.integers(2, 300),
    length=st.floats(0.2, 2.0),
    noise=st.floats(0.0, 0.2),
    seed=seeds,
    shape=st.sampled_from(["straight", "S", "O", "triangle", "accordion", "coil", "wander"]),
)
def test_a_rope_in_order_is_let_in_whatever_its_folds_and_noise(
    count, length, noise, seed, shape, tmp_path
):
    body, rng = rope(count, length), np.random.default_rng(seed)
    positions = {
        "straight": goals.straight,
        "S": lambda body: goals.letter(body, "S"),
        "O": lambda body: goals.letter(body, "O"),
        "triangle": goals.crossed_triangle,
        "accordion": lambda body: accordion(body, max(1, min(8, count // 3))),
        "coil": lambda body: coil(body, max(0.03, body.size / 20)),
        "wander": lambda body: wander(body, rng),
    }[shape](body)
    if count < 12 and shape in ("S", "O", "triangle", "coil"):
        return  # too few particles for such a shape
    positions = positions + noise * min(body.spacing, 0.02) * rng.standard_normal(positions.shape)
    positions[:, 2] = np.maximum(positions[:, 2], 0.0)
    _, goal = load_goal(save(tmp_path / "goal.npz", positions=positions))
    np.testing.assert_array_equal(goal, positions)


@given(seed=seeds, rows=st.integers(8, 24), of_rope=st.booleans())
def test_a_cloud_without_order_is_refused(seed, rows, of_rope, tmp_path):
    rng = np.random.default_rng(seed)
    body = rope(rows**2) if of_rope else cloth((rows, rows), (0.1, 0.1))
    cloud = goals.flat(body)[rng.permutation(body.num_particles)]
    cloud[:, 0] = np.abs(cloud[:, 0])  # folded in half
    with pytest.raises(ValueError, match=r"in no order along a rope: .*Add faces for a sheet"):
        load_goal(save(tmp_path / "goal.npz", positions=cloud))


@pytest.mark.parametrize("shape", [(3, 3), (5, 5), (16, 16), (20, 3)])
def test_the_rows_of_a_cloth_are_no_rope(shape, tmp_path):
    body = cloth(shape, (0.2, 0.2))
    path = save(tmp_path / "goal.npz", positions=goals.flat(body))
    with pytest.raises(ValueError, match=r"no order along a rope: particles \d+ and \d+ are 0.2"):
        load_goal(path)
    load_goal(save(tmp_path / "goal.npz", positions=goals.flat(body), faces=body.faces))


# --- sizes ---------------------------------------------------------------------------------------


def test_a_goal_in_millimetres_is_told_and_taken_with_its_scale(tmp_path):
    path = save(tmp_path / "rope.npz", positions=1000 * LETTER)
    with pytest.raises(
        ValueError, match=r"rope\.npz: .* is [\d.]+ m; a body is 0\.01 to 5 m.*scale=0\.001"
    ):
        load_goal(path)
    np.testing.assert_allclose(load_goal(path, scale=1e-3)[1], LETTER, rtol=1e-12)
    sheet = {"rest": 1000 * CLOTH.rest[:, :2], "faces": CLOTH.faces}
    path = save(tmp_path / "cloth.npz", positions=1000 * FOLDED, **sheet)
    body, goal = load_goal(path, scale=1e-3)
    np.testing.assert_allclose(goal, FOLDED, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(body.rest, load_body(path, scale=1e-3).rest, atol=1e-15)
    np.testing.assert_allclose(body.rest, CLOTH.rest, atol=1e-12)
    with pytest.raises(
        ValueError, match=r"the goal .* m.* is the limit.*millimetres\? scale=0\.001"
    ):
        load_goal(path, CLOTH)


def test_a_goal_of_which_another_axis_is_up_is_taken_with_its_axis(tmp_path):
    tilted = FOLDED[:, [0, 2, 1]] * [1, 1, -1]
    np.save(tmp_path / "goal.npy", tilted)
    with pytest.raises(
        ValueError, match=r"under the table, .*turn it if another axis is up .up='y'"
    ):
        load_goal(tmp_path / "goal.npy", CLOTH)
    np.testing.assert_array_equal(load_goal(tmp_path / "goal.npy", CLOTH, up="y")[1], FOLDED)
    with pytest.raises(ValueError, match="up is 'Y'; choose from x, y, z"):
        load_goal(tmp_path / "goal.npy", CLOTH, up="Y")


@pytest.mark.parametrize("body", [ROPE, CLOTH], ids=["rope", "cloth"])
@pytest.mark.parametrize("door", [goals.as_goal, goals.check_goal])
def test_a_goal_has_a_size_as_the_body_has(body, door):
    goal = goals.flat(body)
    for factor, told in ((1e3, "millimetres"), (100.0, "centimetres"), (1e300, "scale is")):
        with pytest.raises(ValueError, match=rf"m.* is the limit. Give metres \({told}"):
            door(body, factor * goal)
    for far in (1e6, 1e16, 1e300, -1e308):
        astray = goal.copy()
        astray[2, 1] = far
        with pytest.raises(
            ValueError, match=r"has particle 2 at y = .* 50 m from the origin is the"
        ):
            door(body, astray)
    with pytest.raises(ValueError, match=r"has particle \d+ at y = .* 50 m from the origin"):
        door(body, goal + np.array([0.0, 1e3, 0.0]))
    astray = goal.copy()
    astray[2, 1] = 4.0
    with pytest.raises(
        ValueError, match=r"are neighbours, and 4.* m apart; the \w+ is only 0\.[35]"
    ):
        goals.as_goal(body, astray)
    door(body, goal + np.array([40.0, -40.0, 0.0]))


@pytest.mark.parametrize("body", [ROPE, CLOTH], ids=["rope", "cloth"])
@pytest.mark.parametrize("door", [goals.as_goal, goals.check_goal])
def test_a_goal_that_is_squeezed_to_nothing_is_refused(body, door):
    goal = goals.flat(body)
    place = np.tile([0.1, 0.2, 0.3], (body.num_particles, 1))
    with pytest.raises(
        ValueError, match=r"the edges of the .* have 0 of their length at rest; 0.1 is"
    ):
        door(body, place)
    with pytest.raises(ValueError, match=r"have 0\.001 of .*\(converted from millimetres twice\?"):
        door(body, 1e-3 * goal)
    door(body, place + 0.2 * goal)


def test_a_body_may_be_folded_rolled_and_crumpled_to_a_bundle():
    body = cloth((25, 25))
    quarter = goals.fold_sequence(body, goals.rectangle_folds(body, "quarter"))
    eighth = goals.fold(body, quarter, np.array([0.07, 0.07]), np.array([0.4, 1.0]))
    goals.check_goal(body, eighth)
    angle = (body.rest[:, 0] + 0.15) / 0.01  # a roll of 5 turns, coarser than the mesh
    roll = np.stack([0.01 * np.cos(angle), body.rest[:, 1], 0.02 + 0.01 * np.sin(angle)], axis=1)
    goals.check_goal(body, roll)
    goals.check_goal(ROPE, coil(ROPE, 0.02))
    goals.check_goal(ROPE, accordion(ROPE, 16))


@pytest.mark.usefixtures("unchecked_shapes")
def test_goals_of_other_types_and_orders_are_the_same_goal():
    given = FOLDED.astype(np.float32)
    for goal in (np.asfortranarray(given), given.tolist(), given[::1]):
        np.testing.assert_array_equal(goals.as_goal(CLOTH, goal), given.astype(float))
    assert goals.as_goal(rope(2, 1.0), [[0, 0, 0], [1, 0, 0]]).dtype == np.float64
    for wrong in (FOLDED + 0j, FOLDED > 0, FOLDED.astype(object), "goal", None, [[1], [1, 2]]):
        with pytest.raises(ValueError, match=r"the goal is .*; give real numbers, one row of x"):
            goals.as_goal(CLOTH, wrong)


# --- files of arrays -----------------------------------------------------------------------------


def test_an_npy_file_holds_positions_or_rest(tmp_path):
    np.save(tmp_path / "goal.npy", LETTER)
    body, goal = load_goal(tmp_path / "goal.npy")
    np.testing.assert_array_equal(goal, LETTER)
    assert body.num_particles == 41
    np.save(tmp_path / "rest.npy", np.asfortranarray(ROPE.rest))
    np.testing.assert_allclose(load_body(tmp_path / "rest.npy").rest, ROPE.rest, atol=1e-12)


def test_what_a_file_holds_beside_the_goal_of_a_body_does_not_matter(tmp_path):
    path = save(tmp_path / "goal.npz", positions=FOLDED, faces=np.ones(3), rest=np.array("flat"))
    np.testing.assert_array_equal(load_goal(path, CLOTH)[1], FOLDED)


def raw(**members: bytes) -> bytes:
    """A zip file with these members."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name.replace("_npy", ".npy"), content)
    return file.getvalue()


def bomb(shape) -> bytes:
    """The beginning of an array that claims a shape."""
    file = io.BytesIO()
    header = {"descr": "<f8", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(file, header)
    return file.getvalue() + bytes(10**5)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (raw(positions_npy=b"1 2 3"), "positions is no array in NumPy's format; write it with np"),
        (raw(positions=b"1 2 3"), r"no array 'positions' \(it has positions\); give an .npz file"),
        (raw(), r"it has no array 'positions' \(it has none\)"),
        (raw(positions_npy=bomb((10**8, 3))), r"has shape \(100000000, 3\); a body has 2500"),
        (raw(positions_npy=bomb((10**30,))), "a body has 250000 particles at most: give fewer"),
        (raw(positions_npy=bomb((10**5, 3))), "positions is cut short; write the file again"),
        (b"PK\x03\x04" + bytes(50), "it is damaged, or is no .npz file; give an"),
        (b"", "it is empty; give an .npz file, written with np.savez"),
    ],
    ids=["text", "other name", "nothing", "bomb", "overflow", "cut short", "damaged", "empty"],
)  # fmt: skip
def test_an_npz_file_of_another_kind_is_told(content, message, tmp_path):
    path = tmp_path / "goal.npz"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=re.escape(str(path)) + ": .*" + message):
        load_goal(path, CLOTH)


@given(seed=seeds, share=st.floats(0.0, 1.0))
def test_a_damaged_npz_file_is_told_by_the_file(seed, share, tmp_path):
    path = tmp_path / "goal.npz"
    np.savez_compressed(path, positions=FOLDED, rest=CLOTH.rest, faces=CLOTH.faces)
    content, rng = bytearray(path.read_bytes()), np.random.default_rng(seed)
    for place in rng.integers(0, len(content), 3):
        content[place] = rng.integers(256)
    path.write_bytes(content[: 1 + int(share * len(content))])
    try:
        load_goal(path)
    except ValueError:
        told = f"^{re.escape(str(path))}: .*(give|add|write|Give|Add)"
        with pytest.raises(ValueError, match=told):
            load_goal(path)


# --- bodies that do not lie flat -----------------------------------------------------------------


def cap():
    sheet = cloth((9, 9))
    return from_mesh(sheet.rest - [[0, 0, 2]] * (sheet.rest**2).sum(1, keepdims=True), sheet.faces)


def test_a_body_that_is_not_flat_is_not_folded_as_it_stands():
    body = cap()
    told = r"the mesh is 0\.09 m high at rest, .* simulation \(jaxsimp\.settle\) and go on from"
    with pytest.raises(ValueError, match=told):
        goals.flat(body)
    standing = body.rest + np.array([0.0, 0.0, body.radius])
    line = np.zeros(2), np.array([0.0, 1.0])
    with pytest.raises(ValueError, match=told):
        goals.fold(body, standing, *line)
    with pytest.raises(ValueError, match=told):
        goals.fold_sequence(body, [goals.Fold(*line)])
    lying = standing * [1, 1, 0.02]
    assert np.ptp(goals.fold(body, lying, *line)[:, 0]) < 0.6 * np.ptp(standing[:, 0])


def test_garments_of_two_sheets_are_flat():
    shirt = t_shirt(num_particles=200, sheets=2)
    goals.check_goal(shirt.body, goals.fold_sequence(shirt.body, goals.sleeves_in(shirt)))


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: goals.sleeves_in(CLOTH), "a Body is given; give a jaxsimp.Garment, which names"),
        (lambda: goals.leg_over_leg(None), "a NoneType is given; give a jaxsimp.Garment"),
        (
            lambda: goals.sleeves_in(Garment(CLOTH, {}, np.arange(30), np.arange(30))),
            "the cloth has no left_armpit; it has no landmarks: add it, or use goals.fold",
        ),
        (
            lambda: goals.fold(CLOTH, FOLDED, [0, 0], [0, 1], part=np.ones(29, bool)),
            r"part is an array of bool, shape \(29,\); give true or false for each of 30 particles",
        ),
        (
            lambda: goals.fold(CLOTH, FOLDED, [0, 0], [0, 1], part=[0, 1, 2]),
            r"part is an array of int64, shape \(3,\); give true or false",
        ),
        (lambda: goals.fold(CLOTH, FOLDED[:5], [0, 0], [0, 1]), r"positions has shape \(5, 3\)"),
        (lambda: goals.fold(CLOTH, FOLDED, [0, 0, 0], [0, 1]), r"point is \[0, 0, 0\]; give"),
        (lambda: goals.fold(CLOTH, FOLDED, 0, 1j), "point is 0; give finite coordinates x and y"),
        (lambda: goals.fold_sequence(CLOTH, 1), "folds is 1; give a list of Fold.point, direct"),
        (lambda: goals.fold_sequence(CLOTH, np.array(6)), r"folds is array\(6\); give a list"),
        (lambda: goals.fold_sequence(CLOTH, [()]), r"a fold is \(\); give a list of Fold"),
        (lambda: goals.rectangle_folds(CLOTH, np.zeros(0)), "fold is an array of .*; choose from"),
        (lambda: goals.lift_crossings(ROPE, ROPE.rest[:1]), r"shape \(1, 3\); give shape \(\d+, 3"),
        (lambda: goals.flat(CLOTH, "a"), "angle is 'a'; give a number"),
        (lambda: goals.turn(CLOTH.rest[:, :2], 1.0), r"positions is an array of shape \(30, 2\)"),
        (lambda: goals.straight(CLOTH), "the cloth has 40 triangles; only a rope is laid along"),
        (lambda: goals.letter(CLOTH, "S"), "the cloth has 40 triangles; only a rope"),
        (lambda: goals.straight(ROPE, 500), "length is 500; give a number from 0.001 to 5 m"),
        (lambda: goals.letter(ROPE, ["S"]), r"letter is \['S'\]; choose from C, M, O, S, U"),
    ],
)  # fmt: skip
def test_what_makes_no_goal_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
