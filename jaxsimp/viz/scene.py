"""Scenes: what all moving views show of a plan or of a goal."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Array, Float, Int

from jaxsimp.bodies import Body
from jaxsimp.checks import keep, require_ids, require_reals
from jaxsimp.dynamics import NONE, Actions, Obstacle, Table
from jaxsimp.dynamics.contact.obstacles import check_obstacles
from jaxsimp.engines import (
    FRAMES_PER_SECOND,
    MassSprings,
    MuJoCo,
    Recorder,
    Trajectory,
    grasps,
)
from jaxsimp.goals import Positions, as_goal
from jaxsimp.records import SavedPlan
from jaxsimp.simplification import KeyPoints
from jaxsimp.tasks import Episode, Task, score

OUR_ENGINE = MassSprings(self_contact=True)
"""The engine that a planner carries plans out in, unless it is told another one."""
ENGINES: tuple[Recorder, ...] = (OUR_ENGINE, MassSprings(), MuJoCo("full"), MuJoCo("fast"))
"""Engines whose motions a plan file can name."""
NO_PARTICLES: Int[np.ndarray, " 0"] = np.zeros(0, dtype=np.int64)


@dataclass(frozen=True, eq=False)
class Scene:
    """A body in motion, its goal and what is around it.

    Attributes:
        title: title of the view.
        body: the body.
        goal: goal positions, shape (N, 3), metres.
        trajectory: the motion; frames from the first on that is not finite are left out.
        key_points: particles to mark: key points, or ids, shape (K,).
        obstacles: obstacles to draw.
        score: score of the settled state; None if there is none.
        costs: cost of the best plan after each question of the search, shape (I,); empty if it is
            not known.

    Raises:
        ValueError: if the goal, the trajectory or a key point is not of the body, an obstacle is
            refused, or a cost is no number.
    """

    title: str
    body: Body
    goal: Positions
    trajectory: Trajectory
    key_points: Any = ()
    obstacles: Sequence[Obstacle] = (Table(),)
    score: float | None = None
    costs: Any = ()

    def __post_init__(self) -> None:
        if not isinstance(self.title, str):
            raise ValueError(f"title is {self.title!r}; give a text, as 'diagonal fold'")
        check_obstacles(self.obstacles, self.body)
        costs = require_reals(
            "costs", self.costs if len(self.costs) else np.zeros(0), ("I",), "one a question"
        )
        keep(
            self,
            goal=as_goal(self.body, self.goal),
            trajectory=_finite_part(self.trajectory, self.body),
            key_points=_particles(self.key_points, self.body),
            costs=costs[np.isfinite(costs)],
        )

    @property
    def caption(self) -> str:
        """Score, and numbers of key points and particles, in words."""
        told = [f"{self.body.num_particles} particles"]
        if len(self.key_points):
            told.insert(0, f"{len(self.key_points)} key points")
        if self.score is not None:
            told.insert(0, f"score {self.score:.3f}")
        return " · ".join(told)

    @property
    def limits(self) -> np.ndarray:
        """Lowest and highest corner of all frames and the goal, shape (2, 3), metres."""
        points = np.concatenate([self.trajectory.positions.reshape(-1, 3), self.goal])
        return np.stack([points.min(axis=0), points.max(axis=0)])


def make_scene(
    task: Task,
    episode: Episode,
    actions: Actions,
    engine: Recorder = OUR_ENGINE,
    *,
    title: str | None = None,
    key_points: KeyPoints | Sequence[int] | np.ndarray = (),
    costs: Sequence[float] | Float[Array | np.ndarray, " I"] = (),
    frames_per_second: float = FRAMES_PER_SECOND,
) -> Scene:
    """The scene of a plan, which the engine carries out once more.

    Args:
        task: the task of the plan.
        episode: start and goal.
        actions: the plan, shapes (T, G) and (T, G, 3).
        engine: engine that carries it out: `MassSprings` or `MuJoCo`.
        title: title of the view; the name of the task by default.
        key_points: particles to mark.
        costs: cost of the best plan after each question of the search.
        frames_per_second: least rate of frames.

    Raises:
        ValueError: if the plan or the episode is not of the task, or `Scene` raises.
    """
    motion = engine.trajectory(task, episode, actions, frames_per_second)
    end = motion.positions[-1]
    value = float(score(task, episode, end)) if np.isfinite(end).all() else None
    return Scene(
        title=task.name.replace("_", " ") if title is None else title,
        body=task.body,
        goal=np.asarray(episode.goal, dtype=float),
        trajectory=motion,
        key_points=key_points,
        obstacles=task.obstacles,
        score=value,
        costs=costs,
    )


def scene_of_plan(
    plan: SavedPlan, *, title: str | None = None, frames_per_second: float = FRAMES_PER_SECOND
) -> Scene:
    """The scene of a plan file, carried out in the engine that the file names.

    The file may name `key_points` and `costs` among its entries of `found`.

    Raises:
        ValueError: if the file is of version 0.1, its task is damaged, or it holds key points that
            the body does not have.
    """
    task, found = plan.task(), plan.about.get("found")
    found = found if isinstance(found, dict) else {}
    named = {str(engine): engine for engine in ENGINES}
    assert plan.episode is not None  # or there is no task
    return make_scene(
        task,
        plan.episode,
        plan.actions,
        named.get(str(plan.about.get("engine")), OUR_ENGINE),
        title=title,
        key_points=found.get("key_points", ()),
        costs=found.get("costs", ()),
        frames_per_second=frames_per_second,
    )


def scene_of_goal(
    body: Body,
    goal: Positions,
    key_points: KeyPoints | Sequence[int] | np.ndarray = (),
    *,
    title: str = "goal",
) -> Scene:
    """The scene of a goal, at rest.

    Raises:
        ValueError: if the goal or a key point is not of the body.
    """
    still = Trajectory(np.zeros(1), as_goal(body, goal)[None], np.zeros((0, 0), dtype=int))
    return Scene(title, body, goal, still, key_points)


def _particles(given: Any, body: Body) -> Int[np.ndarray, " K"]:
    """Ids of the particles to mark."""
    ids = given.particles if isinstance(given, KeyPoints) else given
    return require_ids("key_points", ids, body.num_particles) if len(ids) else NO_PARTICLES


def _finite_part(trajectory: Trajectory, body: Body) -> Trajectory:
    """The frames up to the first one that is not finite."""
    wanted, why = ("M", *body.rest.shape), "a row of x, y, z for each particle of each frame"
    positions = require_reals("the trajectory's positions", trajectory.positions, wanted, why)
    finite = np.isfinite(positions).all(axis=(1, 2))
    count = len(finite) if finite.all() else int(finite.argmin())
    if not count:
        raise ValueError("the first frame is not finite; give a motion of a start that is")
    return replace(
        trajectory,
        times=trajectory.times[:count],
        positions=positions[:count],
        held=trajectory.held[: count - 1],
    )


def at_time(trajectory: Trajectory, time: float) -> tuple[Positions, Int[np.ndarray, " G"]]:
    """Positions at a time, between frames on a straight line, and what each picker holds then.

    Before the first frame it is the first one, after the last frame the last, with nothing held.
    """
    index, part = _interval(trajectory, time)
    if index == len(trajectory.times) - 1:
        return trajectory.positions[-1], np.full(trajectory.held.shape[1], NONE)
    before, after = trajectory.positions[index : index + 2]
    return (1 - part) * before + part * after, trajectory.held[index]


def past_paths(trajectory: Trajectory, time: float) -> list[tuple[int, Positions]]:
    """Paths of pickers up to a time: the picker, and positions of what it held, one each grasp."""
    index, _ = _interval(trajectory, time)
    now, _ = at_time(trajectory, time)
    paths = []
    for picker, begin, end in grasps(trajectory):
        if begin > index or (begin == index and time <= trajectory.times[begin]):
            continue
        particle = trajectory.held[begin, picker]
        path = trajectory.positions[begin : min(end, index) + 1, particle]
        if end > index:
            path = np.concatenate([path, now[None, particle]])
        paths.append((picker, path))
    return paths


def _interval(trajectory: Trajectory, time: float) -> tuple[int, float]:
    """The frame before a time, and the part of the way to the next one."""
    times = trajectory.times
    index = int(np.clip(np.searchsorted(times, time, side="right") - 1, 0, len(times) - 1))
    if index == len(times) - 1:
        return index, 0.0
    return index, max(0.0, float((time - times[index]) / (times[index + 1] - times[index])))
