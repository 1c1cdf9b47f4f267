"""Goals of several folds, planned in stages: sub-goal after sub-goal.

The folds of the final goal give full intermediate configurations (`jaxsimp.goals.subgoals`). Each
is planned from the state that the last stage really left, over the key points that it moves; one
search in one piece has to find all folds at once, which the paper names as its open problem.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Int

from jaxsimp.dynamics import NONE, Actions
from jaxsimp.engines import Engine, Execution, Layout, SearchEngine
from jaxsimp.engines.rollouts import as_float
from jaxsimp.goals import Positions, Subgoal, find_folds, subgoals
from jaxsimp.goals.panels import fit_isometry
from jaxsimp.planning.algorithm import Algorithm, Sequence
from jaxsimp.planning.cem import CEM
from jaxsimp.planning.descent import Descent
from jaxsimp.planning.encodings import Joint
from jaxsimp.planning.local_search import LocalSearch
from jaxsimp.planning.plan import Plan, combined
from jaxsimp.planning.planner import ATTEMPTS, Planner
from jaxsimp.planning.problem import Candidates
from jaxsimp.planning.space import ActionSpace, as_candidates
from jaxsimp.simplification import KeyPoints
from jaxsimp.tasks import Episode, Task
from jaxsimp.tasks.costs import distance_cost
from jaxsimp.tasks.episode import require_episode

STAGE_ACTIONS = 2
"""Number of actions of a stage: up and across, and down."""
MOVED = 0.1
"""Least distance between a stage's start and its sub-goal, in sizes of the body, for a particle to
be a candidate that does not belong to the panels turned over."""
SAME = 1e-3
"""Largest misfit of two goals that are one goal laid elsewhere, in sizes of the body."""


def stage_algorithm(*, reranks: bool = True) -> Sequence:
    """The default search of a stage: as `default_algorithm`, then around the best by score.

    Chosen on cloths of 17 by 17 particles, with seeds from 200.

    Args:
        reranks: whether plans are looked at in the evaluator's physics, which must be in JAX.
    """
    parts: tuple[Algorithm, ...] = (
        CEM(num_iterations=10, encoding=Joint()),
        Descent(num_starts=2),
    )
    last = LocalSearch((0.08, 0.05, 0.03), num_plans=16, num_starts=8)
    return Sequence((*parts, last) if reranks else parts)


def stages_of(task: Task, goal: Positions) -> tuple[Subgoal, ...]:
    """The sub-goals of a goal, of which folds side by side are one: as many as there are pickers.

    Raises:
        ValueError: if `jaxsimp.goals.find_folds` refuses the goal.
    """
    found: list[tuple[Subgoal, int]] = []
    for each in subgoals(task.body, goal):
        last, count = found[-1] if found else (each, task.num_pickers)
        if count < task.num_pickers and _are_side_by_side(last, each, task.body.radius):
            found[-1] = dataclasses.replace(each, moving=last.moving | each.moving), count + 1
        else:
            found.append((each, 1))
    return tuple(each for each, _ in found)


def _are_side_by_side(first: Subgoal, second: Subgoal, radius: float) -> bool:
    """Whether neither of two folds moves or covers what the other moves."""
    if np.any(first.moving & second.moving):
        return False
    height = np.asarray(second.positions)[:, 2]
    layers = [np.median(height[each.moving]) for each in (first, second)]
    return bool(abs(layers[1] - layers[0]) < radius)


def staged_task(task: Task, num_stages: int) -> Task:
    """The task with as many actions as plans in stages have: those of each stage, and idle ones."""
    idle = (num_stages - 1) * task.settle_actions
    return dataclasses.replace(task, num_actions=num_stages * STAGE_ACTIONS + idle)


class StagedPlanner:
    """Planner of a task whose goal has folds, with the functions of `Planner`.

    A stage is a fold, or several side by side. A plan has `STAGE_ACTIONS` actions for each, and
    between stages as many idle ones as the task's body settles for; it is carried out and saved as
    any other.

    Attributes:
        subgoals: the sub-goals of the stages, the last being the task's goal.
    """

    def __init__(
        self,
        task: Task,
        engine: SearchEngine | None = None,
        evaluator: Engine | None = None,
        layout: Layout | None = None,
    ) -> None:
        """Find the sub-goals, and make the planners; compilation waits until it is needed.

        Args:
            task: the task; its `num_actions` does not count.
            engine: engine that gives the costs of plans, see `Planner`.
            evaluator: engine that carries out plans, see `Planner`.
            layout: layout of populations on this machine; by default the fastest in measurements.

        Raises:
            ValueError: if `jaxsimp.goals.find_folds` refuses the goal, the goal has no folds, or
                `Planner` raises.
        """
        self.subgoals = stages_of(task, task.goal)
        if not self.subgoals:
            raise ValueError(
                f"the goal of {task.name} has no folds; plan for it in one piece, with Planner"
            )
        self._goal = np.asarray(task.goal, float)
        stage = dataclasses.replace(
            task,
            num_actions=STAGE_ACTIONS,
            running_cost=distance_cost,
            terminal_cost=distance_cost,
        )
        self._stage = Planner(stage, engine, evaluator, layout)
        whole = staged_task(task, len(self.subgoals))
        self._whole = Planner(whole, engine, evaluator, layout)

    @property
    def task(self) -> Task:
        """The task, with as many actions as plans have."""
        return self._whole.task

    @property
    def engine(self) -> SearchEngine:
        """Engine that gives the costs of plans."""
        return self._whole.engine

    @property
    def evaluator(self) -> Engine:
        """Engine that carries out plans, and scores them."""
        return self._whole.evaluator

    @property
    def num_searches(self) -> int:
        """Number of searches for one plan."""
        return ATTEMPTS * len(self.subgoals)

    def plan(
        self,
        episode: Episode,
        candidates: Candidates,
        algorithm: Algorithm | Sequence | None = None,
        seed: int = 0,
        on_ask: Callable[[], None] = lambda: None,
    ) -> Plan:
        """Search for a plan, stage by stage.

        Its `parts` are the stages, whose parts are the searches, `ATTEMPTS` each; its `optimum` is
        that of the last one. Carrying out a stage, to know where it leaves the body, counts as a
        settled score.

        Args:
            episode: start and goal; the goal is that of the task, laid anywhere, or another one.
            candidates: particles that a picker may grasp. In each stage those of the panels that
                turn over, and those that are to move more than `MOVED`; all if that leaves none.
            algorithm: algorithm of each stage; `stage_algorithm` by default.
            seed: seed of the random draws.
            on_ask: function called after each question of the algorithm.

        Raises:
            ValueError: as `Planner.plan`; or if the goal of the episode is not that of the task,
                and `jaxsimp.goals.find_folds` refuses it or it takes another number of stages.
        """
        body = self.task.body
        episode = as_float(require_episode(episode, body.num_particles))
        given = candidates.particles if isinstance(candidates, KeyPoints) else candidates
        ids = as_candidates(given, body.num_particles)
        if algorithm is None:
            algorithm = stage_algorithm(reranks=isinstance(self.evaluator, SearchEngine))
        stages: list[Plan] = []
        start = episode.start
        for index, each in enumerate(self._subgoals(np.asarray(episode.goal, float))):
            stage = Episode(start, each.positions)
            own = _candidates(ids, each.moving, start, each.positions, MOVED * body.size)
            seeds = [_seed(seed, index, attempt) for attempt in range(ATTEMPTS)]
            found, done = self._stage.plan_best(stage, own, algorithm, seeds, on_ask)
            stages.append(found)
            left = done.positions[-1]
            start = left if np.isfinite(left).all() else start
        chain = _chained([each.actions for each in stages], self.task.settle_actions)
        return combined(chain, stages, stages[-1].optimum)

    def _subgoals(self, goal: Positions) -> tuple[Subgoal, ...]:
        """The sub-goals where the goal of an episode lies."""
        own, wanted = (p[:, 0] + 1j * p[:, 1] for p in (self._goal, goal))
        turn, shift, mirrored = fit_isometry(own, wanted)
        misfit = np.abs(turn * own + shift - wanted), np.abs(self._goal - goal)[:, 2]
        if mirrored or np.max(misfit) > SAME * self.task.body.size:
            return self._subgoals_of(goal)
        ends = [np.array(each.positions, float) for each in self.subgoals]
        for end in ends:
            place = turn * (end[:, 0] + 1j * end[:, 1]) + shift
            end[:, 0], end[:, 1] = place.real, place.imag
        return tuple(map(_with_positions, self.subgoals, ends))

    def _subgoals_of(self, goal: Positions) -> tuple[Subgoal, ...]:
        found = stages_of(self.task, goal)
        if len(found) != len(self.subgoals):
            raise ValueError(
                f"the goal of the episode takes {len(found)} stages and that of the task "
                f"{len(self.subgoals)}; make a planner of a task with this goal"
            )
        return found

    def prepare(self, algorithm: Algorithm | Sequence, space: ActionSpace | None = None) -> float:
        """Compile the functions of a stage, see `Planner.prepare`."""
        return self._stage.prepare(algorithm, space)

    def estimate_seconds(self, algorithm: Algorithm | Sequence) -> float:
        """Estimate the time of all stages, see `Planner.estimate_seconds`."""
        return self.num_searches * self._stage.estimate_seconds(algorithm)

    def layout_of(self, algorithm: Algorithm) -> Layout:
        """Layout of an algorithm's questions on this machine."""
        return self._stage.layout_of(algorithm)

    def execute(self, episode: Episode, actions: Actions) -> Execution:
        """Carry out a whole plan in the evaluator's physics, let the body settle, and score it.

        Raises:
            ValueError: if the episode or the plan is not of the task.
        """
        return self._whole.execute(episode, actions)


def _with_positions(subgoal: Subgoal, positions: Positions) -> Subgoal:
    return dataclasses.replace(subgoal, positions=positions)


def _candidates(
    ids: Int[np.ndarray, " K"],
    moving: Bool[np.ndarray, " N"],
    start: Any,
    end: Any,
    least: float,
) -> Int[np.ndarray, " _"]:
    """The candidates that a stage moves; all of them if it moves none."""
    far = np.linalg.norm(np.asarray(end) - np.asarray(start), axis=1) > least
    own = ids[(moving | far)[ids]]
    return own if len(own) else ids


def _seed(seed: int, stage: int, attempt: int) -> int:
    """The seed of an attempt at a stage: each draws by itself."""
    return int(np.random.SeedSequence((seed, stage, attempt)).generate_state(1)[0])


def _chained(plans: list[Actions], idle: int) -> Actions:
    """One plan of several, with idle actions between them."""
    num_pickers = plans[0].pick.shape[-1]
    nothing = jnp.full((idle, num_pickers), NONE), jnp.zeros((idle, num_pickers, 3), float)
    picks, moves = [plans[0].pick], [plans[0].displacement]
    for each in plans[1:]:
        picks += [nothing[0], each.pick]
        moves += [nothing[1], each.displacement]
    return Actions(jnp.concatenate(picks), jnp.concatenate(moves))


def num_stages(task: Task) -> int:
    """Number of stages of a goal of several folds from a flat start; 0 for any other task."""
    body = task.body
    if not len(body.faces) or not _starts_flat(task):
        return 0
    try:
        has_several = len(find_folds(task.body, task.goal)) > 1
    except ValueError:  # no folds give the goal
        return 0
    return len(stages_of(task, task.goal)) if has_several else 0


def planner_of(
    task: Task,
    engine: SearchEngine | None = None,
    evaluator: Engine | None = None,
    layout: Layout | None = None,
) -> Planner | StagedPlanner:
    """The default planner of a task: in stages for a goal of several folds, else in one piece.

    Args:
        task: the task.
        engine: engine that gives the costs of plans, see `Planner`.
        evaluator: engine that carries out plans, see `Planner`.
        layout: layout of populations on this machine; by default the fastest in measurements.

    Raises:
        ValueError: if `Planner` raises.
    """
    kind = StagedPlanner if num_stages(task) else Planner
    return kind(task, engine, evaluator, layout)


def _starts_flat(task: Task) -> bool:
    """Whether no layers lie on each other at the start: of two sheets, no more than at rest."""
    start, rest = np.asarray(task.episode_fn(0).start), task.body.rest
    return bool(np.ptp(start[:, 2]) < np.ptp(rest[:, 2]) + task.body.radius)
