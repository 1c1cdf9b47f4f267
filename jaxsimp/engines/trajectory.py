"""Trajectories: the whole motion of a plan in an engine, for views and exports."""

from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Protocol, runtime_checkable

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from jaxsimp.checks import require_number
from jaxsimp.dynamics import (
    NONE,
    Actions,
    Pickers,
    Simulation,
    State,
    at_rest,
    rollout_in_frames,
)
from jaxsimp.engines.engine import then_idle
from jaxsimp.tasks import Episode, Task

FRAMES_PER_SECOND = 30.0
LEAST_RATE, MOST_RATE = 0.1, 10_000.0
"""Least and most frames in a second."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """The motion of a body and its pickers.

    Attributes:
        times: time of each frame, shape (M,), seconds; rises from 0.
        positions: positions of the particles, shape (M, N, 3), metres; not finite after the
            simulation became unstable.
        held: particle that each picker holds from one frame to the next, or `NONE`, shape
            (M - 1, G). A picker is where its particle is.
    """

    times: Float[np.ndarray, " M"]
    positions: Float[np.ndarray, "M N 3"]
    held: Int[np.ndarray, "M1 G"]


@runtime_checkable
class Recorder(Protocol):
    """An engine that tells the whole motion of a plan."""

    def trajectory(
        self,
        task: Task,
        episode: Episode,
        actions: Actions,
        frames_per_second: float = FRAMES_PER_SECOND,
    ) -> Trajectory:
        """The motion of a plan, and of the body as it settles.

        The ends of actions are frames; between them frames are at most as far apart as asked.

        Raises:
            ValueError: if the episode or the plan is not of the task's body, or the rate of frames
                is out of its range.
        """
        ...


def stride_of(steps: int, seconds: float, frames_per_second: float) -> int:
    """Number of time steps from frame to frame.

    Args:
        steps: number of time steps of an action.
        seconds: duration of an action, seconds.
        frames_per_second: least rate of frames.

    Raises:
        ValueError: if the rate is out of its range.
    """
    rate = require_number("frames_per_second", frames_per_second, LEAST_RATE, MOST_RATE, "1/s")
    frames = min(steps, max(1, round(seconds * rate)))
    return -(-steps // frames)


def frame_times(num_actions: int, steps: int, time_step: float, stride: int) -> np.ndarray:
    """Time of the start and of each frame, seconds."""
    ends = np.append(np.arange(stride, steps, stride), steps)
    every = (steps * np.arange(num_actions)[:, None] + ends[None]).ravel()
    return time_step * np.append(0, every)


def held_particles(actions: Actions) -> Int[np.ndarray, "T G"]:
    """Particle that each picker holds in each action, or `NONE`.

    If several pickers name a particle, the first one holds it, as in `jaxsimp.dynamics`.
    """
    pick = np.asarray(actions.pick)
    earlier = np.tril(pick[:, :, None] == pick[:, None, :], k=-1).any(axis=2)
    return np.where(earlier, NONE, pick)


def rollout_trajectory(
    physics: tuple[Simulation, Pickers], task: Task, episode: Episode, actions: Actions, rate: float
) -> Trajectory:
    """The motion of a plan in our dynamics, see `Recorder`."""
    simulation, pickers = physics
    stride = stride_of(pickers.steps, task.action_seconds, rate)
    followed = then_idle(actions, task.settle_actions)
    start = at_rest(episode.start)
    moved = np.asarray(_moved(stride, simulation, pickers, start, followed))
    count, frames = moved.shape[:2]
    positions = np.concatenate(
        [np.asarray(start.position)[None], moved.reshape(-1, *moved.shape[2:])]
    )
    times = frame_times(count, pickers.steps, task.time_step, stride)
    return Trajectory(times, positions, np.repeat(held_particles(followed), frames, axis=0))


@partial(jax.jit, static_argnums=0)
def _moved(
    stride: int, simulation: Simulation, pickers: Pickers, state: State, actions: Actions
) -> Float[Array, "T frames N 3"]:
    return rollout_in_frames(simulation, pickers, state, actions, stride)


def grasps(trajectory: Trajectory) -> list[tuple[int, int, int]]:
    """Picker, first and last frame of each time that a picker holds a particle, by picker."""
    found = []
    for picker, held in enumerate(trajectory.held.T):
        bounds = np.flatnonzero(np.diff(held, prepend=NONE - 1, append=NONE - 1))
        found += [
            (picker, int(begin), int(end)) for begin, end in pairwise(bounds) if held[begin] != NONE
        ]
    return found
