"""Problems, which algorithms minimise: the cost of plans of a task in an engine and an episode."""

from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxsimp.dynamics import Actions
from jaxsimp.engines import MassSprings, SearchEngine, plan_cost, settled_cost
from jaxsimp.planning.algorithm import Wants
from jaxsimp.planning.space import ActionSpace, as_candidates
from jaxsimp.simplification import KeyPoints
from jaxsimp.tasks import Episode, Task
from jaxsimp.tasks.episode import require_episode

Candidates = KeyPoints | Int[np.ndarray, " _"] | Bool[np.ndarray, " _"]
"""Particles that a picker may grasp: key points, ids, shape (K,), or a mask, shape (N,)."""


@runtime_checkable
class Problem(Protocol):
    """A problem for `optimize`: a pytree with these functions of plans."""

    @property
    def space(self) -> ActionSpace:
        """The plans that may be searched."""
        ...

    def cost(self, actions: Actions) -> Float[Array, ""]:
        """Cost of a plan; pure JAX, differentiable where an algorithm wants gradients."""
        ...

    def settled_cost(self, actions: Actions) -> Float[Array, ""]:
        """Cost of the settled state after a plan; only called if an algorithm wants it."""
        ...

    def evaluator_cost(self, actions: Actions) -> Float[Array, ""]:
        """Cost of a plan in a dearer fidelity; only called if an algorithm wants it."""
        ...


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["space", "episode", "physics", "evaluator_physics"],
    meta_fields=["task", "engine", "evaluator"],
)
@dataclass(frozen=True, eq=False)
class TaskProblem:
    """A task, an episode and candidates, in the physics of an engine.

    A pytree: `jax.vmap` applies over episodes, as `dataclasses.replace(problem, episode=...)`.

    Attributes:
        space: space of plans to search.
        episode: start and goal.
        physics: physics of the engine.
        evaluator_physics: physics of the evaluator.
        task: the task; static.
        engine: engine that gives the costs of plans; static.
        evaluator: engine for algorithms that ask for settled scores or screened costs; static.
    """

    space: ActionSpace
    episode: Episode
    physics: PyTree[Any]
    evaluator_physics: PyTree[Any]
    task: Task
    engine: SearchEngine
    evaluator: SearchEngine | None

    def cost(self, actions: Actions) -> Float[Array, ""]:
        """Cost of a plan: the sum of the running costs, see `plan_cost`."""
        return plan_cost(self.task, self.engine, self.physics, self.episode, actions)

    def settled_cost(self, actions: Actions) -> Float[Array, ""]:
        """1 minus the score of the settled state, in the evaluator's physics: `settled_cost`.

        Raises:
            ValueError: if the problem has no evaluator.
        """
        return settled_cost(
            self.task, self._evaluator, self.evaluator_physics, self.episode, actions
        )

    def evaluator_cost(self, actions: Actions) -> Float[Array, ""]:
        """Cost of a plan in the physics of the evaluator, see `plan_cost`.

        Raises:
            ValueError: if the problem has no evaluator.
        """
        return plan_cost(self.task, self._evaluator, self.evaluator_physics, self.episode, actions)

    def chunk_size(self, wants: Wants) -> int:
        """Fastest number of plans under one `vmap` on a core of a CPU."""
        if wants in ("settled", "screened"):
            return self._evaluator.chunk_size(self.evaluator_physics)
        return self.engine.chunk_size(self.physics)

    @property
    def _evaluator(self) -> SearchEngine:
        if self.evaluator is None:
            raise ValueError(
                "the algorithm asks for an evaluator's physics and the problem has no evaluator; "
                "give `make_problem` one, as MassSprings(self_contact=True)"
            )
        return self.evaluator


def make_problem(
    task: Task,
    candidates: Candidates,
    episode: Episode | None = None,
    engine: SearchEngine | None = None,
    evaluator: SearchEngine | None = None,
) -> TaskProblem:
    """The problem of a task.

    Args:
        task: the task.
        candidates: particles that a picker may grasp.
        episode: start and goal; those of seed 0 by default.
        engine: engine that gives the costs of plans; by default our own dynamics, without
            self-contact.
        evaluator: engine for algorithms that ask for settled scores or screened costs.

    Raises:
        ValueError: if a candidate is not a particle of the body, the episode is not of the body,
            or an engine cannot carry out plans of the task.
    """
    engine = engine or MassSprings()
    episode = task.episode_fn(0) if episode is None else episode
    episode = require_episode(episode, task.body.num_particles)
    return TaskProblem(
        space=action_space(task, candidates),
        episode=jax.tree.map(partial(jnp.asarray, dtype=float), episode),
        physics=engine.physics(task),
        evaluator_physics=evaluator.physics(task) if evaluator else (),
        task=task,
        engine=engine,
        evaluator=evaluator,
    )


def action_space(task: Task, candidates: Candidates) -> ActionSpace:
    """The space of a task's plans over candidates.

    Raises:
        ValueError: if a candidate is not a particle of the body.
    """
    given = candidates.particles if isinstance(candidates, KeyPoints) else candidates
    return ActionSpace(
        jnp.asarray(as_candidates(given, task.body.num_particles)),
        jnp.asarray(task.limits, dtype=float),
        task.num_actions,
        task.num_pickers,
    )
