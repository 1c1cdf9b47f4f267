"""Tasks: a body, where it starts, where it should end, and what a state costs.

The four tasks of the paper, after SoftGym and fabric-vsf. A task is made by a factory that
takes the resolution (particles along a side); `register` adds one, so a new task is one file.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from jaxsimp import goals
from jaxsimp.body import Body, cloth, rope
from jaxsimp.dynamics import (
    Actions,
    Simulation,
    State,
    at_rest,
    largest_time_step,
    make_pickers,
    make_simulation,
    rollout,
    settle,
)


@partial(jax.tree_util.register_dataclass, data_fields=["start", "goal"], meta_fields=[])
@dataclass(frozen=True)
class Episode:
    """Where one run starts and where it should end: positions, shape (N, 3), metres."""

    start: Float[Array | np.ndarray, "N 3"]
    goal: Float[Array | np.ndarray, "N 3"]


@dataclass(frozen=True, eq=False)
class Task:
    """What is asked of a planner.

    Attributes:
        name: in the registry.
        body: what is manipulated.
        goal: the goal configuration that key points are found in, shape (N, 3), metres.
        episode_fn: from a seed to start and goal.
        cost_fn: cost of positions in an episode, a scalar; pure JAX.
        limits: largest displacement of one action along x, y, z, metres.
        num_actions: actions in a plan, `T`.
        num_pickers: `G`.
        action_seconds: that one action takes.
        settle_actions: as many times `action_seconds` pass, with nothing held, after the
            last action and before the plan is scored.
        longest_time_step: bound on the time step of the simulation, seconds.
    """

    name: str
    body: Body
    goal: Float[np.ndarray, "N 3"]
    episode_fn: Callable[[int], Episode]
    cost_fn: Callable[[Episode, Float[Array, "N 3"]], Float[Array, ""]]
    limits: tuple[float, float, float]
    num_actions: int = 4
    num_pickers: int = 2
    action_seconds: float = 0.3
    settle_actions: int = 4
    longest_time_step: float = 2e-3

    def __post_init__(self) -> None:
        goals.check_goal(self.body, self.goal)

    def simulation(self) -> Simulation:
        """The body's simulation, at the task's time step."""
        return make_simulation(self.body, self.time_step)

    @property
    def time_step(self) -> float:
        """Seconds: nine tenths of the largest stable one, and at most `longest_time_step`."""
        return min(self.longest_time_step, 0.9 * largest_time_step(self.body))

    @property
    def action_steps(self) -> int:
        """Time steps of one action."""
        return round(self.action_seconds / self.time_step)


def score(task: Task, episode: Episode, position: Float[Array, "N 3"]) -> Float[Array, ""]:
    """Normalised score `(c_0 - c) / c_0`: 1 at the goal, 0 for a state as good as the start."""
    start = task.cost_fn(episode, jnp.asarray(episode.start))
    return (start - task.cost_fn(episode, position)) / start


TaskFactory = Callable[[int], Task]

_REGISTRY: dict[str, tuple[TaskFactory, int, int]] = {}


def register(name: str, *, full: int, quick: int) -> Callable[[TaskFactory], TaskFactory]:
    """Add a task to the registry under a name.

    Args:
        name: of the task.
        full: resolution of the task as it is studied.
        quick: resolution for tests and smoke runs.

    Raises:
        ValueError: if the name is taken.
    """
    if name in _REGISTRY:
        raise ValueError(f"task {name!r} is registered already; choose another name")

    def add(factory: TaskFactory) -> TaskFactory:
        _REGISTRY[name] = (factory, full, quick)
        return factory

    return add


def task_names() -> tuple[str, ...]:
    """Names of the registered tasks."""
    return tuple(_REGISTRY)


def make_task(name: str, resolution: int | None = None, *, quick: bool = False) -> Task:
    """A registered task.

    Args:
        name: one of `task_names()`.
        resolution: particles along the rope or along a side of the cloth; by default that of
            the full or the quick scale.
        quick: which of the two scales is the default.

    Raises:
        ValueError: if there is no such task, or the resolution is too low for it.
    """
    if name not in _REGISTRY:
        raise ValueError(f"unknown task {name!r}; choose from {', '.join(_REGISTRY)}")
    factory, full, small = _REGISTRY[name]
    if resolution is None:
        resolution = small if quick else full
    if resolution < 5:
        raise ValueError(f"resolution is {resolution}; a task needs at least 5 particles a side")
    return factory(resolution)


# --- rope -----------------------------------------------------------------------------------

ROPE_LENGTH = 0.5375
"""Rest length of SoftGym's rope, metres; the straight goal is `SLACK` of it long."""
SLACK = 0.5 / ROPE_LENGTH
ROPE_LIMITS = (0.15, 0.15, 0.15)
"""Largest displacement of one action along x, y, z, metres."""


@register("rope_straightening", full=41, quick=21)
def rope_straightening(resolution: int) -> Task:
    """Pull a crumpled rope straight: cost `abs(|p_1 - p_N| - L)`, as in SoftGym.

    `L` is the length of the slack straight goal; the start is a straight rope after four
    random picks (see `crumple`).
    """
    body = rope(resolution, ROPE_LENGTH)
    goal = goals.straight(body, SLACK * body.size)

    def cost(episode: Episode, position: Float[Array, "N 3"]) -> Float[Array, ""]:
        goal = jnp.asarray(episode.goal)
        return jnp.abs(_distance(position[0] - position[-1]) - _distance(goal[0] - goal[-1]))

    return Task(
        name="rope_straightening",
        body=body,
        goal=goal,
        limits=ROPE_LIMITS,
        episode_fn=lambda seed: Episode(crumple(body, seed), goal),
        cost_fn=cost,
    )


@register("rope_folding", full=41, quick=21)
def rope_folding(resolution: int) -> Task:
    """Lay a straight rope along two sides of an equilateral triangle, its corner at the middle.

    The cost is SoftGym's bipartite matching distance between 11 particles, evenly chosen, and
    their goal positions: the mean distance in the best assignment.
    """
    body = rope(resolution, ROPE_LENGTH)
    side = body.size / 2
    height = np.sqrt(3) / 2 * side
    corners = np.array([[-side / 2, -height / 2], [0.0, height / 2], [side / 2, -height / 2]])
    goal = goals.polyline(body, corners)
    start = goals.straight(body)
    chosen = np.unique(np.round(np.linspace(0, resolution - 1, 11)).astype(int))

    def cost(episode: Episode, position: Float[Array, "N 3"]) -> Float[Array, ""]:
        return matching_distance(position[chosen], jnp.asarray(episode.goal)[chosen])

    return Task(
        name="rope_folding",
        body=body,
        goal=goal,
        limits=ROPE_LIMITS,
        episode_fn=lambda seed: Episode(start, goal),
        cost_fn=cost,
    )


def crumple(body: Body, seed: int) -> Float[np.ndarray, "N 3"]:
    """A random settled state of a body, shape (N, 3): SoftGym's four random picks.

    Each pick carries a random particle up to 0.3 m sideways and 0.6 m up, and drops it.

    Args:
        body: starts straight or flat on the table.
        seed: of the random picks.
    """
    key_pick, key_move = jax.random.split(jax.random.key(seed))
    pick = jax.random.randint(key_pick, (4, 1), 0, body.num_particles)
    farthest = jnp.array([[[0.3, 0.3, 0.6]]])
    nearest = jnp.array([[[-0.3, -0.3, 0.0]]])
    move = jax.random.uniform(key_move, (4, 1, 3), minval=nearest, maxval=farthest)
    actions = Actions(pick, move)
    return np.asarray(_drop(body)(actions))


@cache
def _drop(body: Body) -> Callable[[Actions], Float[Array, "N 3"]]:
    """Carry out one action after another on a flat body, letting it settle after each."""
    time_step = min(1e-3, 0.9 * largest_time_step(body))
    simulation = make_simulation(body, time_step)
    pickers = make_pickers((0.3, 0.3, 0.6), steps=round(0.5 / time_step))
    settle_steps = round(1.0 / time_step)

    @jax.jit
    def drop(actions: Actions) -> Float[Array, "N 3"]:
        def one(state: State, action: Actions) -> tuple[State, None]:
            single = jax.tree.map(lambda array: array[None], action)
            state, _ = rollout(simulation, pickers, state, single)
            return settle(simulation, state, settle_steps), None

        return jax.lax.scan(one, at_rest(goals.flat(body)), actions)[0].position

    return drop


def matching_distance(
    points: Float[Array, "M 3"], targets: Float[Array, "M 3"]
) -> Float[Array, ""]:
    """Mean distance, metres, between points and targets in the best one-to-one assignment."""
    distances = _distance(points[:, None] - targets[None, :])
    rows, columns = optax.assignment.hungarian_algorithm(jax.lax.stop_gradient(distances))
    return distances[rows, columns].mean()


# --- cloth ----------------------------------------------------------------------------------

STILL_WEIGHT = 1.2
"""Weight of the displacement of the half that should lie still, after SoftGym."""


@register("cloth_side_folding", full=25, quick=9)
def cloth_side_folding(resolution: int) -> Task:
    """Fold a square cloth in half sideways."""
    body = cloth((resolution, resolution))
    row, column = np.divmod(np.arange(resolution**2), resolution)
    moving = np.flatnonzero(2 * row <= resolution - 1)
    mirror = (resolution - 1 - row) * resolution + column
    return _fold_task("cloth_side_folding", body, (0.0, 1.0), moving, mirror)


@register("cloth_diagonal_folding", full=25, quick=9)
def cloth_diagonal_folding(resolution: int) -> Task:
    """Fold a square cloth along its diagonal."""
    body = cloth((resolution, resolution))
    row, column = np.divmod(np.arange(resolution**2), resolution)
    moving = np.flatnonzero(row + column <= resolution - 1)
    mirror = (resolution - 1 - column) * resolution + (resolution - 1 - row)
    return _fold_task("cloth_diagonal_folding", body, (-1.0, 1.0), moving, mirror)


def _fold_task(
    name: str, body: Body, direction: tuple[float, float], moving: np.ndarray, mirror: np.ndarray
) -> Task:
    """A fold about a line through the middle.

    The cost is `mean |a_i - b_i| + 1.2 mean |b_i - b_i(0)|`, with `a` the moving half and `b`
    its mirror image in the half that should lie still. The start is flat, turned at random
    within 45 degrees, as in SoftGym.
    """
    still = mirror[moving]
    line = np.zeros(2), np.array(direction)

    def cost(episode: Episode, position: Float[Array, "N 3"]) -> Float[Array, ""]:
        apart = _distance(position[moving] - position[still]).mean()
        dragged = _distance(position[still] - jnp.asarray(episode.start)[still]).mean()
        return apart + STILL_WEIGHT * dragged

    def episode(seed: int) -> Episode:
        angle = np.random.default_rng(seed).uniform(-np.pi / 4, np.pi / 4)
        return Episode(goals.flat(body, angle), goals.turn(goal, angle))

    goal = goals.fold(body, goals.flat(body), *line)
    return Task(
        name=name,
        body=body,
        goal=goal,
        episode_fn=episode,
        cost_fn=cost,
        limits=(0.2, 0.2, 0.2),
        num_actions=2,
        action_seconds=0.25,
    )


def _distance(difference: Float[Array, "*M 3"]) -> Float[Array, "*M"]:
    """Euclidean length, with a finite gradient where it is zero."""
    squared = jnp.sum(jnp.square(difference), axis=-1)
    apart = squared > 0
    return jnp.where(apart, jnp.sqrt(jnp.where(apart, squared, 1.0)), 0.0)
