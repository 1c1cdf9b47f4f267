"""Tasks, and the score of states."""

import dataclasses
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from jaxsimp import goals
from jaxsimp.bodies import Body
from jaxsimp.checks import keep, require_count, require_number
from jaxsimp.dynamics import (
    Obstacle,
    Pickers,
    Simulation,
    State,
    Table,
    at_rest,
    largest_time_step,
    make_pickers,
    make_simulation,
)
from jaxsimp.dynamics.arrays import require_positions
from jaxsimp.dynamics.contact.obstacles import check_obstacles, has_table
from jaxsimp.dynamics.pickers import Pinch, require_limits, require_pinch, top_speed
from jaxsimp.tasks.check import check_costs, check_draw
from jaxsimp.tasks.episode import (
    DrawFn,
    Episode,
    EpisodeFn,
    RunningCost,
    TerminalCost,
    require_episode,
)

COUNTS = {"num_actions": (1, 10_000), "num_pickers": (1, 1000), "settle_actions": (0, 10_000)}
"""Least and most of a task's counts."""
FARTHEST_GRIPPERS = 10.0
"""Most of a task's `gripper_distance`, metres."""
SECONDS = {"action_seconds": (1e-4, 1e4), "longest_time_step": (1e-6, 1.0)}
"""Least and most of a task's times, seconds."""


@dataclass(frozen=True, eq=False)
class Task:
    """A body, its start and goal, and the costs that a planner minimises.

    Attributes:
        body: the body to manipulate.
        goal: goal positions for the search of key points, shape (N, 3), metres.
        episode_fn: function from a seed to an episode, start and goal.
        running_cost: cost of an episode, the state at the end of an action, and that action,
            shapes (G,) and (G, 3): a scalar, at least 0; pure JAX.
        terminal_cost: cost of an episode and the settled state: a scalar, at least 0; pure JAX.
        limits: largest displacement of one action along x, y, z, metres.
        num_actions: number of actions in a plan, `T`.
        num_pickers: number of pickers, `G`.
        action_seconds: duration of one action, seconds.
        settle_actions: time with nothing held, between the last action and the score, in multiples
            of `action_seconds`.
        longest_time_step: upper bound on the time step of the simulation, seconds.
        running_weight: weight of the running costs in the cost of a plan, in which the terminal
            cost counts once; 1 for the paper's sum.
        obstacles: rigid bodies at rest, in the order in which they act.
        pinch: what a picker holds besides the particle that an action names; None for that alone.
        gripper_distance: least distance of two pickers that both hold something, metres; plans in
            which they come nearer cost more, see `jaxsimp.tasks.grippers`. 0 for no limit.
        draw_fn: function from a key to an episode, in pure JAX; None if `episode_fn` alone makes
            episodes.
        name: name of the task; for a registered task that of its factory, see `register`.
        resolution: resolution of a registered task, see `make_task`; None for a task that is not
            registered.

    Raises:
        ValueError: if `goals.check_goal` raises for the goal, a number is out of its range, an
            obstacle is too small for the body, JAX cannot compile a cost, a cost is not a float
            scalar, or `draw_fn` does not draw an episode of the body.
    """

    body: Body
    goal: Float[np.ndarray, "N 3"]
    episode_fn: EpisodeFn
    running_cost: RunningCost
    terminal_cost: TerminalCost
    limits: tuple[float, float, float]
    num_actions: int = 4
    num_pickers: int = 2
    action_seconds: float = 0.3
    settle_actions: int = 4
    longest_time_step: float = 2e-3
    running_weight: float = 1.0
    obstacles: tuple[Obstacle, ...] = (Table(),)
    pinch: Pinch | None = None
    gripper_distance: float = 0.0
    draw_fn: DrawFn | None = None
    name: str = "unnamed"
    resolution: int | None = None

    def __post_init__(self) -> None:
        check_obstacles(self.obstacles, self.body)
        goals.check_goal(self.body, self.goal, has_table=has_table(self.obstacles))
        own: dict[str, object] = {
            "limits": require_limits(self.limits),
            "running_weight": require_number("running_weight", self.running_weight, 0.0, 1e6),
            "gripper_distance": require_number(
                "gripper_distance", self.gripper_distance, 0.0, FARTHEST_GRIPPERS, "m"
            ),
        }
        require_pinch(self.pinch)
        if not isinstance(self.name, str):
            raise ValueError(f"name is {self.name!r}; give a text")
        for name, counts in COUNTS.items():
            own[name] = require_count(name, getattr(self, name), *counts)
        for name, seconds in SECONDS.items():
            own[name] = require_number(name, getattr(self, name), *seconds, "s")
        keep(self, **own)  # plan files hold plain numbers
        check_costs(
            self.running_cost, self.terminal_cost, self.body.num_particles, self.num_pickers
        )
        if self.draw_fn is not None:
            check_draw(self.draw_fn, self.body.num_particles)

    def draw_episode(self, key: PRNGKeyArray) -> Episode:
        """A random episode from a key: pure JAX, to which `jit` and `vmap` over keys apply.

        Starts and goals have the same distribution as those of `episode_fn`.

        Raises:
            ValueError: if the task has no `draw_fn`.
        """
        if self.draw_fn is None:
            raise ValueError(
                f"the task {self.name!r} has no draw_fn; use episode_fn(seed), or give the task a "
                f"draw_fn"
            )
        return self.draw_fn(key)

    def simulation(self, *, self_contact: bool = False) -> Simulation:
        """The body's simulation, at the task's time step.

        Args:
            self_contact: whether the body touches itself, at picker speeds up to `top_speed`.

        Raises:
            ValueError: if the body has no thickness, or pickers are too fast, for self-contact.
        """
        return make_simulation(
            self.body,
            self.time_step,
            obstacles=self.obstacles,
            self_contact=self_contact,
            top_speed=self.top_speed,
        )

    @property
    def top_speed(self) -> float:
        """Largest speed of a picker, metres per second: midway along its longest displacement."""
        return top_speed(self.limits, self.action_seconds)

    def pickers(self) -> Pickers:
        """Limits of the pickers' motion, at the task's time step."""
        return make_pickers(self.limits, steps=self.action_steps, pinch=self.pinch)

    @property
    def time_step(self) -> float:
        """Time step, seconds: 0.9 of the largest stable one, and at most `longest_time_step`."""
        return min(self.longest_time_step, 0.9 * largest_time_step(self.body))

    @property
    def action_steps(self) -> int:
        """Number of time steps of one action.

        Raises:
            ValueError: if an action is shorter than half a time step.
        """
        steps = round(self.action_seconds / self.time_step)
        if steps < 1:
            raise ValueError(
                f"action_seconds is {self.action_seconds:g}, less than half a time step of "
                f"{self.time_step:.4g} s; give longer actions, or a smaller longest_time_step"
            )
        return steps


def score(
    task: Task, episode: Episode, state: State | Float[Array | np.ndarray, "N 3"]
) -> Float[Array, ""]:
    """Normalised score `(c_0 - c) / c_0`: 1 where the cost is 0, 0 where it is that of the start.

    `c_0` and `c` are the terminal costs of the start, at rest, and of the state. Where `c_0` is 0
    the score is its limit for small `c_0`: 1 if `c` is 0 too, minus infinity if `c` is more. The
    score is NaN only if a cost is NaN.

    Args:
        task: the task.
        episode: start and goal.
        state: the state to score, or positions at rest, shape (N, 3), metres.

    Raises:
        ValueError: if the episode or the state is not of the task's body.
    """
    episode = require_episode(episode, task.body.num_particles)
    moving = state if isinstance(state, State) else at_rest(state)
    position = require_positions(
        "the position of the state", moving.position, task.body.num_particles
    )
    state = dataclasses.replace(moving, position=position)
    start = task.terminal_cost(episode, at_rest(episode.start))
    ratio = _saved(start, task.terminal_cost(episode, state))

    # Division by a start of zero cost gives -inf, or NaN if both costs are zero. Only that case
    # uses the cost again: a second use of it would change how XLA rounds the ratio.
    def of_free_start(state: State) -> Float[Array, ""]:
        cost = task.terminal_cost(episode, state)
        return jnp.where(cost == 0, 1.0, jnp.nan).astype(ratio.dtype)

    return jax.lax.cond(jnp.isnan(ratio), of_free_start, lambda _: ratio, state)


@jax.custom_jvp
def _saved(start: Float[Array, ""], cost: Float[Array, ""]) -> Float[Array, ""]:
    """The saved fraction of the start's cost; its gradient is 0 if the start has zero cost."""
    return (start - cost) / start


@_saved.defjvp
def _saved_jvp(
    primals: tuple[Array, Array], tangents: tuple[Array, Array]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    start, cost = primals
    divisor = jnp.where(start != 0, start, 1.0)
    change = (tangents[0] * cost / divisor - tangents[1]) / divisor
    return _saved(start, cost), jnp.where(start != 0, change, 0.0)
