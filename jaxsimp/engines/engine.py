"""Engines: what carries out plans. The seam between a planner and its physics."""

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

from jaxtyping import PyTree

from jaxsimp.dynamics import Actions, State
from jaxsimp.tasks import Task

Observe = Callable[[State], PyTree[Any]]
"""Of the state at the end of an action; pure JAX."""


@runtime_checkable
class Engine(Protocol):
    """What a planner needs to know of physics."""

    def physics(self, task: Task) -> PyTree[Any]:
        """What all rollouts of a task share: a pytree of arrays.

        Raises:
            ValueError: if the engine cannot carry out plans of this task.
        """
        ...

    def rollout(
        self, physics: PyTree[Any], state: State, actions: Actions, observe: Observe
    ) -> tuple[State, PyTree[Any]]:
        """Carry out a plan; pure JAX, to which `jit` and `vmap` apply.

        Args:
            physics: made by `physics`.
            state: at the start, shapes (N, 3).
            actions: shapes (T, G) and (T, G, 3).
            observe: applied to the state at the end of each action.

        Returns:
            The state at the end of the last action, and the observations stacked along a first
            axis of length T.
        """
        ...
