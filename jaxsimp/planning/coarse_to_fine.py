"""Coarse to fine: search for a plan on a coarse body, refine it on a fine one.

A fine body has more particles and needs shorter time steps: an action of a cloth of 100 x 100 takes
1,228 steps, of 50 x 50 363 and of 25 x 25 128, and eight executions with self-contact on two cores
14 s, 1 s and 0.1 s. What to grasp and about where to move it depends little on the resolution. So
the many rollouts of a search run on a coarse body of the same extent, and the few of a local
search, with self-contact, on finer ones.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from jaxsimp.dynamics import Actions
from jaxsimp.engines import Engine, Execution, Layout, SearchEngine
from jaxsimp.planning.algorithm import Algorithm, Sequence, stages
from jaxsimp.planning.between_bodies import carried_positions, nearest_particles, renamed
from jaxsimp.planning.local_search import LocalSearch
from jaxsimp.planning.plan import Plan, combined
from jaxsimp.planning.planner import ATTEMPTS, Planner
from jaxsimp.planning.problem import Candidates, action_space
from jaxsimp.planning.space import ActionSpace, as_candidates
from jaxsimp.simplification import KeyPoints
from jaxsimp.tasks import Episode, Task
from jaxsimp.tasks.episode import require_episode

SHARED = ("num_actions", "num_pickers", "limits", "action_seconds")
"""Settings that the tasks must share, for one plan to serve all."""
REFINEMENT = LocalSearch((0.1, 0.08, 0.07, 0.06, 0.05, 0.04))
"""Refinement between the coarsest body and the finest."""
LAST_REFINEMENT = LocalSearch((0.06, 0.04))
"""Refinement on the finest body, after others."""


class CoarseToFinePlanner:
    """Planner of a task with a fine body, with the functions of `Planner`.

    It searches on the coarsest body, from the same start, over the particles nearest to the
    candidates: `ATTEMPTS` times, since a plan that crumples a fine cloth is dear to carry out. The
    best plan is refined on each finer body in turn, where it picks the particles
    nearest to the same candidates: on the finest, the candidates.

    Attributes:
        planners: planners of the bodies, the coarsest first.
        refinements: algorithms that start from the plan found before, one for each finer body.
    """

    def __init__(
        self,
        task: Task,
        coarser: Task | tuple[Task, ...],
        engine: SearchEngine | None = None,
        evaluator: Engine | None = None,
        layout: Layout | None = None,
        refinements: tuple[Algorithm | Sequence, ...] | None = None,
    ) -> None:
        """Make a planner; compilation waits until it is needed.

        Args:
            task: the task.
            coarser: the same task with a coarser body of the same extent, or with several, the
                coarsest first; as `make_task(task.name, 25)`.
                A body between helps: of 16 plans around one of a cloth of 25 x 25, settled scores
                at 50 x 50 rank as those at 100 x 100 (Spearman 0.93), those at 25 x 25 hardly
                (0.15).
            engine: engine that gives the costs of plans, see `Planner`.
            evaluator: engine that carries out the plan found, see `Planner`; the refinements by
                default need one in JAX.
            layout: layout of populations on this machine; by default the fastest in measurements.
            refinements: an algorithm for each body but the coarsest; by default local searches, of
                six rounds between the coarsest and the finest body and two on the finest; of three
                if there are but two bodies.

        Raises:
            ValueError: if there is no coarser task, a coarser task does not share what a plan
                depends on, the number of refinements is not that of finer bodies, or `Planner`
                raises.
        """
        coarse_tasks = (coarser,) if isinstance(coarser, Task) else tuple(coarser)
        _require_one_task(task, coarse_tasks)
        self.refinements = _refinements(refinements, len(coarse_tasks))
        self.planners = tuple(
            Planner(each, engine, evaluator, layout) for each in (*coarse_tasks, task)
        )
        # Raises for bodies of other extents.
        self._nearest = [
            nearest_particles(task.body, planner.task.body) for planner in self.planners
        ]

    @property
    def task(self) -> Task:
        """The task, with the fine body."""
        return self.planners[-1].task

    @property
    def engine(self) -> SearchEngine:
        """Engine that gives the costs of plans."""
        return self.planners[-1].engine

    @property
    def evaluator(self) -> Engine:
        """Engine that carries out the plan found, and scores it."""
        return self.planners[-1].evaluator

    @property
    def layout(self) -> Layout | None:
        """Layout of populations on this machine; None for the fastest in measurements."""
        return self.planners[-1].layout

    def plan(
        self,
        episode: Episode,
        candidates: Candidates,
        algorithm: Algorithm | Sequence | None = None,
        seed: int = 0,
        on_ask: Callable[[], None] = lambda: None,
    ) -> Plan:
        """Search for a plan on the coarsest body, and refine it on the finer ones.

        Its `parts` are the plans of the bodies. The price counts a rollout of each alike, though a
        cloth of 100 x 100 takes over a hundred times as long as one of 25 x 25: compare prices of
        the same resolutions only, and seconds otherwise.

        Args:
            episode: start and goal of the fine body.
            candidates: particles of the fine body that a picker may grasp. Of several with one
                nearest coarse particle, the nearest to it is kept.
            algorithm: algorithm of the coarsest search; by default that of `Planner`.
            seed: seed of the random draws.
            on_ask: function called after each question of the search and of the refinements.

        Raises:
            ValueError: as `Planner.plan`.
        """
        episode = require_episode(episode, self.task.body.num_particles)
        ids = self._ids(candidates)
        first, *finer = self.planners
        seeds = [_own_seed(seed, len(finer) + attempt) for attempt in range(ATTEMPTS)]
        start = self._episode(first, episode)
        parts = [first.plan_best(start, ids[0], algorithm, seeds, on_ask)[0]]
        for level, (planner, refinement) in enumerate(zip(finer, self.refinements, strict=True)):
            before, found = self.planners[level].task, parts[-1]
            starts = best_distinct(action_space(before, ids[level]), found, _num_starts(refinement))
            new_ids = np.zeros(before.body.num_particles, int)
            new_ids[ids[level]] = ids[level + 1]
            start = self._episode(planner, episode)
            initial = renamed(starts, new_ids)
            own = _own_seed(seed, level)
            parts.append(planner.plan(start, ids[level + 1], refinement, own, on_ask, initial))
        return combined(parts[-1].actions, parts, parts[-1].optimum)

    def _episode(self, planner: Planner, episode: Episode) -> Episode:
        """The episode of a planner's body that lies where the fine one lies."""
        fine, body = self.task.body, planner.task.body
        if planner is self.planners[-1]:
            return episode
        start, goal = (
            carried_positions(fine, np.asarray(positions), body)
            for positions in (episode.start, episode.goal)
        )
        return Episode(start, goal)

    def prepare(self, algorithm: Algorithm | Sequence, space: ActionSpace | None = None) -> float:
        """Compile the functions of all searches, and return the compilation time, seconds.

        Args:
            algorithm: algorithm of the coarsest search.
            space: space of plans of the fine body; without it only the evaluations are compiled.

        Raises:
            ValueError: as `Planner.prepare`.
        """
        spaces: list[ActionSpace | None] = [None] * len(self.planners)
        if space is not None:
            spaces = [
                action_space(planner.task, ids)
                for planner, ids in zip(
                    self.planners, self._ids(np.asarray(space.candidates)), strict=True
                )
            ]
        seconds = self.planners[0].prepare(algorithm, spaces[0])
        for planner, refinement, own in zip(
            self.planners[1:], self.refinements, spaces[1:], strict=True
        ):
            seconds += planner.prepare(refinement, own, _num_starts(refinement))
        return seconds

    def estimate_seconds(self, algorithm: Algorithm | Sequence) -> float:
        """Estimate the time of all searches, see `Planner.estimate_seconds`."""
        searches = (algorithm, *self.refinements)
        times = (ATTEMPTS, *[1] * len(self.refinements))
        return sum(
            count * planner.estimate_seconds(search)
            for count, planner, search in zip(times, self.planners, searches, strict=True)
        )

    def layout_of(self, algorithm: Algorithm) -> Layout:
        """Layout of the questions of the coarsest search on this machine."""
        return self.planners[0].layout_of(algorithm)

    def execute(self, episode: Episode, actions: Actions) -> Execution:
        """Carry out a plan on the fine body in the evaluator's physics, settle it, and score it.

        Raises:
            ValueError: if the episode or the plan is not of the task.
        """
        return self.planners[-1].execute(episode, actions)

    def _ids(self, candidates: Candidates) -> list[Int[np.ndarray, " J"]]:
        """Ids of the candidates in each body, the coarsest first; no particle is there twice."""
        given = candidates.particles if isinstance(candidates, KeyPoints) else candidates
        fine = self.task.body
        ids = as_candidates(given, fine.num_particles)
        for planner, nearest in zip(self.planners, self._nearest, strict=True):
            own = nearest[ids]
            apart = np.linalg.norm(fine.rest[ids] - planner.task.body.rest[own], axis=1)
            order = np.lexsort((apart, own))  # of one coarse particle, the nearest first
            _, first = np.unique(own[order], return_index=True)
            ids = np.sort(ids[order][first])
        return [nearest[ids] for nearest in self._nearest]


def _require_one_task(task: Task, coarser: tuple[Task, ...]) -> None:
    if not coarser:
        raise ValueError("coarser has no task; give the task with a coarser body, at least once")
    for name in SHARED:
        values = [getattr(each, name) for each in (*coarser, task)]
        if any(value != values[-1] for value in values):
            raise ValueError(
                f"{name} is {values[-1]} in the task and {values[:-1]} in the coarser ones; give "
                f"the same task at several resolutions"
            )


def _refinements(
    given: tuple[Algorithm | Sequence, ...] | None, count: int
) -> tuple[Algorithm | Sequence, ...]:
    """A refinement for each body but the coarsest."""
    if given is None:
        return (*[REFINEMENT] * (count - 1), LAST_REFINEMENT if count > 1 else LocalSearch())
    if not isinstance(given, (tuple, list)) or len(given) != count:
        raise ValueError(
            f"refinements is {given!r}; give a tuple of {count}, one for each body but the coarsest"
        )
    for each in given:
        stages(each)  # raises for what is no algorithm
    return tuple(given)


def _own_seed(seed: int, level: int) -> int:
    """A seed for each refinement: with one for all, each would draw the noise of the one before."""
    return int(np.random.SeedSequence(seed, spawn_key=(level,)).generate_state(1)[0])


def _num_starts(refinement: Algorithm | Sequence) -> int:
    return max(1, *(stage.num_starts for stage in stages(refinement)))


def best_distinct(space: ActionSpace, plan: Plan, count: int) -> Actions:
    """The plan that a search returned and the best others of its archive, shapes (count, ...).

    If there are fewer, the plan returned fills the rest.
    """
    archive = plan.optimum.archive
    others = space.actions(archive.plans)
    same = [
        np.array_equal(pick, plan.actions.pick) and np.array_equal(moves, plan.actions.displacement)
        for pick, moves in zip(others.pick, others.displacement, strict=True)
    ]
    index = np.flatnonzero(np.asarray(archive.filled) & ~np.array(same))[: count - 1]
    rows = np.concatenate([[0], 1 + index, np.zeros(count - 1 - len(index), int)])
    return jax.tree.map(
        lambda one, many: jnp.concatenate([jnp.asarray(one)[None], many])[rows],
        plan.actions,
        others,
    )
