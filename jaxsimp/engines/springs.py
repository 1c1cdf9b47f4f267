"""Our own mass-springs as an engine."""

from dataclasses import dataclass
from typing import Any

from jaxtyping import Array, Float, PyTree

from jaxsimp.dynamics import Actions, Pickers, Simulation, State, rollout_observing
from jaxsimp.engines.engine import Executor, Observe
from jaxsimp.engines.rollouts import RolloutExecutor
from jaxsimp.tasks import Task

CHUNK_SIZE = 8
"""Samples a chunk on a CPU, whatever the number of workers: a sample's chunk decides how it rounds,
so plans do not depend on how many cores or devices there are. Larger chunks are within a fifth."""
MOST_CHUNKED_PARTICLES = 1000
"""Grids and ropes of more run sample by sample: the states of a chunk would leave the cache."""

Physics = tuple[Simulation, Pickers]


@dataclass(frozen=True)
class MassSprings:
    """Our own dynamics, the engine of a planner by default.

    Attributes:
        self_contact: whether the body touches itself, or passes through itself.
    """

    self_contact: bool = False

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

    def executor(self, task: Task) -> Executor:
        """See `Engine.executor`."""
        return RolloutExecutor(task, self, self.physics(task))


def spring_chunk_size(simulation: Simulation) -> int:
    """Rollouts of mass-springs that run fastest under one `vmap` on a core."""
    large = simulation.springs.offsets and len(simulation.mass) > MOST_CHUNKED_PARTICLES
    # Only a sample by itself looks its contacts up no more often than it must.
    return 1 if large or simulation.self_contact is not None else CHUNK_SIZE
