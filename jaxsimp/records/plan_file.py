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
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxsimp.bodies import Body, Material
from jaxsimp.dynamics import Actions, Obstacle
from jaxsimp.dynamics.contact.obstacles import SHAPES
from jaxsimp.dynamics.pickers import checked_actions, require_actions
from jaxsimp.engines import Execution
from jaxsimp.records.files import whole_file
from jaxsimp.records.provenance import environment
from jaxsimp.tasks import Episode, FixedStart, Task, distance_cost, make_task, task_names
from jaxsimp.tasks.episode import require_episode

SETTINGS = ("limits", "num_actions", "num_pickers", "action_seconds", "settle_actions")
"""Numbers of a task that a file stores."""
MOST_BYTES = 2 * 10**9
"""Most bytes that a file may unpack to; a plan of 100 actions of 100,000 particles has 250 MB."""
UNREADABLE = (
    ValueError,
    EOFError,
    TypeError,
    KeyError,
    NotImplementedError,
    RuntimeError,
    MemoryError,
    OverflowError,
    SyntaxError,
    zipfile.BadZipFile,
    zlib.error,
)
"""What damaged and foreign files raise."""


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

        A registered task has its own costs; any other has the mean distance to the goal as cost,
        since a file holds no functions.

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
                "episode_fn": FixedStart(self.episode),
                "obstacles": _obstacles(told),
            }
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(
                f"the plan file's description of the task is damaged ({type(error).__name__}: "
                f"{error}); make the task by `make_task` or its own code"
            ) from error
        if name in task_names():
            registered = make_task(name, resolution)
            return dataclasses.replace(registered, body=self.body, **settings)
        return Task(
            body=self.body,
            goal=np.asarray(self.episode.goal),
            running_cost=distance_cost,
            terminal_cost=distance_cost,
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
        ValueError: if the plan, the episode or the positions are not of the task's body.
    """
    actions = require_actions(actions, task.body.num_particles)
    require_episode(episode, task.body.num_particles)
    _require_frames(execution.positions, actions, task.body.num_particles)
    about = {
        "task": _task_text(task),
        "engine": str(engine),
        "score": execution.score if np.isfinite(execution.score) else None,
        "status": execution.status.name,
        "missed": execution.missed,
        "body": _body_text(task.body),
        "environment": dict(provenance or environment()),
        "found": dict(found or {}),
    }
    arrays = {
        "pick": actions.pick,
        "displacement": actions.displacement,
        "positions": execution.positions,
        "start": episode.start,
        "goal": episode.goal,
        "about": json.dumps(about),
    }
    _write_whole(Path(path), arrays | _body_arrays(task.body))


def load_plan(path: str | Path) -> SavedPlan:
    """Read a plan written by `save_plan`. Nothing in the file is executed.

    Raises:
        ValueError: if the file holds no plan, or more than `MOST_BYTES`.
    """
    arrays = _read(Path(path))
    missing = {"pick", "displacement", "positions"} - arrays.keys()
    if missing:
        raise ValueError(f"{path} has no {', '.join(sorted(missing))}; it is not a saved plan")
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
    _require_frames(positions, actions, count)
    if "about" not in arrays:
        return SavedPlan(actions, positions)
    about = json.loads(str(arrays["about"]))
    if not isinstance(about, dict) or not isinstance(about["body"], dict):
        raise ValueError("about is no description of a plan")
    body = _body(about["body"], arrays)
    episode = Episode(arrays["start"], arrays["goal"])
    require_episode(episode, body.num_particles)
    if body.num_particles != count:
        raise ValueError(f"positions are of {count} particles, the body of {body.num_particles}")
    return SavedPlan(actions, positions, body, episode, about)


def _require_frames(positions: np.ndarray, actions: Actions, num_particles: int) -> None:
    """Raise a `ValueError` unless positions are of an execution; those of a failed one are NaN."""
    wanted = (len(actions.pick) + 2, num_particles, 3)
    if np.shape(positions) != wanted or not np.issubdtype(np.asarray(positions).dtype, np.floating):
        raise ValueError(
            f"positions have shape {np.shape(positions)}; {wanted} is needed: at the start, after "
            f"each action, and settled"
        )


def _read(path: Path) -> dict[str, np.ndarray]:
    try:
        with path.open("rb") as file:
            with zipfile.ZipFile(file) as archive:
                size = sum(member.file_size for member in archive.infolist())
            if size > MOST_BYTES:
                raise ValueError(f"it unpacks to {size:,} bytes, and {MOST_BYTES:,} are allowed")
            file.seek(0)
            arrays = dict(np.load(file, allow_pickle=False))
    except UNREADABLE as error:
        raise ValueError(f"{path} cannot be read ({error}); it is not a saved plan") from error
    strange = [name for name, array in arrays.items() if not isinstance(array, np.ndarray)]
    if strange:
        raise ValueError(f"{path} has {strange[0]}, which is no array; it is not a saved plan")
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
        "time_step": task.time_step,
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
            f"the plan's task has an obstacle of the shape {shape}; files are read with "
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
