"""Our mass-spring dynamics as an engine."""

from dataclasses import dataclass
from typing import Any

from jaxtyping import Array, Float, PyTree

from jaxsimp.checks import require_flag
from jaxsimp.dynamics import Actions, Pickers, Simulation, State, rollout_observing
from jaxsimp.engines.engine import Executor, Observe
from jaxsimp.engines.rollouts import RolloutExecutor
from jaxsimp.engines.trajectory import FRAMES_PER_SECOND, Trajectory, rollout_trajectory
from jaxsimp.tasks import Episode, Task

CHUNK_SIZE = 8
"""Samples per chunk on a CPU, for any number of workers: the chunk size determines rounding, so
plans do not depend on the number of cores or devices. The speed of larger chunks is within 20 %."""
MOST_CHUNKED_PARTICLES = 1000
"""Larger grids and ropes run sample by sample: the states of a chunk would not fit in the cache."""

Physics = tuple[Simulation, Pickers]


@dataclass(frozen=True)
class MassSprings:
    """Our own dynamics, the default engine of a planner.

    Attributes:
        self_contact: whether the body touches itself, or passes through itself.

    Raises:
        ValueError: if it is neither true nor false.
    """

    self_contact: bool = False

    def __post_init__(self) -> None:
        require_flag("self_contact", self.self_contact)

    def physics(self, task: Task) -> Physics:
        """The task's simulation and pickers."""
        return task.simulation(self_contact=self.self_contact), task.pickers()

    def rollout(
        self, physics: Physics, state: State, actions: Actions, observe: Observe
    ) -> tuple[State, PyTree[Any]]:
        """See `jaxsimp.dynamics.rollout`."""
        return rollout_observing(*physics, state, actions, observe)

    def risk(self, costs: Float[Array, ""]) -> Float[Array, ""]:
        """The cost itself."""
        return costs

    def chunk_size(self, physics: Physics) -> int:
        """See `CHUNK_SIZE`."""
        return spring_chunk_size(physics[0])

    def trajectory(
        self,
        task: Task,
        episode: Episode,
        actions: Actions,
        frames_per_second: float = FRAMES_PER_SECOND,
    ) -> Trajectory:
        """See `Recorder.trajectory`."""
        return rollout_trajectory(self.physics(task), task, episode, actions, frames_per_second)

    def executor(self, task: Task) -> Executor:
        """See `Engine.executor`."""
        return RolloutExecutor(task, self, self.physics(task))


def spring_chunk_size(simulation: Simulation) -> int:
    """Fastest number of mass-spring rollouts under one `vmap` on a core."""
    large = simulation.springs.offsets and len(simulation.mass) > MOST_CHUNKED_PARTICLES
    # A batch would search for contacts more often than each of its samples needs.
    return 1 if large or simulation.self_contact is not None else CHUNK_SIZE
