"""Planning: from a task and the particles that may be grasped to a plan, and its execution."""

import dataclasses
import os
import time
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from jaxsimp.dynamics import NONE, Actions, State, at_rest
from jaxsimp.engines import Engine, Ensemble, MassSprings
from jaxsimp.engines.ensemble import over_members
from jaxsimp.planning.cem import CEMConfig, Search, search
from jaxsimp.planning.encodings import ActionSpace, Encoding
from jaxsimp.planning.evaluate import Layout, PopulationMap, default_layout
from jaxsimp.tasks import Episode, Task, score


@dataclass(frozen=True, eq=False)
class Plan:
    """A plan and how it was found.

    Attributes:
        actions: shapes (T, G) and (T, G, 3).
        search: costs by iteration and counts of rollouts.
        seconds: that the search took, compilation not included.
        compile_seconds: that compiling the draws and updates took, next to nothing where an
            earlier plan has had the same candidates and encoding.
    """

    actions: Actions
    search: Search
    seconds: float
    compile_seconds: float


@dataclass(frozen=True, eq=False)
class Execution:
    """What a plan does.

    Attributes:
        positions: at the start, after each action, and settled, shape (T + 2, N, 3), metres.
        score: normalised score of the settled state.
        missed: contacts whose particles got past each other; None without self-contact.
    """

    positions: Float[np.ndarray, "T2 N 3"]
    score: float
    missed: int | None = None


class Planner:
    """A task made ready to be planned for: its rollouts, compiled.

    Attributes:
        task: what is planned for.
        config: settings of the search.
        layout: of the population on this machine.
        ensemble: of physics that plans are costed in, if it is not the task's own alone.
        compile_seconds: that compiling the rollouts took.
    """

    def __init__(
        self,
        task: Task,
        config: CEMConfig,
        layout: Layout | None = None,
        engine: Engine | None = None,
        ensemble: Ensemble | None = None,
        judge: Engine | None = None,
    ) -> None:
        """Compile the task's rollouts for the population of `config`.

        Args:
            task: what is planned for.
            config: settings of the search.
            layout: of the population on this machine; by default the one measured to be best.
            engine: that carries out the plans of the search; by default our own dynamics.
            ensemble: of physics that plans are costed in; by default the task's own alone.
            judge: engine that executes the plan found; by default our own dynamics, the body
                touching itself (see `MassSprings`), or that of the search where it is another's.

        Raises:
            ValueError: if an engine refuses the task, or there is an ensemble, and an engine of the
                search that is not our own dynamics without self-contact.
        """
        self.task, self.config, self.ensemble = task, config, ensemble
        engine = engine or MassSprings()
        ours = isinstance(engine, MassSprings)
        if ensemble is not None and engine != MassSprings():
            raise ValueError(
                f"engine is {engine}, and an ensemble is of our own dynamics, with self-contact if "
                f"it was made so; leave one of them out"
            )
        judge = judge or (MassSprings(self_contact=True) if ours else engine)
        self._cost_physics, self._physics = engine.physics(task), judge.physics(task)
        simulation = self._cost_physics[0] if ours else task.simulation()
        if ensemble is not None:
            simulation = jax.tree.map(lambda leaf: leaf[0], ensemble.simulations)
        self.layout = layout or default_layout(config.population, simulation)
        cost_fn: Callable[..., Array] = partial(_plan_cost, task, engine)
        if ensemble is not None:
            self._cost_physics, cost_fn = ensemble.physics(task), over_members(cost_fn)
        episode = self._episode(task.episode_fn(0))
        costed, executed = (self._cost_physics, episode), (self._physics, episode)
        one = jax.tree.map(lambda array: array[:1], self._idle())
        self._costs = PopulationMap(cost_fn, costed, self._idle(), self.layout)
        self._execution = PopulationMap(partial(_execute, task, judge), executed, one, Layout())
        self.compile_seconds = self._costs.compile_seconds + self._execution.compile_seconds

    def plan(
        self,
        episode: Episode,
        candidates: Int[np.ndarray, " K"],
        encoding: Encoding,
        seed: int,
        on_population: Callable[[], None] = lambda: None,
    ) -> Plan:
        """Search for a plan.

        Args:
            episode: start and goal.
            candidates: ids of the particles that may be grasped, shape (K,).
            encoding: of plans as samples of a distribution.
            seed: of the random draws.
            on_population: called after each population.
        """
        space = ActionSpace(
            jnp.asarray(candidates),
            jnp.asarray(self.task.limits, dtype=float),
            self.task.num_actions,
            self.task.num_pickers,
        )
        key = jax.random.key(seed)
        start = time.perf_counter()
        once = dataclasses.replace(self.config, num_iterations=1, initial_populations=1)
        search(space, encoding, once, key, lambda actions: np.zeros(len(actions.pick)))
        compiled = time.perf_counter()
        costs = partial(self.costs, episode)
        found = search(space, encoding, self.config, key, costs, on_population)
        return Plan(
            actions=found.actions,
            search=found,
            seconds=time.perf_counter() - compiled,
            compile_seconds=compiled - start,
        )

    def costs(self, episode: Episode, actions: Actions) -> Float[np.ndarray, " B"]:
        """Costs of plans, at most as many as the population: what the search minimises.

        Args:
            episode: start and goal.
            actions: the plans, shapes (B, T, G) and (B, T, G, 3).
        """
        costs = self._costs((self._cost_physics, self._episode(episode)), actions)
        return costs if self.ensemble is None else self.ensemble.cost(costs)

    def estimate_seconds(self) -> float:
        """Seconds that a plan takes, from one evaluation of plans that grasp and move anything.

        With self-contact the folds that a search comes to take up to twice as long as those.
        """
        episode, idle, rng = self.task.episode_fn(0), self._idle(), np.random.default_rng(0)
        picks = rng.integers(self.task.body.num_particles, size=idle.pick.shape)
        moves = rng.uniform(-1, 1, idle.displacement.shape) * self.task.limits
        drawn = Actions(jnp.asarray(picks), jnp.asarray(moves, self._dtype))
        start = time.perf_counter()
        self.costs(episode, drawn)
        return (time.perf_counter() - start) * self.config.num_populations

    def execute(self, episode: Episode, actions: Actions) -> Execution:
        """Carry out a plan, let the body settle, and score it."""
        shared = (self._physics, self._episode(episode))
        one = jax.tree.map(lambda array: jnp.asarray(array)[None], actions)
        (positions,), (value,), missed = self._execution(shared, one)
        return Execution(positions, float(value), None if missed is None else int(missed[0]))

    def _idle(self) -> Actions:
        """A population of plans that grasp nothing."""
        shape = (self.config.population, self.task.num_actions, self.task.num_pickers)
        return Actions(jnp.full(shape, NONE), jnp.zeros((*shape, 3), self._dtype))

    def _episode(self, episode: Episode) -> Episode:
        return jax.tree.map(lambda array: np.asarray(array, self._dtype), episode)

    @property
    def _dtype(self) -> np.dtype:
        return np.dtype(jnp.result_type(float))


def _plan_cost(
    task: Task, engine: Engine, shared: tuple[PyTree[Any], Episode], actions: Actions
) -> Float[Array, ""]:
    """Cost of a plan: the sum of the step costs over its actions (paper, IV-A).

    The state that is left when the pickers have let go counts as one more step.
    """
    physics, episode = shared

    def step_cost(state: State) -> Float[Array, ""]:
        # An engine's observation does not see the action yet: that of the first stands for it.
        return task.running_cost(episode, state, jax.tree.map(lambda array: array[0], actions))

    start = at_rest(episode.start)
    _, costs = engine.rollout(physics, start, _then_idle(actions, 1), step_cost)
    return costs.sum()


def _execute(
    task: Task, engine: Engine, shared: tuple[PyTree[Any], Episode], actions: Actions
) -> tuple[Float[Array, "T2 N 3"], Float[Array, ""], Int[Array, ""] | None]:
    """Positions at the start, after each action and settled, score of the last, and `missed`."""
    physics, episode = shared
    start = at_rest(episode.start)
    followed = _then_idle(actions, task.settle_actions)
    final, positions = engine.rollout(physics, start, followed, lambda state: state.position)
    during = positions[: task.num_actions]
    positions = jnp.concatenate([start.position[None], during, final.position[None]])
    return positions, score(task, episode, final.position), final.missed


def _then_idle(actions: Actions, count: int) -> Actions:
    """A plan followed by `count` actions that grasp nothing."""
    num_pickers = actions.pick.shape[1]
    return Actions(
        jnp.concatenate([actions.pick, jnp.full((count, num_pickers), NONE)]),
        jnp.concatenate([actions.displacement, jnp.zeros((count, num_pickers, 3))]),
    )


def save_plan(path: Path, actions: Actions, positions: Float[np.ndarray, "T2 N 3"]) -> None:
    """Write a plan as `.npz`: it appears under its name whole or not at all.

    Args:
        path: of the file.
        actions: the plan.
        positions: of its execution, see `Execution`.
    """
    part = path.with_name(path.name + ".part")
    with part.open("wb") as file:
        np.savez_compressed(
            file, pick=actions.pick, displacement=actions.displacement, positions=positions
        )
    os.replace(part, path)


def load_plan(path: Path) -> tuple[Actions, dict[str, Any]]:
    """Read a plan written by `save_plan`: its actions, and all arrays by name.

    Raises:
        ValueError: if the file holds no plan.
    """
    try:
        with path.open("rb") as file:
            arrays = dict(np.load(file))
    except (ValueError, EOFError, TypeError, zipfile.BadZipFile, zlib.error) as error:
        raise ValueError(f"{path} cannot be read ({error}); it is not a saved plan") from error
    missing = {"pick", "displacement", "positions"} - arrays.keys()
    if missing:
        raise ValueError(f"{path} has no {', '.join(sorted(missing))}; it is not a saved plan")
    return Actions(jnp.asarray(arrays["pick"]), jnp.asarray(arrays["displacement"])), arrays
