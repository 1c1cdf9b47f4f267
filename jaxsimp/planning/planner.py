"""Planner: runs algorithms on the host, on all cores, with progress; and carries out plans."""

import time
from collections.abc import Callable
from collections.abc import Sequence as Seq
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxsimp.checks import require_seed
from jaxsimp.dynamics import Actions
from jaxsimp.engines import (
    Engine,
    Execution,
    Executor,
    Layout,
    MassSprings,
    SearchEngine,
)
from jaxsimp.engines.rollouts import as_float, merit, require_plan
from jaxsimp.planning.algorithm import PRICES, Algorithm, Sequence, Told, stages
from jaxsimp.planning.default import default_algorithm
from jaxsimp.planning.evaluations import Evaluations, evaluations_of
from jaxsimp.planning.host import compiled_exchanges, questions
from jaxsimp.planning.loop import Question, answered, archive_size
from jaxsimp.planning.plan import Plan, combined
from jaxsimp.planning.problem import Candidates, action_space
from jaxsimp.planning.screening import num_again
from jaxsimp.planning.space import ActionSpace, Plans
from jaxsimp.tasks import Episode, Task
from jaxsimp.tasks.episode import require_episode

ATTEMPTS = 2
"""Number of searches of which the best is kept, where a plan need not be cheap: a search may settle
on picks from which no descent leads to the goal, and seldom do two."""


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
        self._evaluations = Evaluations(task, self.engine, self.evaluator, layout)

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
        (plan,) = self.plan_batch([episode], [candidates], algorithm, [seed], on_ask, [initial])
        return plan

    def plan_batch(
        self,
        episodes: Seq[Episode],
        candidates: Seq[Candidates],
        algorithm: Algorithm | Sequence | None = None,
        seeds: Seq[int] | None = None,
        on_ask: Callable[[], None] = lambda: None,
        initial: Seq[Actions | None] | None = None,
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
            initial: plans to start from, as many for each episode; none by default.

        Raises:
            ValueError: if the numbers of episodes, candidates, seeds and initial plans differ or
                are 0, or for the reasons of `plan`.
        """
        count = len(episodes)
        seeds = range(count) if seeds is None else seeds
        initial = [None] * count if initial is None else initial
        if not 0 < count == len(candidates) == len(seeds) == len(initial):
            raise ValueError(
                f"there are {count} episodes, {len(candidates)} sets of candidates, {len(seeds)} "
                f"seeds and {len(initial)} initial plans; give as many of each, at least one"
            )
        if algorithm is None:
            reranks = isinstance(self.evaluator, SearchEngine)
            algorithm = default_algorithm(self.task, reranks=reranks)
        keys = [jax.random.key(require_seed(seed)) for seed in seeds]
        size = self.task.body.num_particles
        checked = [as_float(require_episode(each, size)) for each in episodes]
        spaces = [action_space(self.task, each) for each in candidates]
        starts = [
            None if each is None else space.plans(require_plan(self.task, each, batch=True))
            for each, space in zip(initial, spaces, strict=True)
        ]
        num_initial = _common_number(starts)
        compile_seconds = sum(self.prepare(algorithm, space, num_initial) for space in spaces)
        population = _largest_population(algorithm) or max(1, num_initial)
        bill = _Bill(self._evaluations, checked, population)
        begun = time.perf_counter()
        searches = [
            questions(algorithm, space, key, on_ask, start)
            for space, key, start in zip(spaces, keys, starts, strict=True)
        ]
        found = answered(searches, bill)
        jax.block_until_ready(found)
        seconds = time.perf_counter() - begun
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

    def plan_best(
        self,
        episode: Episode,
        candidates: Candidates,
        algorithm: Algorithm | Sequence | None = None,
        seeds: Seq[int] = tuple(range(ATTEMPTS)),
        on_ask: Callable[[], None] = lambda: None,
    ) -> tuple[Plan, Execution]:
        """Search several times, side by side; the plan of the best score, and its execution.

        The `parts` of the plan are the searches. Each execution counts as a settled score.

        Args:
            episode: start and goal.
            candidates: particles that a picker may grasp.
            algorithm: algorithm of each search, as for `plan`.
            seeds: seed of each search.
            on_ask: function called after each question of a search.

        Raises:
            ValueError: as `plan_batch`.
        """
        count = len(seeds)
        found = self.plan_batch([episode] * count, [candidates] * count, algorithm, seeds, on_ask)
        done = [self.execute(episode, plan.actions) for plan in found]
        pairs = zip(found, done, strict=True)
        merits = [merit(self.task, plan.actions, execution) for plan, execution in pairs]
        best = int(np.argmax(merits))
        actions, optimum = found[best].actions, found[best].optimum
        return combined(actions, found, optimum, count, count * PRICES["settled"]), done[best]

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
            self._evaluations.prepare("cost", num_initial if num_initial > 1 else single)
        for stage in stages(algorithm):
            for each in evaluations_of(stage):
                self._evaluations.prepare(*each)
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
        count = len(actions.pick)
        size = next((each for each in self._evaluations.sizes("cost") if each >= count), count)
        (told,) = self._evaluations("cost", [as_float(episode)], [actions], size)
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
            self._evaluations(stage.wants, [episode], [drawn], stage.num_plans)
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

    def layout_of(self, algorithm: Algorithm) -> Layout:
        """Layout of an algorithm's questions on this machine."""
        return self._evaluations.layout(*evaluations_of(algorithm)[0])


def _is_object(given: object) -> bool:
    """Whether it is no class: a class has the functions of its objects, too."""
    return not isinstance(given, type)


def _largest_population(algorithm: Algorithm | Sequence) -> int:
    """Largest number of plans in a question for costs; 0 if the algorithm asks for none."""
    asked = [each for stage in stages(algorithm) for each in evaluations_of(stage)]
    return max((size for wants, size in asked if wants == "cost"), default=0)


def _common_number(starts: Seq[Plans | None]) -> int:
    """Number of plans that every search starts from."""
    counts = {0 if each is None else len(each.choice) for each in starts}
    if len(counts) > 1:
        raise ValueError(
            f"the numbers of initial plans are {sorted(counts)}; give as many for each episode"
        )
    return counts.pop()


class _Bill:
    """A function that answers the questions of searches side by side, and counts for one of them.

    Attributes:
        num_plans: number of plans evaluated so far for each search.
        price: price of these evaluations, in rollouts.
    """

    def __init__(self, evaluations: Evaluations, episodes: Seq[Episode], population: int) -> None:
        """Start at a count of zero.

        Args:
            evaluations: functions that evaluate plans.
            episodes: the episode of each search.
            population: number of plans for which the cost of a single plan is compiled.
        """
        self._evaluations, self._episodes = evaluations, episodes
        self._population = population
        self.num_plans = self.price = 0

    def __call__(self, asked: list[Question]) -> list[Told]:
        """Evaluate plans."""
        wants, actions = asked[0]
        size = len(actions.pick)
        self.num_plans += size + (num_again(size) if wants == "screened" else 0)
        self.price += PRICES[wants] * size
        is_one_cost = wants == "cost" and size == 1
        plans = [each for _, each in asked]
        compiled = self._population if is_one_cost else size
        return self._evaluations(wants, self._episodes, plans, compiled)
