"""Coarse to fine: search for a plan on a coarse body, refine it on a fine one.

The time of a rollout is in proportion to the particles of a cloth and to the root of their number,
as finer cloths need shorter time steps. What to grasp and about where to move it does not depend on
the resolution. So the many rollouts of a search run on a coarse body of the same extent, and the
few of a local search, with self-contact, on the fine one.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from jaxsimp.dynamics import Actions
from jaxsimp.engines import Engine, Execution, Layout, SearchEngine
from jaxsimp.planning.algorithm import Algorithm, Sequence, stages
from jaxsimp.planning.between_bodies import carried_positions, nearest_particles, renamed
from jaxsimp.planning.local_search import LocalSearch
from jaxsimp.planning.planner import Plan, Planner
from jaxsimp.planning.problem import Candidates, action_space
from jaxsimp.planning.space import ActionSpace, as_candidates
from jaxsimp.simplification import KeyPoints
from jaxsimp.tasks import Episode, Task
from jaxsimp.tasks.episode import require_episode

SHARED = ("num_actions", "num_pickers", "limits", "action_seconds")
"""Settings of the two tasks that must be equal, for one plan to serve both."""


@dataclass(frozen=True, eq=False)
class RefinedPlan(Plan):
    """A plan that was searched for on a coarse body and refined on the fine one.

    `actions` and `optimum` are of the fine body; `num_rollouts`, `price`, `seconds` and
    `compile_seconds` are sums over both bodies. A rollout counts the same on both, though one of a
    cloth of 90 x 90 takes some 40 times as long as one of 25 x 25: compare prices only between
    plans of the same two resolutions, and seconds otherwise.

    Attributes:
        coarse: the plan of the coarse body, and the record of its search.
        refined: the part of the fine body: its rollouts, price and seconds alone.
    """

    coarse: Plan
    refined: Plan


class CoarseToFinePlanner:
    """Planner of a task with a fine body, with the functions of `Planner`.

    It searches on a coarse body, from the same start, over the particles nearest to the candidates.
    The plans found pick the candidates themselves again, and are refined on the fine body.

    Attributes:
        fine: planner of the task.
        coarse: planner of the task with the coarse body.
        refinement: algorithm that starts from the plans found, on the fine body.
    """

    def __init__(
        self,
        task: Task,
        coarse_task: Task,
        engine: SearchEngine | None = None,
        evaluator: Engine | None = None,
        layout: Layout | None = None,
        refinement: Algorithm | Sequence | None = None,
    ) -> None:
        """Make a planner; compilation waits until it is needed.

        Args:
            task: the task.
            coarse_task: the same task with a coarse body of the same extent, as
                `make_task(task.name, 25)`.
            engine: engine that gives the costs of plans, see `Planner`.
            evaluator: engine that carries out the plan found, see `Planner`; the refinement by
                default needs one in JAX.
            layout: layout of populations on this machine; by default the fastest in measurements.
            refinement: algorithm on the fine body; by default `LocalSearch`.

        Raises:
            ValueError: if the two tasks do not share what a plan depends on, or `Planner` raises.
        """
        for name in SHARED:
            fine, coarse = getattr(task, name), getattr(coarse_task, name)
            if fine != coarse:
                raise ValueError(
                    f"{name} is {fine} in the task and {coarse} in the coarse one; give the same "
                    f"task at two resolutions"
                )
        self.refinement = LocalSearch() if refinement is None else refinement
        stages(self.refinement)  # raises for what is no algorithm
        self.fine = Planner(task, engine, evaluator, layout)
        self.coarse = Planner(coarse_task, engine, evaluator, layout)
        # Raises for bodies of other extents.
        self._to_coarse = nearest_particles(task.body, coarse_task.body)

    @property
    def task(self) -> Task:
        """The task, with the fine body."""
        return self.fine.task

    @property
    def engine(self) -> SearchEngine:
        """Engine that gives the costs of plans."""
        return self.fine.engine

    @property
    def evaluator(self) -> Engine:
        """Engine that carries out the plan found, and scores it."""
        return self.fine.evaluator

    @property
    def layout(self) -> Layout | None:
        """Layout of populations on this machine; None for the fastest in measurements."""
        return self.fine.layout

    def plan(
        self,
        episode: Episode,
        candidates: Candidates,
        algorithm: Algorithm | Sequence | None = None,
        seed: int = 0,
        on_ask: Callable[[], None] = lambda: None,
    ) -> RefinedPlan:
        """Search for a plan on the coarse body, and refine it on the fine one.

        Args:
            episode: start and goal of the fine body.
            candidates: particles of the fine body that a picker may grasp. Of several with one
                nearest coarse particle, the nearest to it is kept.
            algorithm: algorithm of the coarse search; by default that of `Planner`.
            seed: seed of the random draws.
            on_ask: function called after each question, of the search and of the refinement.

        Raises:
            ValueError: as `Planner.plan`.
        """
        episode = require_episode(episode, self.task.body.num_particles)
        ids, coarse_ids = self._paired(candidates)
        start = self.coarse_episode(episode)
        coarse = self.coarse.plan(start, coarse_ids, algorithm, seed, on_ask)
        new_ids = np.zeros(self.coarse.task.body.num_particles, int)
        new_ids[coarse_ids] = ids
        count = max(1, *(stage.num_starts for stage in stages(self.refinement)))
        found = best_distinct(action_space(self.coarse.task, coarse_ids), coarse, count)
        refined = self.fine.plan(
            episode, ids, self.refinement, seed, on_ask, renamed(found, new_ids)
        )
        sums = ("num_rollouts", "price", "seconds", "compile_seconds")
        return RefinedPlan(
            actions=refined.actions,
            optimum=refined.optimum,
            **{name: getattr(coarse, name) + getattr(refined, name) for name in sums},
            coarse=coarse,
            refined=refined,
        )

    def coarse_episode(self, episode: Episode) -> Episode:
        """The episode of the coarse body that lies where the fine one lies."""
        bodies = self.task.body, self.coarse.task.body
        start, goal = (
            carried_positions(bodies[0], np.asarray(positions), bodies[1])
            for positions in (episode.start, episode.goal)
        )
        return Episode(start, goal)

    def prepare(self, algorithm: Algorithm | Sequence, space: ActionSpace | None = None) -> float:
        """Compile the functions of both searches, and return the compilation time, seconds.

        Args:
            algorithm: algorithm of the coarse search.
            space: space of plans of the fine body; without it only the evaluations are compiled.

        Raises:
            ValueError: as `Planner.prepare`.
        """
        coarse_space = None
        if space is not None:
            ids, coarse_ids = self._paired(np.asarray(space.candidates))
            space, coarse_space = (
                dataclasses.replace(space, candidates=jnp.asarray(each))
                for each in (ids, coarse_ids)
            )
        count = max(1, *(stage.num_starts for stage in stages(self.refinement)))
        return self.coarse.prepare(algorithm, coarse_space) + self.fine.prepare(
            self.refinement, space, count
        )

    def estimate_seconds(self, algorithm: Algorithm | Sequence) -> float:
        """Estimate the time of a search and of its refinement, see `Planner.estimate_seconds`."""
        refinement = self.fine.estimate_seconds(self.refinement)
        return self.coarse.estimate_seconds(algorithm) + refinement

    def layout_of(self, algorithm: Algorithm) -> Layout:
        """Layout of the questions of the coarse search on this machine."""
        return self.coarse.layout_of(algorithm)

    def execute(self, episode: Episode, actions: Actions) -> Execution:
        """Carry out a plan on the fine body in the evaluator's physics, settle it, and score it.

        Raises:
            ValueError: if the episode or the plan is not of the task.
        """
        return self.fine.execute(episode, actions)

    def _paired(
        self, candidates: Candidates
    ) -> tuple[Int[np.ndarray, " K"], Int[np.ndarray, " K"]]:
        """Fine candidates, and the nearest coarse particle of each; neither has one twice."""
        given = candidates.particles if isinstance(candidates, KeyPoints) else candidates
        fine = self.task.body
        ids = as_candidates(given, fine.num_particles)
        coarse_ids = self._to_coarse[ids]
        apart = np.linalg.norm(fine.rest[ids] - self.coarse.task.body.rest[coarse_ids], axis=1)
        order = np.lexsort((apart, coarse_ids))  # the nearest first, of one coarse particle
        _, first = np.unique(coarse_ids[order], return_index=True)
        return ids[order][first], coarse_ids[order][first]


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
