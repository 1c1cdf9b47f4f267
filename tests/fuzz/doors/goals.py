"""Goals: shapes, folds, checks, and files of goals and bodies."""

from typing import Any

import numpy as np
from hypothesis import strategies as st

import jaxsimp as js
from jaxsimp import goals
from jaxsimp.bodies import load_mesh, read_mesh
from tests.fuzz.core import Door, Parameter
from tests.fuzz.files import FileCase, bomb, files, mesh_files, npy, npz, on_disk
from tests.fuzz.meshes import grid
from tests.fuzz.valid import (
    as_floats,
    both,
    extent,
    in_range,
    is_array,
    is_one_of,
    is_size,
)
from tests.fuzz.values import anything, array, choice, number, value_of

ROPE, CLOTH = js.rope(9), js.cloth((5, 5))
SHIRT = js.t_shirt(num_particles=160)
TOWEL = js.towel(num_particles=160)
GOALS = {
    id(ROPE): [goals.straight(ROPE), goals.letter(ROPE, "S"), goals.flat(ROPE, 0.3)],
    id(CLOTH): [
        goals.flat(CLOTH),
        goals.fold_sequence(CLOTH, goals.rectangle_folds(CLOTH, "side")),
        goals.fold_sequence(CLOTH, goals.rectangle_folds(CLOTH, "diagonal")),
    ],
}
"""Goals of each body that are valid."""


def goals_of(body: js.Body) -> st.SearchStrategy[np.ndarray]:
    """Goals of a body, with little noise, anywhere on the table."""

    def placed(goal: np.ndarray, seed: int) -> np.ndarray:
        if not seed:
            return goal.copy()
        rng = np.random.default_rng(seed)
        noise = rng.normal(scale=1e-3, size=goal.shape) * [1.0, 1.0, 0.0]
        place = np.array([*rng.uniform(-0.5, 0.5, 2), 0.0])
        return goals.turn(goal + noise, rng.uniform(-3, 3)) + place

    return st.builds(placed, st.sampled_from(GOALS[id(body)]), st.integers(0, 1000))


def is_goal(body: js.Body, goal: Any, *, strict: bool) -> bool | None:
    """Whether a goal can be reached: in reach of the body, above the table, not squeezed."""
    shape = is_array(goal, body.rest.shape)
    if shape is False:
        return False
    points = as_floats(goal)
    size = float(np.ptp(points, axis=0).max())
    if size > 5.001 or size < 1e-3 * body.size or np.abs(points).max() > 1e4:
        return False
    if not strict:
        return both(shape, None if size > 1.5 * body.size or size < 0.1 * body.size else True)
    if size > 2.0 * body.size or points[:, 2].min() < -0.1 * body.size:
        return False
    near = any(_is_moved(points, each) for each in GOALS[id(body)])
    return both(shape, True if near else None)


def _is_moved(points: np.ndarray, goal: np.ndarray) -> bool:
    """Whether points are a goal with little noise, moved and turned on the table."""
    distances = [np.linalg.norm(each[:, None] - each[None], axis=2) for each in (points, goal)]
    return bool(np.abs(distances[0] - distances[1]).max() < 0.02 and points[:, 2].min() > -1e-9)


def _check_same(result: np.ndarray, body: Any, goal: Any, **_: Any) -> None:
    assert isinstance(result, np.ndarray), f"a {type(result).__name__}"
    assert result.dtype == np.float64, f"an array of {result.dtype}"
    assert np.array_equal(result, as_floats(goal)), "the goal changed"


def _check_positions(result: Any, **_: Any) -> None:
    assert isinstance(result, np.ndarray), f"a {type(result).__name__}"
    assert np.isfinite(result).all(), "a position is not finite"


def _check_turned(result: Any, positions: Any, angle: Any) -> None:
    _check_positions(result)
    given = as_floats(positions)
    for axes in (slice(0, 2), slice(2, 3)):
        lengths = [np.linalg.norm(each[:, axes], axis=1) for each in (result, given)]
        assert np.allclose(*lengths, atol=1e-6 * (1 + np.abs(given).max())), "lengths changed"


def _check_rope(result: Any, body: js.Body = ROPE, **_: Any) -> None:
    _check_positions(result)
    assert result.shape == body.rest.shape, f"shape {result.shape}"
    steps = np.linalg.norm(np.diff(result, axis=0), axis=1)
    assert steps.max() < 1.3 * body.size, "a step is longer than the rope"


def _check_registered(result: Any, body: js.Body, **_: Any) -> None:
    _check_positions(result.positions)
    assert result.positions.shape == body.rest.shape, f"shape {result.positions.shape}"
    assert np.isfinite(result.error), "the error is not finite"
    assert result.num_alike >= 1, "no way"


def _check_fold(result: Any, body: js.Body, positions: Any = None, **_: Any) -> None:
    _check_positions(result)
    assert result.shape == body.rest.shape, f"shape {result.shape}"
    lowest = 0.0 if positions is None else min(0.0, as_floats(positions)[:, 2].min())
    assert result[:, 2].min() > lowest - 1e-9, "a particle is under the table"


def _is_angle(angle: Any) -> bool | None:
    return in_range(angle, -1e3, 1e3, absurd=(-1e307, 1e307))


def _is_fold(body: Any, positions: Any, point: Any, direction: Any, part: Any = None) -> Any:
    line = both(is_array(point, (2,)), is_array(direction, (2,)))
    if line is False or np.linalg.norm(as_floats(direction)) == 0:
        return False
    whole = is_array(positions, body.rest.shape)
    mask = np.asarray(part)
    fine = part is None or (mask.dtype == bool and mask.shape == (body.num_particles,))
    length = np.linalg.norm(as_floats(direction))
    far = np.abs(as_floats(point)).max() > 10 or not 1e-100 < length < 1e100
    known = whole is not False and is_size(extent(positions))
    return both(line, whole, fine, None if far or not known else True)


WHERE = np.array([0.03, 0.01])
ALONG = np.array([0.3, 1.0])


def _fold_lists() -> st.SearchStrategy[Any]:
    one = st.builds(
        goals.Fold,
        array(st.just(WHERE)).hostile | st.just(WHERE),
        array(st.just(ALONG)).hostile | st.just(ALONG),
    )
    return st.lists(one | anything, min_size=1, max_size=2)


def _is_sequence(body: Any, folds: Any, positions: Any = None) -> bool | None:
    if not isinstance(folds, list | tuple) or not len(folds):
        return None if hasattr(folds, "__iter__") and not isinstance(folds, bytes) else False
    if not all(isinstance(each, goals.Fold) for each in folds):
        return False
    at = goals.flat(body) if positions is None else positions
    each = [_is_fold(body, at, one.point, one.direction, one.part) for one in folds]
    return both(*each)


def _places(goal: Any, **_: Any) -> Any:
    return goal


# Files of goals.

SHEET, FOLDED = CLOTH.rest, GOALS[id(CLOTH)][1]
MESHES = mesh_files(*grid(5))
SHUFFLED = np.random.default_rng(1).permutation(GOALS[id(ROPE)][1])
WHOLE = (
    (".npz", "rope", npz(positions=GOALS[id(ROPE)][1])),
    (".npz", "rope with rest", npz(positions=GOALS[id(ROPE)][1], rest=ROPE.rest)),
    (".npz", "sheet", npz(positions=FOLDED, rest=SHEET, faces=CLOTH.faces)),
    (".npz", "flat sheet", npz(positions=FOLDED, rest=SHEET[:, :2], faces=CLOTH.faces)),
    (".npz", "float32", npz(positions=FOLDED.astype(np.float32), rest=SHEET, faces=CLOTH.faces)),
)
ODD = (
    (".npz", "unordered cloud", npz(positions=np.random.default_rng(0).permutation(FOLDED))),
    (".npz", "shuffled rope", npz(positions=SHUFFLED)),
    (".npz", "millimetres", npz(positions=1e3 * GOALS[id(ROPE)][1])),
    (
        ".npz",
        "millimetres of a sheet",
        npz(positions=1e3 * FOLDED, rest=1e3 * SHEET, faces=CLOTH.faces),
    ),
    (".npz", "one place", npz(positions=np.zeros((9, 3)))),
    (".npz", "no positions", npz(points=FOLDED)),
    (".npz", "objects", npz(positions=np.array([None, "a"], dtype=object))),
    (".npz", "text", npz(positions=np.array(["a", "b"]))),
    (".npz", "complex", npz(positions=FOLDED.astype(complex))),
    (".npz", "NaN", npz(positions=FOLDED * np.nan)),
    (".npz", "one NaN", npz(positions=np.concatenate([FOLDED[:-1], [[np.nan] * 3]]))),
    (".npz", "other length of rest", npz(positions=FOLDED, rest=SHEET[:-1], faces=CLOTH.faces)),
    (".npz", "float faces", npz(positions=FOLDED, rest=SHEET, faces=CLOTH.faces * 1.0)),
    (".npz", "faces out of range", npz(positions=FOLDED, rest=SHEET, faces=CLOTH.faces + 20)),
    (".npz", "negative faces", npz(positions=FOLDED, rest=SHEET, faces=CLOTH.faces - 3)),
    (".npz", "flat faces", npz(positions=FOLDED, rest=SHEET, faces=CLOTH.faces.ravel())),
    (".npz", "faces of text", npz(positions=FOLDED, rest=SHEET, faces=np.array(["a"]))),
    (".npz", "no faces", npz(positions=FOLDED, rest=SHEET, faces=CLOTH.faces[:0])),
    (".npz", "no rows", npz(positions=FOLDED[:0])),
    (".npz", "one row", npz(positions=FOLDED[:1])),
    (".npz", "a scalar", npz(positions=np.array(1.0))),
    (".npz", "a bomb", bomb("positions")),
    (".npz", "under the table", npz(positions=GOALS[id(ROPE)][1] - [0.0, 0.0, 1.0])),
    (".npz", "far stretched", npz(positions=9 * FOLDED, rest=SHEET, faces=CLOTH.faces)),
    (".npz", "no array", b"PK\x05\x06" + bytes(18)),
    (".npy", "an array alone", npy(GOALS[id(ROPE)][1])),
    (".npy", "an array of a cloud", npy(np.random.default_rng(0).permutation(FOLDED))),
    (".usd", "USD", b'#usda 1.0\ndef Mesh "m" {}\n'),
    (".obj", "mesh", MESHES[".obj"]),
    (".txt", "text", b"0 0 0\n1 0 0\n"),
)
SURELY_WRONG = {source for _, source, _ in ODD} - {"an array alone", "no faces"}
BODY_FILES = (
    (".npz", "rope", npz(rest=ROPE.rest)),
    (".npz", "sheet", npz(rest=SHEET, faces=CLOTH.faces)),
    (".npz", "flat sheet", npz(rest=SHEET[:, :2], faces=CLOTH.faces)),
    *((end, f"mesh {end}", content) for end, content in MESHES.items()),
)
MESH_FILES = tuple((end, f"mesh {end}", content) for end, content in MESHES.items())


def _grouped() -> bytes:
    """An OBJ file whose triangles are of two materials, in two groups, with texture points."""
    points, faces = grid(5)
    lines = ["mtllib none.mtl", *("v {:.9g} {:.9g} {:.9g}".format(*p) for p in points)]
    lines += ["vt 0 0", "vt 1 0", "vt 0 1"]
    for name, part in (("a", faces[len(faces) // 2 :]), ("b", faces[: len(faces) // 2])):
        lines += [f"g {name}", f"usemtl {name}"]
        lines += [" ".join(["f", *(f"{i + 1}/{1 + i % 3}" for i in face)]) for face in part]
    return "\n".join([*lines, ""]).encode()


GROUPED = (".obj", "mesh of two materials", _grouped())


def _is_whole(file: FileCase, sources: tuple[tuple[str, str, bytes], ...]) -> bool | None:
    if file.content is None or file.damage in ("a folder", "empty", "noise"):
        return False
    if any(content == file.content for _, _, content in sources):
        return True if not file.damage else None
    return None


def _is_goal_file(path: FileCase) -> bool | None:
    if path.damage == "odd":
        return False if path.source in SURELY_WRONG else None
    return _is_whole(path, WHOLE)


def _check_goal_file(result: Any, path: FileCase) -> None:
    body, goal = result
    assert np.isfinite(goal).all(), "a position is not finite"
    assert goal.shape == body.rest.shape, "another shape than the body's"
    assert 0.02 * 0.99 <= body.size <= 5.05, f"the body is {body.size:g} m large"
    is_rope = "rope" in path.source or path.source == "an array alone"
    if path.damage in ("", "flipped bits", "truncated", "swapped members") and path.source:
        assert bool(len(body.faces)) != is_rope, f"a file of a {path.source} gives a {body.name}"
        wanted = GOALS[id(ROPE)][1] if is_rope else FOLDED
        near = goal.shape == wanted.shape and np.allclose(goal, wanted, atol=1e-6)
        assert near, "other positions than those of the file before it was damaged"


def _is_goal_of_body(path: FileCase) -> bool | None:
    if path.source in ("mesh .stl", "unordered cloud"):  # registered, if they can be
        return True if path.source == "mesh .stl" and not path.damage else None
    if path.source == "mesh .glb":
        return None if path.damage else _is_whole(path, MESH_FILES)
    return _is_whole(path, (*MESH_FILES, GROUPED, *WHOLE[2:]))


def _check_goal_of_body(result: Any, path: FileCase) -> None:
    body, goal = result
    assert body is FLAT, "another body"
    assert goal.shape == (25, 3), f"shape {goal.shape}"
    assert np.isfinite(goal).all(), "a position is not finite"
    if path.source.startswith("mesh") and not path.damage:
        assert np.allclose(goal, grid(5)[0], atol=1e-6), "other points, or in another order"


FLAT = js.cloth((5, 5), (0.3, 0.3))


def _check_body_file(body: js.Body, path: FileCase) -> None:
    assert np.isfinite(body.rest).all(), "a position is not finite"
    if not path.damage:
        wanted = ROPE.rest if path.source == "rope" else SHEET
        same = body.rest.shape == wanted.shape and np.allclose(
            np.ptp(body.rest, axis=0), np.ptp(wanted, axis=0), atol=1e-6
        )
        assert same, "another body than that of the file"


def _check_read(result: Any, path: FileCase) -> None:
    points, faces = result
    assert points.dtype == np.float64, f"points of {points.dtype}"
    assert faces.size, "no triangles"
    if not path.damage:  # ids are documented to be unchecked
        assert faces.min() >= 0, "an id is below zero"
        assert faces.max() < len(points), "an id is too large"
        is_soup = path.source == "mesh .stl"  # which repeats its points
        assert is_soup or len(points) == 25, f"{len(points)} points for 25"
        assert is_soup or np.allclose(points, grid(5)[0], atol=1e-6), "another order of points"


ropes = value_of(st.sampled_from([ROPE]))
cloths = Parameter(st.sampled_from([CLOTH]), st.sampled_from([CLOTH]), False)
goal_files = files(WHOLE, ODD)

DOORS = (
    *(
        Door(
            f"goals.{name}.{body.name}",
            lambda goal, body=body, function=function: function(body, goal),
            {"goal": array(goals_of(body))},
            lambda goal, body=body, strict=strict: is_goal(body, goal, strict=strict),
            lambda result, goal, body=body: _check_same(result, body, goal),
            weight=15,
        )
        for name, function, strict in (
            ("as_goal", goals.as_goal, False),
            ("check_goal", goals.check_goal, True),
        )
        for body in (ROPE, CLOTH)
    ),
    Door(
        "goals.flat",
        goals.flat,
        {"body": cloths, "angle": number(-3.0, 3.0)},
        lambda body, angle=0.0: _is_angle(angle),
        _check_positions,
    ),
    Door(
        "goals.turn",
        goals.turn,
        {"positions": array(goals_of(CLOTH)), "angle": number(-3.0, 3.0, optional=False)},
        lambda positions, angle: both(is_array(positions, (None, 3)), _is_angle(angle), None),
        _check_turned,
    ),
    Door(
        "goals.polyline",
        lambda corners: goals.polyline(ROPE, corners),
        {"corners": array(st.just(np.array([[0.0, 0.0], [0.2, 0.1], [0.3, -0.1]])))},
        lambda corners: both(
            is_array(corners, (None, 2)),
            is_array(corners, (None, 2)) is not False and len(corners) > 1,
            None,
        ),
        _check_positions,
    ),
    Door(
        "goals.straight",
        lambda length=None: goals.straight(ROPE, length),
        {"length": number(0.1, 0.5)},
        lambda length=None: (
            True if length is None else in_range(length, 0.1, 0.5, absurd=(1e-9, 5.001))
        ),
        _check_positions,
    ),
    Door(
        "goals.letter",
        lambda name, slack=0.0: goals.letter(ROPE, name, slack),
        {"name": choice(*"CMOSU", optional=False), "slack": number(0.0, 0.5)},
        lambda name, slack=0.0: both(
            is_one_of(name, "CMOSU") and len(name) == 1,
            in_range(slack, 0.0, 0.5, absurd=(0.0, 1 - 1e-15)),
        ),
        _check_rope,
    ),
    Door(
        "goals.crossed_triangle",
        lambda slack=0.0, tail=0.5: goals.crossed_triangle(ROPE, slack, tail),
        {"slack": number(0.0, 0.5), "tail": number(0.1, 2.0)},
        lambda slack=0.0, tail=0.5: both(
            in_range(slack, 0.0, 0.5, absurd=(0.0, 1 - 1e-15)),
            in_range(tail, 0.1, 2.0, absurd=(1e-300, 1e12)),
        ),
        _check_rope,
    ),
    Door(
        "goals.lift_crossings",
        lambda positions: goals.lift_crossings(ROPE, positions),
        {"positions": array(goals_of(ROPE))},
        lambda positions: both(is_array(positions, (9, 3)), None),
        _check_positions,
    ),
    Door(
        "goals.register.cloud",
        lambda points, start=None: goals.register(CLOTH, points, start=start),
        {
            "points": array(goals_of(CLOTH)),
            "start": array(st.just(goals.flat(CLOTH)), optional=True),
        },
        lambda points, start=None: both(
            is_array(points, (None, 3)), start is None or is_array(start, (25, 3)), None
        ),
        lambda result, **_: _check_registered(result, CLOTH),
        weight=5,
    ),
    Door(
        "goals.register.mesh",
        lambda points, faces: goals.register(CLOTH, points, faces),
        {"points": array(st.just(goals.flat(CLOTH))), "faces": array(st.just(CLOTH.faces))},
        lambda points, faces: both(
            is_array(points, (None, 3)),
            faces is None or is_array(faces, (None, 3), "iu"),
            None,
        ),
        lambda result, **_: _check_registered(result, CLOTH),
        weight=5,
    ),
    Door(
        "goals.register.rope",
        lambda points: goals.register(ROPE, points),
        {"points": array(goals_of(ROPE))},
        lambda points: both(is_array(points, (None, 3)), None),
        lambda result, **_: _check_registered(result, ROPE),
        weight=5,
    ),
    Door(
        "goals.fold",
        lambda positions, point, direction, part=None: goals.fold(
            CLOTH, positions, point, direction, part=part
        ),
        {
            "positions": array(st.just(goals.flat(CLOTH))),
            "point": array(st.just(WHERE)),
            "direction": array(st.just(ALONG)),
            "part": array(st.just(CLOTH.rest[:, 1] > 0), optional=True),
        },
        lambda **given: _is_fold(CLOTH, **given),
        lambda result, positions, **_: _check_fold(result, CLOTH, positions),
        weight=15,
    ),
    Door(
        "goals.fold_sequence",
        lambda folds, positions=None: goals.fold_sequence(CLOTH, folds, positions),
        {
            "folds": Parameter(
                st.sampled_from([goals.rectangle_folds(CLOTH, "quarter")]),
                _fold_lists() | anything,
                optional=False,
            ),
        },
        lambda folds: _is_sequence(CLOTH, folds),
        lambda result, **_: _check_fold(result, CLOTH),
    ),
    Door(
        "goals.rectangle_folds",
        lambda name: goals.rectangle_folds(CLOTH, name),
        {"name": choice("side", "diagonal", "quarter", "letter", "four_corners", optional=False)},
        lambda name: is_one_of(name, ("side", "diagonal", "quarter", "letter", "four_corners")),
        weight=4,
    ),
    Door(
        "goals.sleeves_in",
        goals.sleeves_in,
        {"shirt": Parameter(st.just(SHIRT), st.sampled_from([TOWEL, CLOTH]) | anything, False)},
        lambda shirt: shirt is SHIRT,
        weight=4,
    ),
    Door(
        "goals.load_goal",
        on_disk(goals.load_goal),
        {"path": goal_files},
        _is_goal_file,
        _check_goal_file,
        weight=40,
    ),
    Door(
        "goals.load_goal.of_body",
        on_disk(lambda path: goals.load_goal(path, FLAT)),
        {"path": files((*MESH_FILES, GROUPED, *WHOLE[2:]), ODD)},
        _is_goal_of_body,
        _check_goal_of_body,
        weight=20,
    ),
    Door(
        "goals.load_body",
        on_disk(goals.load_body),
        {"path": files((*BODY_FILES, GROUPED), ODD)},
        lambda path: _is_whole(path, (*BODY_FILES, GROUPED)),
        _check_body_file,
        weight=20,
    ),
    Door(
        "bodies.read_mesh",
        on_disk(read_mesh),
        {"path": files((*MESH_FILES, GROUPED))},
        lambda path: _is_whole(path, (*MESH_FILES, GROUPED)),
        _check_read,
        weight=30,
    ),
    Door(
        "bodies.load_mesh",
        on_disk(load_mesh),
        {"path": files((*MESH_FILES, GROUPED)), "scale": number(0.5, 2.0)},
        lambda path, scale=1.0: both(
            _is_whole(path, (*MESH_FILES, GROUPED)), in_range(scale, 0.1, 10, absurd=(1e-9, 1e9))
        ),
        weight=10,
    ),
)
