"""Planner: runs algorithms on the host, on all cores, with progress; and carries out plans."""

import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial

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
from jaxsimp.planning.host import compiled_exchanges, search_on_host
from jaxsimp.planning.loop import Optimum, archive_size, evaluation
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
        initial: Actions | None = None,
    ) -> Plan:
        """Search for a plan.

        Args:
            episode: start and goal.
            candidates: particles that a picker may grasp: key points, ids, or a mask.
            algorithm: algorithm of the search, or a sequence of algorithms; by default
                `default_algorithm`, without its reranking if the evaluator is not in JAX.
            seed: seed of the random draws.
            on_ask: function called after each question of the algorithm.
            initial: plans to start from, shapes (B, T, G) and (B, T, G, 3), as those of an earlier
                search; they are evaluated, and count.

        Raises:
            ValueError: if a candidate is not a particle of the body, the episode is not of the
                body, the seed is none, the algorithm asks for settled scores and the evaluator
                is not an engine in JAX, or a plan to start from is not of the task, picks a
                particle that is no candidate, or goes beyond the limits.
        """
        if algorithm is None:
            reranks = isinstance(self.evaluator, SearchEngine)
            algorithm = default_algorithm(self.task, reranks=reranks)
        seed = require_seed(seed)
        episode = require_episode(episode, self.task.body.num_particles)
        space = action_space(self.task, candidates)
        plans = None
        if initial is not None:
            plans = space.plans(require_plan(self.task, initial, batch=True))
        num_initial = 0 if plans is None else len(plans.choice)
        compile_seconds = self.prepare(algorithm, space, num_initial)
        population = _largest_population(algorithm) or max(1, num_initial)
        bill = _Bill(partial(self._told, as_float(episode)), population)
        start = time.perf_counter()
        optimum = search_on_host(algorithm, space, jax.random.key(seed), bill, on_ask, plans)
        jax.block_until_ready(optimum)
        return Plan(
            actions=optimum.actions,
            optimum=optimum,
            num_rollouts=bill.num_plans,
            price=bill.price,
            seconds=time.perf_counter() - start,
            compile_seconds=compile_seconds,
        )

    def prepare(
        self,
        algorithm: Algorithm | Sequence,
        space: ActionSpace | None = None,
        num_initial: int = 0,
    ) -> float:
        """Compile the functions of an algorithm, and return the compilation time, seconds.

        Args:
            algorithm: algorithm of the search, or a sequence of algorithms.
            space: space of plans to search; without it `prepare` compiles only the evaluations.
            num_initial: number of plans to start from.

        Raises:
            ValueError: if the algorithm asks for settled scores and the evaluator is not an engine
                in JAX.
        """
        start = time.perf_counter()
        if num_initial:  # the cost of a single plan is compiled for a whole population
            single = _largest_population(algorithm) or 1
            self._evaluation("cost", num_initial if num_initial > 1 else single)
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
        return np.asarray(self._told(as_float(episode), "cost", actions, size).costs)

    def estimate_seconds(self, algorithm: Algorithm | Sequence) -> float:
        """Estimate the time of a search, seconds, from one evaluation of random plans.

        With self-contact, the folds that a search converges to take up to twice as long.
        """
        episode, seconds = as_float(self.task.episode_fn(0)), 0.0
        for stage in stages(algorithm):
            drawn = self._random_plans(stage.num_plans)
            self.prepare(stage)
            start = time.perf_counter()
            self._told(episode, stage.wants, drawn, stage.num_plans)
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

    def _told(self, episode: Episode, wants: Wants, actions: Actions, size: int) -> Told:
        """Evaluate at most `size` plans on all cores."""
        if wants == "screened":
            return screened(
                lambda all_plans: self._told(episode, "cost", all_plans, size),
                lambda best: self._look(episode, "screened", best, num_again(size)),
                actions,
            )
        return self._look(episode, wants, actions, size)

    def _look(self, episode: Episode, wants: Wants, actions: Actions, size: int) -> Told:
        """Evaluate at most `size` plans in one fidelity."""
        problem, evaluate = self._evaluation(wants, size)
        return evaluate(dataclasses.replace(problem, episode=episode), actions)

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
        return PopulationMap(partial(_evaluate, wants), problem, idle, layout)

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
    """Largest number of plans in a question for costs; 0 if the algorithm asks for none."""
    asked = [each for stage in stages(algorithm) for each in _evaluations(stage)]
    return max((size for wants, size in asked if wants == "cost"), default=0)


def _evaluations(algorithm: Algorithm) -> list[tuple[Wants, int]]:
    """Kinds and sizes of the evaluations that a question takes, in order."""
    wants, size = algorithm.wants, algorithm.num_plans
    return [("cost", size), (wants, num_again(size))] if wants == "screened" else [(wants, size)]


def _evaluate(wants: Wants, problem: TaskProblem, actions: Actions) -> Told:
    return evaluation(problem, wants)(actions)


class _Bill:
    """A function that evaluates plans, and counts them.

    Attributes:
        num_plans: number of plans evaluated so far.
        price: price of these evaluations, in rollouts.
    """

    def __init__(self, evaluate: Callable[[Wants, Actions, int], Told], population: int) -> None:
        """Start at a count of zero.

        Args:
            evaluate: function that evaluates plans, compiled for as many as its last argument.
            population: number of plans for which the cost of a single plan is compiled.
        """
        self._evaluate, self._population = evaluate, population
        self.num_plans = self.price = 0

    def __call__(self, wants: Wants, actions: Actions) -> Told:
        """Evaluate plans."""
        again = num_again(len(actions.pick)) if wants == "screened" else 0
        self.num_plans += len(actions.pick) + again
        self.price += PRICES[wants] * len(actions.pick)
        is_one_cost = wants == "cost" and len(actions.pick) == 1
        return self._evaluate(
            wants, actions, self._population if is_one_cost else len(actions.pick)
        )
