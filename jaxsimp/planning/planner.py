"""Planner: runs algorithms on the host, on all cores, with progress; and carries out plans."""

import dataclasses
import time
from collections.abc import Callable
from collections.abc import Sequence as Seq
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxsimp.checks import require_seed
from jaxsimp.dynamics import NONE, Actions
from jaxsimp.engines import (
    Engine,
    Execution,
    Executor,
    Layout,
    MassSprings,
    PopulationMap,
    SearchEngine,
    default_layout,
)
from jaxsimp.engines.rollouts import as_float, require_plan
from jaxsimp.planning.algorithm import PRICES, Algorithm, Sequence, Told, Wants, stages
from jaxsimp.planning.default import default_algorithm
from jaxsimp.planning.host import compiled_exchanges, questions
from jaxsimp.planning.loop import Optimum, Question, answered, archive_size, evaluation
from jaxsimp.planning.problem import Candidates, TaskProblem, action_space, make_problem
from jaxsimp.planning.screening import num_again, screened
from jaxsimp.planning.space import ActionSpace
from jaxsimp.tasks import Episode, Task
from jaxsimp.tasks.episode import require_episode


@dataclass(frozen=True, eq=False)
class Plan:
    """A plan and the record of its search.

    Attributes:
        actions: the plan, shapes (T, G) and (T, G, 3).
        optimum: costs by question, the best distinct plans, and failures.
        num_rollouts: number of plans evaluated.
        price: price of the search, in rollouts: a gradient counts as several, see `PRICES`.
        seconds: search time without compilation, seconds.
        compile_seconds: compilation time, seconds; near 0 if an earlier plan had the same number
            of candidates and the same algorithm.
    """

    actions: Actions
    optimum: Optimum
    num_rollouts: int
    price: int
    seconds: float
    compile_seconds: float


class Planner:
    """Planner of one task: it keeps compiled functions for further plans.

    Attributes:
        task: the task.
        engine: engine that gives the costs of plans.
        evaluator: engine that carries out the plan found, and scores it.
        layout: layout of populations on this machine; None for the fastest in measurements.
    """

    def __init__(
        self,
        task: Task,
        engine: SearchEngine | None = None,
        evaluator: Engine | None = None,
        layout: Layout | None = None,
    ) -> None:
        """Make a planner; compilation waits until it is needed.

        Args:
            task: the task.
            engine: engine that gives the costs of plans; by default our own dynamics, without
                self-contact.
            evaluator: engine that carries out the plan found; by default our own dynamics, with
                self-contact.
            layout: layout of populations on this machine; by default the fastest in measurements.

        Raises:
            ValueError: if the engine cannot carry out plans of the task.
        """
        self.task, self.layout = task, layout
        for name, given, protocol in (
            ("engine", engine, SearchEngine),
            ("evaluator", evaluator, Engine),
        ):
            if given is not None and not (_is_object(given) and isinstance(given, protocol)):
                raise ValueError(
                    f"{name} is {given!r}; give an engine, as MassSprings(self_contact=True)"
                )
        self.engine = engine or MassSprings()
        self.evaluator = evaluator or MassSprings(self_contact=True)
        if layout is not None and not isinstance(layout, Layout):
            raise ValueError(f"layout is {layout!r}; give Layout(chunk_size, num_workers), or None")
        self._maps: dict[tuple[Wants, int], tuple[TaskProblem, PopulationMap]] = {}
        # Evaluations do not depend on the candidates.
        self._problem = self._host_problem(None)

    def plan(
        self,
        episode: Episode,
        candidates: Candidates,
        algorithm: Algorithm | Sequence | None = None,
        seed: int = 0,
        on_ask: Callable[[], None] = lambda: None,
    ) -> Plan:
        """Search for a plan.

        Args:
            episode: start and goal.
            candidates: particles that a picker may grasp: key points, ids, or a mask.
            algorithm: algorithm of the search, or a sequence of algorithms; by default
                `default_algorithm`, without its reranking if the evaluator is not in JAX.
            seed: seed of the random draws.
            on_ask: function called after each question of the algorithm.

        Raises:
            ValueError: if a candidate is not a particle of the body, the episode is not of the
                body, the seed is none, or the algorithm asks for settled scores and the evaluator
                is not an engine in JAX.
        """
        (plan,) = self.plan_batch([episode], [candidates], algorithm, [seed], on_ask)
        return plan

    def plan_batch(
        self,
        episodes: Seq[Episode],
        candidates: Seq[Candidates],
        algorithm: Algorithm | Sequence | None = None,
        seeds: Seq[int] | None = None,
        on_ask: Callable[[], None] = lambda: None,
    ) -> tuple[Plan, ...]:
        """Search for plans of several episodes, as starts or goals, side by side.

        They are the plans that `plan` finds, bit for bit, in less time: what one search leaves idle
        of the machine another one uses.

        Args:
            episodes: starts and goals.
            candidates: particles that a picker may grasp, for each episode.
            algorithm: algorithm of each search, or a sequence of algorithms; as for `plan`.
            seeds: seed of each search; 0, 1, ... by default.
            on_ask: function called after each question of a search.

        Raises:
            ValueError: if the numbers of episodes, candidates and seeds differ or are 0, or for the
                reasons of `plan`.
        """
        seeds = range(len(episodes)) if seeds is None else seeds
        if not 0 < len(episodes) == len(candidates) == len(seeds):
            raise ValueError(
                f"there are {len(episodes)} episodes, {len(candidates)} sets of candidates and "
                f"{len(seeds)} seeds; give as many of each, at least one"
            )
        if algorithm is None:
            reranks = isinstance(self.evaluator, SearchEngine)
            algorithm = default_algorithm(self.task, reranks=reranks)
        keys = [jax.random.key(require_seed(seed)) for seed in seeds]
        size = self.task.body.num_particles
        checked = [as_float(require_episode(each, size)) for each in episodes]
        spaces = [action_space(self.task, each) for each in candidates]
        compile_seconds = sum(self.prepare(algorithm, space) for space in spaces)
        bill = _Bill(partial(self._told, checked), _largest_population(algorithm))
        start = time.perf_counter()
        searches = [
            questions(algorithm, space, key, on_ask)
            for space, key in zip(spaces, keys, strict=True)
        ]
        found = answered(searches, bill)
        jax.block_until_ready(found)
        seconds = time.perf_counter() - start
        return tuple(
            Plan(
                actions=optimum.actions,
                optimum=optimum,
                num_rollouts=bill.num_plans,
                price=bill.price,
                seconds=seconds / len(found),
                compile_seconds=compile_seconds / len(found),
            )
            for optimum in found
        )

    def prepare(self, algorithm: Algorithm | Sequence, space: ActionSpace | None = None) -> float:
        """Compile the functions of an algorithm, and return the compilation time, seconds.

        Args:
            algorithm: algorithm of the search, or a sequence of algorithms.
            space: space of plans to search; without it `prepare` compiles only the evaluations.

        Raises:
            ValueError: if the algorithm asks for settled scores and the evaluator is not an engine
                in JAX.
        """
        start = time.perf_counter()
        for stage in stages(algorithm):
            for wants, size in _evaluations(stage):
                self._evaluation(wants, size)
            if space is not None:
                compiled_exchanges(stage, space, archive_size(algorithm))
        return time.perf_counter() - start

    def costs(self, episode: Episode, actions: Actions) -> Float[np.ndarray, " B"]:
        """Costs of plans, which a search minimises.

        Args:
            episode: start and goal.
            actions: the plans, shapes (B, T, G) and (B, T, G, 3).

        Raises:
            ValueError: if the episode is not of the body, or `require_plan` refuses the plans.
        """
        episode = require_episode(episode, self.task.body.num_particles)
        actions = require_plan(self.task, actions, batch=True)
        sizes = [
            size for wants, size in self._maps if wants == "cost" and size >= len(actions.pick)
        ]
        size = min(sizes, default=len(actions.pick))
        (told,) = self._told([as_float(episode)], "cost", [actions], size)
        return np.asarray(told.costs)

    def estimate_seconds(self, algorithm: Algorithm | Sequence) -> float:
        """Estimate the time of a search, seconds, from one evaluation of random plans.

        With self-contact, the folds that a search converges to take up to twice as long.
        """
        episode, seconds = as_float(self.task.episode_fn(0)), 0.0
        for stage in stages(algorithm):
            drawn = self._random_plans(stage.num_plans)
            self.prepare(stage)
            start = time.perf_counter()
            self._told([episode], stage.wants, [drawn], stage.num_plans)
            seconds += (time.perf_counter() - start) * stage.num_asks
        return seconds

    def execute(self, episode: Episode, actions: Actions) -> Execution:
        """Carry out a plan in the evaluator's physics, let the body settle, and score it.

        Raises:
            ValueError: if the episode or the plan is not of the task.
        """
        return self._executor(episode, actions)

    @cached_property
    def _executor(self) -> Executor:
        return self.evaluator.executor(self.task)

    def _random_plans(self, size: int) -> Actions:
        """Plans with random picks and displacements."""
        task, rng = self.task, np.random.default_rng(0)
        shape = (size, task.num_actions, task.num_pickers)
        picks = rng.integers(task.body.num_particles, size=shape)
        moves = rng.uniform(-1, 1, (*shape, 3)) * task.limits
        return Actions(jnp.asarray(picks), jnp.asarray(moves, float))

    def _told(
        self, episodes: Seq[Episode], wants: Wants, asked: Seq[Actions], size: int
    ) -> list[Told]:
        """Evaluate plans of each episode, at most `size` of each, on all cores."""
        if wants != "screened":
            return self._look(episodes, wants, asked, size)
        return [
            screened(
                partial(self._look_at, episode, "cost", size),
                partial(self._look_at, episode, wants, num_again(size)),
                plans,
            )
            for episode, plans in zip(episodes, asked, strict=True)
        ]

    def _look_at(self, episode: Episode, wants: Wants, size: int, plans: Actions) -> Told:
        """Evaluate at most `size` plans of one episode in one fidelity."""
        (told,) = self._look([episode], wants, [plans], size)
        return told

    def _look(
        self, episodes: Seq[Episode], wants: Wants, asked: Seq[Actions], size: int
    ) -> list[Told]:
        """Evaluate in one fidelity, as many questions at a time as fill all cores.

        A question takes whole chunks, so that its plans run through the same machine code whatever
        others are beside it.
        """
        problem, evaluate = self._evaluation(wants, size)
        width = evaluate.whole_chunks(size)
        samples = [
            _samples(episode, actions, width)
            for episode, actions in zip(episodes, asked, strict=True)
        ]
        told: list[Told] = []
        count = max(1, evaluate.capacity // width)
        for first in range(0, len(samples), count):
            group = samples[first : first + count]
            together = tuple(map(np.concatenate, zip(*group, strict=True)))
            found = evaluate(problem, together)
            for index in range(len(group)):
                own = slice(index * width, index * width + len(asked[len(told)].pick))
                told.append(jax.tree.map(lambda leaf, own=own: leaf[own], found))
        return told

    def _evaluation(self, wants: Wants, size: int) -> tuple[TaskProblem, PopulationMap]:
        """A problem, and its evaluation compiled for `size` plans.

        An evaluation compiled for another size does not serve: rounding depends on the size, and
        must not depend on earlier plans.
        """
        key = wants, size
        if key not in self._maps:
            in_evaluator = wants in ("settled", "screened")
            problem = self._evaluator_problem if in_evaluator else self._problem
            self._maps[key] = problem, self._compiled(problem, wants, size)
        return self._maps[key]

    def _compiled(self, problem: TaskProblem, wants: Wants, size: int) -> PopulationMap:
        shape = (size, self.task.num_actions, self.task.num_pickers)
        idle = Actions(jnp.full(shape, NONE), jnp.zeros((*shape, 3), float))
        layout = self._layout(problem, wants, size)
        samples = _samples(problem.episode, idle, size)
        return PopulationMap(partial(_evaluate, wants), problem, samples, layout)

    def layout_of(self, algorithm: Algorithm) -> Layout:
        """Layout of an algorithm's questions on this machine."""
        wants, size = _evaluations(algorithm)[0]
        problem, _ = self._evaluation(wants, size)
        return self._layout(problem, wants, size)

    def _layout(self, problem: TaskProblem, wants: Wants, size: int) -> Layout:
        return self.layout or default_layout(size, problem.chunk_size(wants))

    @cached_property
    def _evaluator_problem(self) -> TaskProblem:
        if not isinstance(self.evaluator, SearchEngine):
            raise ValueError(
                f"the algorithm asks for settled scores or screened costs and the evaluator "
                f"is {self.evaluator}, no engine in JAX; give another evaluator, as "
                f"MassSprings(self_contact=True)"
            )
        return self._host_problem(self.evaluator)

    def _host_problem(self, evaluator: SearchEngine | None) -> TaskProblem:
        """A problem with the goal as its start, one candidate, and arrays on the host."""
        goal = np.asarray(self.task.goal)
        found = make_problem(
            self.task, np.zeros(1, int), Episode(goal, goal), self.engine, evaluator
        )
        return dataclasses.replace(found, episode=as_float(found.episode))


def _is_object(given: object) -> bool:
    """Whether it is no class: a class has the functions of its objects, too."""
    return not isinstance(given, type)


def _largest_population(algorithm: Algorithm | Sequence) -> int:
    """Largest number of plans in a question for costs; 1 if the algorithm asks for none."""
    asked = [each for stage in stages(algorithm) for each in _evaluations(stage)]
    return max((size for wants, size in asked if wants == "cost"), default=1)


def _evaluations(algorithm: Algorithm) -> list[tuple[Wants, int]]:
    """Kinds and sizes of the evaluations that a question takes, in order."""
    wants, size = algorithm.wants, algorithm.num_plans
    return [("cost", size), (wants, num_again(size))] if wants == "screened" else [(wants, size)]


Sample = tuple[Any, ...]
"""Start, goal, picks and displacements as bare arrays: `Actions` are none of NumPy's."""


def _samples(episode: Episode, actions: Actions, width: int) -> Sample:
    """The plans of an episode with it beside each, padded to `width` with copies of the last."""
    rows = np.minimum(np.arange(width), len(actions.pick) - 1)
    beside = [np.broadcast_to(leaf, (width, *leaf.shape)) for leaf in jax.tree.leaves(episode)]
    return (*beside, *(np.asarray(leaf)[rows] for leaf in jax.tree.leaves(actions)))


def _evaluate(wants: Wants, problem: TaskProblem, sample: Sample) -> Told:
    start, goal, pick, displacement = sample
    problem = dataclasses.replace(problem, episode=Episode(start, goal))
    return evaluation(problem, wants)(Actions(pick, displacement))


class _Bill:
    """A function that answers the questions of searches side by side, and counts for one of them.

    Attributes:
        num_plans: number of plans evaluated so far for each search.
        price: price of these evaluations, in rollouts.
    """

    def __init__(
        self, evaluate: Callable[[Wants, Seq[Actions], int], list[Told]], population: int
    ) -> None:
        """Start at a count of zero.

        Args:
            evaluate: function that evaluates plans, compiled for as many as its last argument.
            population: number of plans for which the cost of a single plan is compiled.
        """
        self._evaluate, self._population = evaluate, population
        self.num_plans = self.price = 0

    def __call__(self, asked: list[Question]) -> list[Told]:
        """Evaluate plans."""
        wants, actions = asked[0]
        size = len(actions.pick)
        self.num_plans += size + (num_again(size) if wants == "screened" else 0)
        self.price += PRICES[wants] * size
        is_one_cost = wants == "cost" and size == 1
        return self._evaluate(
            wants, [plans for _, plans in asked], self._population if is_one_cost else size
        )
