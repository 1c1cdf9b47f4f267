"""Cost and execution of a plan, for all engines in JAX."""

from functools import cached_property, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from jaxsimp.dynamics import NONE, Actions, State, at_rest
from jaxsimp.dynamics.pickers import require_actions
from jaxsimp.engines.engine import Execution, ExecutionStatus, SearchEngine, then_idle
from jaxsimp.engines.population import Layout, PopulationMap
from jaxsimp.tasks import Episode, Task, score
from jaxsimp.tasks.episode import require_episode
from jaxsimp.tasks.grippers import WEIGHT, violation


def plan_cost(
    task: Task, engine: SearchEngine, physics: PyTree[Any], episode: Episode, actions: Actions
) -> Float[Array, ""]:
    """Cost of a plan: the weighted sum of the running costs of its actions, and the terminal cost.

    The terminal cost is that of the state one action's duration after the pickers have let go.
    The paper sums the same cost over all steps (section IV-A), with `Task.running_weight` 1.
    Grippers nearer to one another than `Task.gripper_distance` cost extra.

    Raises:
        ValueError: if the plan is not of the body, see `jaxsimp.dynamics.Actions`.
    """
    actions = require_actions(actions, task.body.num_particles)
    terminal_cost: object = task.terminal_cost
    is_one_cost = task.running_cost is terminal_cost  # which is then taken once

    def observe(state: State, action: Actions) -> tuple[tuple[Float[Array, ""], ...], ...]:
        running = task.running_cost(episode, state, action)
        costs = (running,) if is_one_cost else (running, task.terminal_cost(episode, state))
        return (costs, violations(task, state, action))

    start = at_rest(episode.start)
    followed = then_idle(actions, 1)
    _, ((running, *terminal), nearer) = engine.rollout(physics, start, followed, observe)
    costs = running
    if terminal:
        costs = jnp.concatenate([running[..., :-1], terminal[0][..., -1:]], axis=-1)
    if task.running_weight != 1:
        weights = np.append(np.full(actions.pick.shape[0], task.running_weight), 1.0)
        costs = costs * np.broadcast_to(weights.astype(costs.dtype), costs.shape)
    return engine.risk(with_penalty(costs.sum(axis=-1), nearer))


def settled_cost(
    task: Task, engine: SearchEngine, physics: PyTree[Any], episode: Episode, actions: Actions
) -> Float[Array, ""]:
    """1 minus the score of the settled state after a plan, and what grippers too near cost.

    Raises:
        ValueError: if the plan is not of the body, see `jaxsimp.dynamics.Actions`.
    """
    actions = require_actions(actions, task.body.num_particles)
    followed = then_idle(actions, task.settle_actions)
    final, nearer = engine.rollout(
        physics, at_rest(episode.start), followed, partial(violations, task)
    )
    return with_penalty(1.0 - score(task, episode, final.position), nearer)


def violations(task: Task, state: State, action: Actions) -> tuple[Float[Array, ""], ...]:
    """How much nearer grippers came than the task allows, metres; nothing if it has no limit."""
    least = task.gripper_distance
    return (violation(least, state.position, action),) if least else ()


def with_penalty(
    cost: Float[Array, "*E"], nearer: tuple[Float[Array, "*E T"], ...]
) -> Float[Array, "*E"]:
    """A cost, and what `violations` of each action add to it."""
    return sum((WEIGHT * each.sum(axis=-1) for each in nearer), start=cost)


def merit(task: Task, actions: Actions, execution: Execution) -> float:
    """Score of an execution, less the cost of grippers too near; minus infinity if unstable."""
    if not np.isfinite(execution.score):
        return -np.inf
    ends = [State(jnp.asarray(end), jnp.zeros_like(end)) for end in execution.positions[1:-1]]
    each = [
        violations(task, end, Actions(pick, move))
        for end, pick, move in zip(ends, actions.pick, actions.displacement, strict=True)
    ]
    return execution.score - WEIGHT * float(sum(sum(one) for one in each))


def require_plan(task: Task, actions: Actions, *, batch: bool = False) -> Actions:
    """A plan of a task as arrays, or several with a first axis `B`, checked.

    Raises:
        ValueError: if `jaxsimp.dynamics.pickers.require_actions` raises, or the numbers of actions
            and pickers are not those of the task.
    """
    actions = require_actions(actions, task.body.num_particles, batch=batch)
    found, wanted = actions.pick.shape[-2:], (task.num_actions, task.num_pickers)
    if found != wanted:
        raise ValueError(
            f"the plan has {found} actions and pickers, and {task.name} takes {wanted}; give a "
            f"plan of the task, or the task another num_actions"
        )
    if not actions.pick.size:
        raise ValueError("there are no plans; give at least one")
    # Of these types are the plans that evaluations are compiled for.
    return Actions(jnp.asarray(actions.pick, int), jnp.asarray(actions.displacement, float))


class RolloutExecutor:
    """Executor of a task's plans by the rollouts of an engine with one physics.

    Attributes:
        compile_seconds: compilation time, seconds; 0 before the first plan.
    """

    def __init__(self, task: Task, engine: SearchEngine, physics: PyTree[Any]) -> None:
        """Make an executor; compilation waits for the first plan.

        Args:
            task: the task.
            engine: engine of the rollouts; its observations have no axis of an ensemble.
            physics: physics of the rollouts.
        """
        self._task, self._engine, self._physics = task, engine, physics

    @property
    def compile_seconds(self) -> float:
        """Compilation time, seconds."""
        return self._compiled.compile_seconds

    def __call__(self, episode: Episode, actions: Actions) -> Execution:
        """Carry out a plan, let the body settle, and score it.

        Raises:
            ValueError: if the episode or the plan is not of the task.
        """
        episode = require_episode(episode, self._task.body.num_particles)
        actions = require_plan(self._task, actions)
        one = jax.tree.map(lambda array: jnp.asarray(array)[None], actions)
        shared = (self._physics, as_float(episode))
        (positions,), (value,), (missed,) = self._compiled(shared, one)
        # The score of a free start is minus infinity where the end costs something.
        fine = bool(np.isfinite(positions).all() and not np.isnan(value))
        status = ExecutionStatus.FINE if fine else ExecutionStatus.UNSTABLE
        return Execution(positions, float(value), status, missed=int(missed))

    @cached_property
    def _compiled(self) -> PopulationMap:
        task = self._task
        example = Episode(np.zeros_like(task.goal), np.asarray(task.goal))
        shared, shape = (self._physics, as_float(example)), (1, task.num_actions, task.num_pickers)
        idle = Actions(jnp.full(shape, NONE), jnp.zeros((*shape, 3), float))
        return PopulationMap(partial(_execute, task, self._engine), shared, idle, Layout())


def _execute(
    task: Task, engine: SearchEngine, shared: tuple[PyTree[Any], Episode], actions: Actions
) -> tuple[Float[Array, "T2 N 3"], Float[Array, ""], Float[Array, ""]]:
    """Positions at the start, after each action and settled; score of the last; and `missed`."""
    physics, episode = shared
    start = at_rest(episode.start)
    followed = then_idle(actions, task.settle_actions)
    final, positions = engine.rollout(physics, start, followed, lambda state, _: state.position)
    during = positions[: task.num_actions]
    positions = jnp.concatenate([start.position[None], during, final.position[None]])
    return positions, score(task, episode, final.position), final.missed


def as_float(tree: PyTree[Any]) -> PyTree[np.ndarray]:
    """Arrays on the host, in JAX's current floating point precision."""
    dtype = np.dtype(jnp.result_type(float))
    return jax.tree.map(lambda array: np.asarray(array, dtype), tree)
