"""Plan files: saved, damaged, loaded."""

import io
import json
import zipfile
from typing import Any

import numpy as np
from hypothesis import strategies as st

import jaxsimp as js
from tests.fuzz.core import Door, Parameter
from tests.fuzz.files import FOLDER, FileCase, files, npz, on_disk
from tests.fuzz.values import anything, array, made

TASK = js.make_task("rope_folding", 5)
EPISODE = TASK.episode_fn(0)
T, G, N = TASK.num_actions, TASK.num_pickers, TASK.body.num_particles
PICK = np.zeros((T, G), int)
MOVE = 0.01 * np.ones((T, G, 3), np.float32)
FRAMES = np.stack([np.asarray(EPISODE.start)] * (T + 2))
PROVENANCE = {"python": "3", "commit": "unknown"}


def _saved(**changes: Any) -> bytes:
    """The bytes of a plan file, with other arguments of `save_plan`."""
    FOLDER.mkdir(exist_ok=True)
    path = FOLDER / "saved.npz"
    path.unlink(missing_ok=True)
    actions = js.Actions(changes.pop("pick", PICK), changes.pop("displacement", MOVE))
    positions, value = changes.pop("positions", FRAMES), changes.pop("score", 0.5)
    given = {
        "task": TASK,
        "episode": EPISODE,
        "actions": actions,
        "execution": js.Execution(positions, value, missed=0),
        "engine": js.MassSprings(),
        "provenance": PROVENANCE,
    }
    js.save_plan(path, **(given | changes))
    return path.read_bytes()


def _parts(content: bytes) -> dict[str, np.ndarray]:
    with np.load(io.BytesIO(content)) as file:
        return dict(file)


def _again(**changes: Any) -> bytes:
    """The file with other members; None leaves one out."""
    parts = _parts(GOOD) | changes
    return npz(**{name: value for name, value in parts.items() if value is not None})


def _about(**changes: Any) -> np.ndarray:
    about = json.loads(str(_parts(GOOD)["about"]))
    for name, value in changes.items():
        if name in about["task"]:
            about["task"][name] = value
        else:
            about[name] = value
    return np.array(json.dumps(about))


GOOD = _saved()
OLD = npz(pick=PICK, displacement=MOVE, positions=FRAMES.astype(np.float32))
ODD = {
    "no pick": _again(pick=None),
    "pick out of range": _again(pick=PICK + 99),
    "negative pick": _again(pick=PICK - 7),
    "float pick": _again(pick=PICK + 0.5),
    "text pick": _again(pick=np.array(["a"])),
    "flat pick": _again(pick=PICK.ravel()),
    "NaN displacement": _again(displacement=MOVE * np.nan),
    "displacement of another shape": _again(displacement=MOVE[:1]),
    "complex displacement": _again(displacement=MOVE.astype(complex)),
    "positions of another shape": _again(positions=FRAMES[:, :-1]),
    "too few positions": _again(positions=FRAMES[:1]),
    "text positions": _again(positions=np.array(["x"])),
    "start of another shape": _again(start=FRAMES[0, :-1]),
    "NaN start": _again(start=FRAMES[0] * np.nan),
    "goal of another shape": _again(goal=FRAMES[0, :-1]),
    "negative mass": _again(**{"body/mass": -TASK.body.mass}),
    "springs out of range": _again(**{"body/springs": TASK.body.springs + 99}),
    "no springs": _again(**{"body/springs": None}),
    "another array of the body": _again(**{"body/colour": np.ones(3)}),
    "about no JSON": _again(about=np.array("{")),
    "about a list": _again(about=np.array("[1]")),
    "about a number": _again(about=np.array(3.0)),
    "about empty": _again(about=np.array("{}")),
    "no task": _again(about=_about(task=None)),
    "unknown task": _again(about=_about(name="no such task")),
    "a number for a name": _again(about=_about(name=3)),
    "negative resolution": _again(about=_about(resolution=-1)),
    "huge resolution": _again(about=_about(resolution=10**9)),
    "limits of text": _again(about=_about(limits=["a", 1, 2])),
    "no actions": _again(about=_about(num_actions=0)),
    "NaN time step": _again(about=_about(time_step=float("nan"))),
    "huge time step": _again(about=_about(time_step=1e9)),
    "obstacle unknown": _again(about=_about(obstacles=[{"shape": "Cone"}])),
    "obstacle without numbers": _again(about=_about(obstacles=[{"shape": "Sphere"}])),
    "obstacles a number": _again(about=_about(obstacles=3)),
    "material unknown": _again(about=_about(body={"name": "rope"})),
}
MAY_LOAD = {
    "unknown task",
    "another array of the body",
    "about a number",
    "negative resolution",
    "huge time step",
}
PLAN_FILES = ((".npz", "plan", GOOD), (".npz", "plan of version 0.1", OLD))


def _load(path: Any) -> tuple[js.SavedPlan, js.Task | None]:
    saved = js.load_plan(path)
    return saved, None if saved.body is None else saved.task()


def _is_plan(path: FileCase) -> bool | None:
    if path.damage == "odd":
        return None if path.source in MAY_LOAD else False
    if path.content is None or path.damage in ("a folder", "empty", "noise"):
        return False
    return True if path.content in (GOOD, OLD) and not path.damage else None


def _check_plan(result: Any, path: FileCase) -> None:
    saved, task = result
    pick, displacement = np.asarray(saved.actions.pick), np.asarray(saved.actions.displacement)
    assert np.array_equal(pick, PICK), "other picks"
    assert np.array_equal(displacement, MOVE), "other displacements"
    assert saved.positions.shape == FRAMES.shape, f"positions of shape {saved.positions.shape}"
    if task is not None:
        assert np.array_equal(task.body.rest, TASK.body.rest), "another body"
        assert np.array_equal(saved.episode.goal, EPISODE.goal), "another goal"
        assert np.array_equal(saved.episode.start, EPISODE.start), "another start"
    elif path.source == "plan":
        with zipfile.ZipFile(io.BytesIO(path.content)) as file:
            assert "about.npy" not in file.namelist(), "the task is lost"


def _is_save(
    pick: Any = PICK,
    displacement: Any = MOVE,
    positions: Any = FRAMES,
    score: Any = 0.5,
    found: Any = None,
) -> bool | None:
    from tests.fuzz.valid import as_floats, both, is_array, is_number

    ids = as_floats(pick)
    if ids is None or ids.shape != PICK.shape or not np.isin(ids, range(-1, N)).all():
        return False
    whole = None if np.asarray(pick).dtype.kind in "iu" else False
    scored = is_number(score)
    nan = isinstance(score, float | np.floating) and not np.isfinite(score)  # kept as null
    plain = found is None or (isinstance(found, dict) and repr(found) == "{'a': 1}")
    return both(
        whole,
        is_array(displacement, MOVE.shape),
        is_array(positions, FRAMES.shape)
        or (
            None
            if np.shape(positions) == FRAMES.shape and as_floats(positions) is not None
            else False
        ),
        None if nan else scored,
        True if plain else (None if isinstance(found, dict) else False),
    )


def _check_saved(content: bytes, pick: Any = PICK, displacement: Any = MOVE, **_: Any) -> None:
    path = FOLDER / "again.npz"
    path.write_bytes(content)
    saved = js.load_plan(path)
    assert np.array_equal(np.asarray(saved.actions.pick), np.asarray(pick)), "other picks"
    wanted = np.asarray(displacement, dtype=saved.actions.displacement.dtype)
    assert np.array_equal(np.asarray(saved.actions.displacement), wanted), "other displacements"
    assert np.array_equal(saved.task().body.rest, TASK.body.rest), "another body"


ODD_FOUND = (
    lambda: {"a": object()},
    lambda: {"a": np.float32(1)},
    lambda: {"a": np.ones(2)},
    lambda: {"a": float("nan")},
    lambda: {1j: 1},
)
DOORS = (
    Door(
        "records.load_plan",
        on_disk(_load),
        {"path": files(PLAN_FILES, [(".npz", name, data) for name, data in ODD.items()])},
        _is_plan,
        _check_plan,
        weight=60,
    ),
    Door(
        "records.save_plan",
        _saved,
        {
            "pick": array(st.just(PICK), optional=True),
            "displacement": array(st.just(MOVE), optional=True),
            "positions": array(st.just(FRAMES), optional=True),
            "score": Parameter(st.sampled_from((0.5, -3.0)), anything),
            "found": Parameter(st.just({"a": 1}), made(ODD_FOUND) | anything),
        },
        _is_save,
        _check_saved,
        weight=20,
    ),
)
