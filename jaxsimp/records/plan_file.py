"""Plan files: a plan to view, replay and export without the study that made it.

A file is an `.npz` of plain arrays: the actions, the motion, start and goal, the body's arrays
under `body/`, and one JSON text, `about`: task, engine, score and environment. Files of version
0.1, with actions and motion only, remain readable.
"""

import dataclasses
import io
import json
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from jaxtyping import Float

from jaxsimp.bodies import Body, Material
from jaxsimp.checks import as_reals
from jaxsimp.dynamics import Actions, Obstacle, Pinch
from jaxsimp.dynamics.arrays import as_array
from jaxsimp.dynamics.contact.obstacles import SHAPES
from jaxsimp.dynamics.pickers import checked_actions, require_actions
from jaxsimp.engines import Execution
from jaxsimp.records.files import whole_file
from jaxsimp.records.provenance import environment
from jaxsimp.tasks import COSTS, Episode, FixedStart, Task, distance_cost, make_task, task_names
from jaxsimp.tasks.episode import require_episode

SETTINGS = ("limits", "num_actions", "num_pickers", "action_seconds", "settle_actions")
"""Numbers of a task that a file stores."""
MOST_BYTES = 2 * 10**9
"""Most bytes that a file may unpack to; a plan of 100 actions of 100,000 particles has 250 MB."""
UNREADABLE = (
    ValueError,
    OSError,
    EOFError,
    TypeError,
    KeyError,
    NotImplementedError,  # of zipfile, for a compression that it does not know
    RuntimeError,  # of zipfile, for an encrypted member
    MemoryError,
    OverflowError,
    SyntaxError,
    zipfile.BadZipFile,
    zlib.error,
)
"""What damaged and foreign files raise."""
NO_PLAN = "it is not a saved plan: give a file of save_plan"
"""What every message of a foreign file ends with."""


@dataclass(frozen=True, eq=False)
class SavedPlan:
    """A plan read from a file.

    Attributes:
        actions: shapes (T, G) and (T, G, 3).
        positions: positions in its execution, at the start, after each action, and settled, shape
            (T + 2, N, 3), metres.
        body: the manipulated body; None in a file of version 0.1.
        episode: start and goal; None in a file of version 0.1.
        about: task, engine, score, status, number of tunnelled contacts (`missed`), environment,
            and the writer's entries under `found`; empty in a file of version 0.1.
    """

    actions: Actions
    positions: Float[np.ndarray, "T2 N 3"]
    body: Body | None = None
    episode: Episode | None = None
    about: Mapping[str, Any] = field(default_factory=dict)

    def task(self) -> Task:
        """The task of the plan, with its body, start and goal, to replay or score it.

        A registered task has its own costs, and any other the cost in `jaxsimp.tasks.COSTS` whose
        name the file holds. Of a cost of one's own it holds none: the task then has the mean
        distance to the goal as cost.

        Raises:
            ValueError: if the file is of version 0.1, which stores no task, its description of the
                task is damaged, or the task has an obstacle of a shape that is not the library's.
        """
        if self.body is None or self.episode is None:
            raise ValueError(
                "the plan file is of version 0.1, which keeps no task; make the task that it was "
                "planned for by `make_task`"
            )
        try:
            told = self.about["task"]
            name, resolution = told["name"], told["resolution"]
            settings = {each: told[each] for each in SETTINGS} | {
                "limits": tuple(told["limits"]),
                "longest_time_step": told["time_step"],
                # Files of before 0.2 have none: their costs were summed alike.
                "running_weight": told.get("running_weight", 1.0),
                "gripper_distance": told.get("gripper_distance", 0.0),
                "episode_fn": FixedStart(self.episode),
                "obstacles": _obstacles(told),
                "pinch": None if told.get("pinch") is None else Pinch(**told["pinch"]),
            }
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(
                f"the plan file's description of the task is damaged ({type(error).__name__}: "
                f"{error}); make the task by `make_task` or its own code"
            ) from error
        if name in task_names():
            registered = make_task(name, resolution)
            return dataclasses.replace(registered, body=self.body, **settings)
        cost = COSTS.get(str(told.get("cost")), distance_cost)
        return Task(
            body=self.body,
            goal=np.asarray(self.episode.goal),
            running_cost=cost,
            terminal_cost=cost,
            name=name,
            **settings,
        )


def save_plan(
    path: str | Path,
    task: Task,
    episode: Episode,
    actions: Actions,
    execution: Execution,
    *,
    engine: object,
    found: Mapping[str, Any] | None = None,
    provenance: Mapping[str, Any] | None = None,
) -> None:
    """Write a plan as `.npz`, atomically: under its name the file is complete or absent.

    Args:
        path: path of the file.
        task: the task of the plan.
        episode: start and goal.
        actions: the plan.
        execution: the execution of the plan.
        engine: engine of the execution; the file stores its text.
        found: further entries, as JSON, such as the search that found the plan.
        provenance: versions, commit, device and cores; `environment()` by default.

    Raises:
        ValueError: if the plan, the episode or the positions are not of the task's body, the score
            is no number, or further entries are no JSON.
    """
    actions = require_actions(actions, task.body.num_particles)
    episode = require_episode(episode, task.body.num_particles)
    positions = _frames(execution.positions, actions, task.body.num_particles)
    about = {
        "task": _task_text(task),
        "engine": str(engine),
        "score": _number_or_none("the score of the execution", execution.score),
        "status": execution.status.name,
        "missed": execution.missed,
        "body": _body_text(task.body),
        "environment": _entries("provenance", environment() if provenance is None else provenance),
        "found": _entries("found", {} if found is None else found),
    }
    arrays = {
        "pick": actions.pick,
        "displacement": actions.displacement,
        "positions": positions,
        "start": episode.start,
        "goal": episode.goal,
        "about": json.dumps(about),
    }
    _write_whole(Path(path), arrays | _body_arrays(task.body))


def load_plan(path: str | Path) -> SavedPlan:
    """Read a plan written by `save_plan`. Nothing in the file is executed.

    Raises:
        ValueError: if the file holds no plan, or more than `MOST_BYTES`.
        OSError: if the file cannot be opened.
    """
    arrays = _read(Path(path))
    missing = {"pick", "displacement", "positions"} - arrays.keys()
    if missing:
        raise ValueError(f"{path} has no {', '.join(sorted(missing))}; {NO_PLAN}")
    try:
        return _plan(arrays)
    except (KeyError, TypeError, ValueError, AttributeError, RecursionError) as error:
        told = f"has no {error}" if isinstance(error, KeyError) else str(error)
        raise ValueError(
            f"{path} is damaged ({type(error).__name__}: {told}); write the plan again with "
            f"save_plan"
        ) from error


def _plan(arrays: Mapping[str, np.ndarray]) -> SavedPlan:
    """The plan of a file's arrays."""
    positions = arrays["positions"]
    count = positions.shape[1] if positions.ndim == 3 else 0
    actions = checked_actions(arrays["pick"], arrays["displacement"], count)
    positions = _frames(positions, actions, count)
    if "about" not in arrays:
        return SavedPlan(actions, positions)
    about = json.loads(str(arrays["about"]))
    if not isinstance(about, dict) or not isinstance(about["body"], dict):
        raise ValueError("about is no description of a plan")
    body = _body(about["body"], arrays)
    episode = require_episode(Episode(arrays["start"], arrays["goal"]), body.num_particles)
    if body.num_particles != count:
        raise ValueError(f"positions are of {count} particles, the body of {body.num_particles}")
    return SavedPlan(actions, positions, body, episode, about)


def _frames(positions: Any, actions: Actions, num_particles: int) -> np.ndarray:
    """The positions of an execution as an array, checked; those of a failed one are NaN."""
    frames = np.asarray(as_array("positions", positions))
    wanted = (len(actions.pick) + 2, num_particles, 3)
    if frames.shape != wanted:
        raise ValueError(
            f"positions have shape {frames.shape}; give shape {wanted}: at the start, after each "
            f"action, and settled"
        )
    if not np.issubdtype(frames.dtype, np.floating):
        raise ValueError(f"positions are an array of {frames.dtype}; give metres, as floats")
    return frames


def _number_or_none(name: str, value: Any) -> float | None:
    """A number for JSON, which has none that are not finite."""
    number = as_reals(value)
    if number is None or number.ndim:
        raise ValueError(f"{name} is {value!r}; give one real number")
    return float(number) if np.isfinite(number) else None


def _entries(name: str, given: Any) -> dict[str, Any]:
    """Further entries of a file, which JSON can hold."""
    if not isinstance(given, Mapping):
        raise ValueError(f"{name} is {given!r}; give a dictionary, as {{'search': 'CEM'}}")
    try:
        json.dumps(dict(given))
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(
            f"{name} is {given!r}, and no JSON ({error}); give numbers, texts, lists and "
            f"dictionaries of texts"
        ) from error
    return dict(given)


def _opened(path: Path) -> BinaryIO:
    try:
        return path.open("rb")
    except OSError as error:
        raise OSError(error.errno, f"{error.strerror}; give a file of save_plan", path) from error


def _read(path: Path) -> dict[str, np.ndarray]:
    file = _opened(path)
    try:
        with file:
            with zipfile.ZipFile(file) as archive:
                size = sum(member.file_size for member in archive.infolist())
            if size > MOST_BYTES:
                raise ValueError(f"it unpacks to {size:,} bytes, and {MOST_BYTES:,} are allowed")
            file.seek(0)
            arrays = dict(np.load(file, allow_pickle=False))
    except UNREADABLE as error:
        # NumPy's own words are how to load pickles.
        why = "it holds pickled objects, or is no .npz" if "pickle" in str(error) else error
        raise ValueError(f"{path} cannot be read ({why}); {NO_PLAN}") from error
    strange = [name for name, array in arrays.items() if not isinstance(array, np.ndarray)]
    if strange:
        raise ValueError(f"{path} has {strange[0]}, which is no array; {NO_PLAN}")
    return arrays


def _write_whole(path: Path, arrays: Mapping[str, Any]) -> None:
    written = io.BytesIO()
    np.savez_compressed(written, **arrays)
    with whole_file(path) as part:
        part.write_bytes(written.getvalue())


def _task_text(task: Task) -> dict[str, Any]:
    return {
        "name": task.name,
        "resolution": task.resolution,
        **{name: getattr(task, name) for name in SETTINGS},
        "running_weight": task.running_weight,
        "gripper_distance": task.gripper_distance,
        "cost": next((name for name, cost in COSTS.items() if cost is task.terminal_cost), None),
        "time_step": task.time_step,
        "pinch": None if task.pinch is None else dataclasses.asdict(task.pinch),
        "obstacles": [
            {"shape": type(obstacle).__name__}
            | {name: np.asarray(number).tolist() for name, number in vars(obstacle).items()}
            for obstacle in task.obstacles
        ],
    }


def _obstacles(told: Mapping[str, Any]) -> tuple[Obstacle, ...]:
    """The obstacles of a task; the table in a file that is older than obstacles."""
    return tuple(map(_obstacle, told.get("obstacles", [{"shape": "Table"}])))


def _obstacle(told: Mapping[str, Any]) -> Obstacle:
    shape, numbers = told["shape"], {k: np.asarray(v) for k, v in told.items() if k != "shape"}
    if shape not in SHAPES:
        raise ValueError(
            f"the plan's task has an obstacle of the shape {shape!r}; files are read with "
            f"{', '.join(SHAPES)}. Make the task by its own code"
        )
    return SHAPES[shape](**numbers)


def _is_array(field: dataclasses.Field[Any], body: Body) -> bool:
    return isinstance(getattr(body, field.name), np.ndarray)


def _body_arrays(body: Body) -> dict[str, np.ndarray]:
    names = [field.name for field in dataclasses.fields(body) if _is_array(field, body)]
    return {f"body/{name}": getattr(body, name) for name in names}


def _body_text(body: Body) -> dict[str, Any]:
    """Everything of a body except its arrays."""
    names = [field.name for field in dataclasses.fields(body) if not _is_array(field, body)]
    values = {name: getattr(body, name) for name in names}
    return values | {"material": dataclasses.asdict(body.material)}


def _body(told: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> Body:
    own = {name: array for name, array in arrays.items() if name.startswith("body/")}
    values: dict[str, Any] = {name.removeprefix("body/"): array for name, array in own.items()}
    material, shape = Material(**told["material"]), tuple(told["shape"])
    return Body(**{**told, **values, "material": material, "shape": shape})
