"""Our own mass-springs as an engine."""

from dataclasses import dataclass
from typing import Any

from jaxtyping import PyTree

from jaxsimp.dynamics import Actions, Pickers, Simulation, State, rollout
from jaxsimp.engines.engine import Observe
from jaxsimp.tasks import Task


@dataclass(frozen=True)
class MassSprings:
    """Our own dynamics, the engine of a planner by default.

    Attributes:
        self_contact: whether the body touches itself, or passes through itself.
    """

    self_contact: bool = False

    def physics(self, task: Task) -> tuple[Simulation, Pickers]:
        """The task's simulation and pickers."""
        return task.simulation(self_contact=self.self_contact), task.pickers()

    def rollout(
        self, physics: tuple[Simulation, Pickers], state: State, actions: Actions, observe: Observe
    ) -> tuple[State, PyTree[Any]]:
        """See `jaxsimp.dynamics.rollout`."""
        return rollout(*physics, state, actions, observe)
