"""Tasks as environments of reinforcement learning: pure functions of arrays.

`reset` and `step` work under `jit`, `vmap` and `lax.scan`, and `jax.grad` applies to displacements.
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from jaxsimp.checks import require_flag
from jaxsimp.dynamics import NONE, Actions, Pickers, Simulation, at_rest
from jaxsimp.dynamics.contact.stepping import Moving, begin, end
from jaxsimp.dynamics.rollouts import act
from jaxsimp.planning import ActionSpace, Candidates, Plans, action_space
from jaxsimp.simplification import simplify
from jaxsimp.tasks import Episode, Task, score
from jaxsimp.tasks.episode import require_episode


@partial(jax.tree_util.register_dataclass, data_fields=["choice", "direction"], meta_fields=[])
@dataclass(frozen=True)
class EnvAction:
    """One action of all pickers, as one action of `jaxsimp.planning.Plans`.

    Attributes:
        choice: index of the grasped candidate, K for none, shape (G,).
        direction: displacement in units of the limits, in [-1, 1], shape (G, 3); clipped.
    """

    choice: Int[Array, "... G"]
    direction: Float[Array, "... G 3"]


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["position", "velocity", "goal", "time_left"],
    meta_fields=[],
)
@dataclass(frozen=True)
class Observation:
    """The part of a state that an agent sees.

    Attributes:
        position: positions of the particles, shape (N, 3), metres.
        velocity: their velocities, shape (N, 3), metres per second.
        goal: goal positions, shape (N, 3), metres.
        time_left: number of actions left, as a fraction of `Task.num_actions`.
    """

    position: Float[Array | np.ndarray, "... N 3"]
    velocity: Float[Array | np.ndarray, "... N 3"]
    goal: Float[Array | np.ndarray, "... N 3"]
    time_left: Float[Array | np.ndarray, "..."]


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["moving", "episode", "score", "num_actions"],
    meta_fields=[],
)
@dataclass(frozen=True)
class EnvState:
    """The state of an environment; `jax.vmap` adds axes.

    Attributes:
        moving: the body in motion and its contacts, a `Moving`, as rollouts carry them from action
            to action.
        episode: start and goal.
        score: score of the body's state, see `jaxsimp.tasks.score`.
        num_actions: number of actions so far.
    """

    moving: PyTree[Any]
    episode: Episode
    score: Float[Array | np.ndarray, "..."]
    num_actions: Int[Array | np.ndarray, "..."]


class Transition(NamedTuple):
    """Result of a step.

    Attributes:
        state: the next state.
        observation: what an agent sees of it.
        reward: increase of the score.
        done: whether the episode has ended.
        info: `score`, and `missed`, the number of tunnelled contacts so far.
    """

    state: EnvState
    observation: Observation
    reward: Float[Array | np.ndarray, "..."]
    done: Bool[Array | np.ndarray, "..."]
    info: dict[str, Array | np.ndarray]


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["space", "simulation", "pickers"],
    meta_fields=["task"],
)
@dataclass(frozen=True, eq=False)
class Env:
    """A task as an environment: an episode is `Task.num_actions` steps. Made by `make_env`.

    A pytree; `reset`, `start`, `step` and `observe` are pure functions.

    The reward of a step is the increase of the score, that is the decrease of the terminal cost
    divided by that of the start. The sum over an episode is the score of its end: after the last
    action the pickers let go and the body settles, within the same step, for `Task.settle_actions`
    times the duration of an action.

    An episode also ends where a state is not finite, as after an action that is not: that reward
    is NaN. Further steps change nothing, and their reward is 0.

    Attributes:
        space: candidates and limits of the actions.
        simulation: physics of the body.
        pickers: limits of the pickers' motion.
        task: the task; static.
    """

    space: ActionSpace
    simulation: Simulation
    pickers: Pickers
    task: Task

    def reset(self, key: PRNGKeyArray) -> EnvState:
        """The start of a random episode, see `Task.draw_episode`."""
        return self.start(self.task.draw_episode(key))

    def start(self, episode: Episode) -> EnvState:
        """The start of a given episode, as `task.episode_fn(seed)`.

        Raises:
            ValueError: if the episode is not of the task's body.
        """
        episode = require_episode(episode, self.task.body.num_particles)
        episode = jax.tree.map(partial(jnp.asarray, dtype=float), episode)
        still = at_rest(episode.start)
        return EnvState(
            moving=begin(self.simulation, still),
            episode=episode,
            score=score(self.task, episode, still),
            num_actions=jnp.zeros((), dtype=int),
        )

    def observe(self, state: EnvState) -> Observation:
        """What an agent sees of a state."""
        body = end(self.simulation, state.moving)
        left = 1.0 - state.num_actions / self.task.num_actions
        return Observation(body.position, body.velocity, state.episode.goal, left)

    def step(self, state: EnvState, action: EnvAction) -> Transition:
        """Carry out an action.

        Args:
            state: a state of `reset`, `start` or `step`.
            action: what each picker grasps, and where it moves that.
        """
        was_done = self._done(state)
        plan = Plans(action.choice[None], action.direction[None])
        one = jax.tree.map(lambda leaf: leaf[0], self.space.actions(plan))
        count = state.num_actions + 1
        moving = act(self.simulation, self.pickers, state.moving, one)
        moving = self._settled(moving, count == self.task.num_actions)
        found = score(self.task, state.episode, end(self.simulation, moving))
        after = replace(state, moving=moving, score=found, num_actions=count)
        after = _where(was_done, state, after)
        # Equal scores may both be minus infinity, of a start that costs nothing.
        gain = jnp.where(after.score == state.score, 0.0, after.score - state.score)
        missed = end(self.simulation, after.moving).missed
        return Transition(
            state=after,
            observation=self.observe(after),
            reward=jnp.where(was_done, 0.0, gain),
            done=self._done(after),
            info={"score": after.score, "missed": missed},
        )

    def _done(self, state: EnvState) -> Bool[Array, ""]:
        return jnp.isnan(state.score) | (state.num_actions >= self.task.num_actions)

    def _settled(self, moving: Moving, last: Bool[Array, ""]) -> Moving:
        """The body after the pickers have let go, if that was the last action."""
        num_pickers, count = self.task.num_pickers, self.task.settle_actions
        idle = Actions(
            jnp.full((count, num_pickers), NONE), jnp.zeros((count, num_pickers, 3), float)
        )

        def settle(moving: Moving) -> Moving:
            def one(moving: Moving, action: Actions) -> tuple[Moving, None]:
                return act(self.simulation, self.pickers, moving, action), None

            return _where(last, jax.lax.scan(one, moving, idle)[0], moving)

        return jax.lax.cond(_any_of_batch(last), settle, lambda moving: moving, moving)


def make_env(
    task: Task, candidates: Candidates | None = None, *, self_contact: bool = False
) -> Env:
    """The environment of a task.

    Args:
        task: the task; it has a `draw_fn`.
        candidates: particles that a picker may grasp; by default the key points of the task's goal.
        self_contact: whether the body touches itself, or passes through itself.

    Raises:
        ValueError: if the task has no `draw_fn`, a candidate is not a particle of the body, or the
            body has no self-contact.
    """
    require_flag("self_contact", self_contact)
    if task.draw_fn is None:
        raise ValueError(
            f"the task {task.name!r} has no draw_fn, by which an environment starts; give it one"
        )
    if candidates is None:
        candidates = simplify(task.body, task.goal)
    simulation = task.simulation(self_contact=self_contact)
    return Env(action_space(task, candidates), simulation, task.pickers(), task)


def _where(condition: Bool[Array, ""], tree: PyTree[Any], other: PyTree[Any]) -> PyTree[Any]:
    return jax.tree.map(partial(jnp.where, condition), tree, other)


@jax.custom_batching.custom_vmap
def _any_of_batch(flag: Bool[Array, ""]) -> Bool[Array, ""]:
    """The flag; under `vmap` whether any of the batch is set, so that `cond` stays a branch."""
    return flag


@_any_of_batch.def_vmap
def _(size: int, batched: list[bool], flag: Bool[Array, " B"]) -> tuple[Bool[Array, ""], bool]:
    return _any_of_batch(flag.any()), False
