"""Protocols of engines: the interface between planning and physics.

Any engine evaluates plans. A planner can search in those written in JAX: their rollouts are pure
functions.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Protocol, runtime_checkable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from jaxsimp.dynamics import NONE, Actions, State
from jaxsimp.tasks import Episode, Task


class ExecutionStatus(IntEnum):
    """Outcome of an execution.

    `WARNED`: the plan ran to its end, and the engine warned, for example of contacts left out.
    `UNSTABLE`: a number of the simulation was not finite or too large; the plan ends there.
    """

    FINE = 0
    WARNED = 1
    UNSTABLE = 2


@dataclass(frozen=True, eq=False)
class Execution:
    """Result of carrying out a plan in an engine.

    Attributes:
        positions: positions at the start, after each action, and settled, shape (T + 2, N, 3),
            metres; NaN after the simulation became unstable.
        score: normalised score of the settled state; NaN if the simulation became unstable.
        status: outcome of the execution.
        warnings: names of the engine's warnings.
        missed: number of tunnelled contacts, whose particles passed through each other; None if
            the engine does not count them.
    """

    positions: Float[np.ndarray, "T2 N 3"]
    score: float
    status: ExecutionStatus = ExecutionStatus.FINE
    warnings: tuple[str, ...] = ()
    missed: int | None = None


Executor = Callable[[Episode, Actions], Execution]
"""Carries out a plan of one task, lets the body settle, and scores it."""


@runtime_checkable
class Engine(Protocol):
    """Evaluates plans."""

    def executor(self, task: Task) -> Executor:
        """An executor of plans of a task; make it once and call it often.

        Raises:
            ValueError: if the engine cannot carry out plans of this task.
        """
        ...


Observe = Callable[[State, Actions], PyTree[Any]]
"""Observation of the state at the end of an action, and of that action; pure JAX."""


@runtime_checkable
class SearchEngine(Engine, Protocol):
    """An engine written in JAX, in which a planner can search. Hashable: a frozen dataclass."""

    def physics(self, task: Task) -> PyTree[Any]:
        """Arrays that all rollouts of a task share, as a pytree.

        Raises:
            ValueError: if the engine cannot carry out plans of this task.
        """
        ...

    def rollout(
        self, physics: PyTree[Any], state: State, actions: Actions, observe: Observe
    ) -> tuple[State, PyTree[Any]]:
        """Carry out a plan; pure JAX, to which `jit` and `vmap` apply.

        Args:
            physics: result of `physics`.
            state: state at the start, shapes (N, 3).
            actions: the plan, shapes (T, G) and (T, G, 3).
            observe: function applied at the end of each action.

        Returns:
            The state at the end of the last action, and the observations stacked along an axis
            of length T; both with a first axis `E` in an ensemble of E physics.
        """
        ...

    def risk(self, costs: Float[Array, "*E"]) -> Float[Array, ""]:
        """Cost of a plan, from its single cost or from its costs in each of E physics."""
        ...

    def chunk_size(self, physics: PyTree[Any]) -> int:
        """Fastest number of rollouts under one `vmap` on a core of a CPU."""
        ...


def then_idle(actions: Actions, count: int) -> Actions:
    """A plan followed by `count` actions that grasp nothing."""
    num_pickers = actions.pick.shape[1]
    return Actions(
        jnp.concatenate([actions.pick, jnp.full((count, num_pickers), NONE)]),
        jnp.concatenate([actions.displacement, jnp.zeros((count, num_pickers, 3))]),
    )
