"""Engines: what carries out plans. The seam between planning and physics.

Any engine evaluates plans. Those in JAX can also search: their rollouts are pure functions.
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
    """What became of a plan.

    `WARNED`: it was carried out, and the engine warned of something, as contacts left out.
    `UNSTABLE`: a number of the simulation was not finite or too large; the plan ends there.
    """

    FINE = 0
    WARNED = 1
    UNSTABLE = 2


@dataclass(frozen=True, eq=False)
class Execution:
    """What a plan does in an engine.

    Attributes:
        positions: at the start, after each action, and settled, shape (T + 2, N, 3), metres; not
            a number after the simulation became unstable.
        score: normalised score of the settled state, not a number where it is unstable.
        status: what became of the plan.
        warnings: of the engine, by name.
        missed: contacts whose particles got past each other; None where they are not counted.
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
    """What evaluates plans."""

    def executor(self, task: Task) -> Executor:
        """What carries out plans of a task; to be made once and called often.

        Raises:
            ValueError: if the engine cannot carry out plans of this task.
        """
        ...


Observe = Callable[[State, Actions], PyTree[Any]]
"""Of the state at the end of an action, and that action; pure JAX."""


@runtime_checkable
class SearchEngine(Engine, Protocol):
    """An engine in JAX: one that a search can plan in. It is hashable, as a frozen dataclass."""

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
            observe: applied at the end of each action.

        Returns:
            The state at the end of the last action, and the observations stacked along an axis
            of length T; both with a first axis `E` in an ensemble of E physics.
        """
        ...

    def risk(self, costs: Float[Array, "*E"]) -> Float[Array, ""]:
        """One cost of a plan, from its cost or from its costs in each of E physics."""
        ...

    def chunk_size(self, physics: PyTree[Any]) -> int:
        """Rollouts that run fastest under one `vmap` on a core of a CPU."""
        ...


def then_idle(actions: Actions, count: int) -> Actions:
    """A plan followed by `count` actions that grasp nothing."""
    num_pickers = actions.pick.shape[1]
    return Actions(
        jnp.concatenate([actions.pick, jnp.full((count, num_pickers), NONE)]),
        jnp.concatenate([actions.displacement, jnp.zeros((count, num_pickers, 3))]),
    )
