"""Plans for goals of your own: from a body and a goal to a plan, scored, saved and verified.

It stands above all rooms: key points of the goal, a task that reaches it, and the default planner.
"""

import math
from collections.abc import Callable
from collections.abc import Sequence as Seq
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxsimp import goals, records, viz
from jaxsimp.bodies import Body
from jaxsimp.checks import require_choice, require_seed
from jaxsimp.dynamics import Actions, Obstacle, Pinch, Table
from jaxsimp.engines import Execution, replay
from jaxsimp.engines.rollouts import merit
from jaxsimp.goals import Positions
from jaxsimp.planning import (
    CEM,
    Algorithm,
    Joint,
    Plan,
    Planner,
    RandomShooting,
    Sequence,
    StagedPlanner,
    default_algorithm,
    num_stages,
    planner_of,
    stage_algorithm,
)
from jaxsimp.planning.algorithm import stages
from jaxsimp.planning.planner import ATTEMPTS
from jaxsimp.planning.stages import STAGE_ACTIONS
from jaxsimp.simplification import KeyPoints, simplify
from jaxsimp.tasks import Episode, Task, reach

SUCCESS = 0.9
"""Least score of a successful plan."""
SEARCHES: dict[str, Algorithm | None] = {
    "default": None,
    "cem": CEM(num_iterations=24, encoding=Joint()),
    "random_shooting": RandomShooting(),
}
"""Searches by name; None for the default of the goal's planner."""
SHEET_ACTIONS = 4
"""Number of actions for a sheet whose goal has no folds."""


@dataclass(frozen=True, eq=False)
class GoalPlan:
    """A plan for a goal, as it was carried out.

    Attributes:
        task: the task, with body and goal.
        episode: start and goal.
        key_points: key points of the goal, which the pickers may grasp.
        seed: seed of the search.
        search: the plan with the record of its search.
        execution: the execution in our dynamics, with self-contact.
        engine: text of the engine of the execution.
    """

    task: Task
    episode: Episode
    key_points: KeyPoints
    seed: int
    search: Plan
    execution: Execution
    engine: str

    @property
    def actions(self) -> Actions:
        """The plan, shapes (T, G) and (T, G, 3)."""
        return self.search.actions

    @property
    def score(self) -> float:
        """Score of the settled state: 1 at the goal, 0 for what is as far away as the start."""
        return self.execution.score

    @property
    def merit(self) -> float:
        """The score, less the cost of grippers nearer than the task allows; see `Task`."""
        return merit(self.task, self.actions, self.execution)

    @property
    def is_success(self) -> bool:
        """Whether the score is at least `SUCCESS`."""
        return bool(self.score >= SUCCESS)

    def verify(self, variant: str = "full") -> Execution:
        """The same plan carried out in MuJoCo.

        Args:
            variant: variant of MuJoCo's model, see `jaxsimp.engines.mujoco`.

        Raises:
            ValueError: if the variant is unknown.
        """
        (found,) = replay(self.task, [self.episode], [self.actions], variant)
        return found

    def save(self, path: str | Path) -> None:
        """Write the plan as `.npz`, see `jaxsimp.save_plan`; `jaxsimp.load_plan` reads it."""
        records.save_plan(
            path,
            self.task,
            self.episode,
            self.actions,
            self.execution,
            engine=self.engine,
            found={
                "seed": self.seed,
                "key_points": self.key_points.particles.tolist(),
                "costs": np.asarray(self.search.optimum.best_costs, float).tolist(),
            },
        )

    def animate(self, path: str | Path) -> None:
        """Write the plan as a page that moves, see `jaxsimp.animate`.

        Raises:
            OSError: if the file cannot be written.
        """
        scene = viz.make_scene(
            self.task,
            self.episode,
            self.actions,
            key_points=self.key_points,
            costs=self.search.optimum.best_costs,
        )
        viz.animate(path, scene)


@dataclass(frozen=True, eq=False)
class GoalPlanner:
    """Planner of one goal: it keeps compiled functions for plans of further seeds.

    Attributes:
        task: the task, with body and goal.
        key_points: key points of the goal, which the pickers may grasp.
        search: name of the search, in `SEARCHES`.
        like: planner of another goal whose task is otherwise the same: what it compiled serves
            both.
    """

    task: Task
    key_points: KeyPoints
    search: str = "default"
    like: "GoalPlanner | None" = None

    @cached_property
    def planner(self) -> Planner | StagedPlanner:
        """The planner: in stages for a goal of several folds, else in one piece."""
        return self.like.planner if self.like else planner_of(self.task)

    @property
    def algorithm(self) -> Algorithm | Sequence:
        """Algorithm of the search, or of each stage."""
        named = SEARCHES[self.search]
        if named is not None:
            return named
        if isinstance(self.planner, StagedPlanner):
            return stage_algorithm()
        return default_algorithm(self.task)

    @property
    def num_questions(self) -> int:
        """Number of questions of all searches for one plan."""
        planner = self.planner
        searches = planner.num_searches if isinstance(planner, StagedPlanner) else ATTEMPTS
        return searches * sum(each.num_asks for each in stages(self.algorithm))

    def prepare(self) -> float:
        """Compile the search, and return the compilation time, seconds."""
        return self.planner.prepare(self.algorithm)

    def estimate_seconds(self) -> float:
        """Estimate the time of a search without compilation, seconds."""
        searches = 1 if isinstance(self.planner, StagedPlanner) else ATTEMPTS
        return searches * self.planner.estimate_seconds(self.algorithm)

    def plan(self, seed: int = 0, on_ask: Callable[[], None] = lambda: None) -> GoalPlan:
        """Search for a plan, and carry it out.

        Args:
            seed: seed of the search, and of a crumpled start.
            on_ask: function called after each question of the search.

        Raises:
            ValueError: if the seed is none.
        """
        planner, algorithm = self.planner, self.algorithm
        episode = self.task.episode_fn(require_seed(seed))
        if isinstance(planner, StagedPlanner):
            found = planner.plan(episode, self.key_points, algorithm, seed, on_ask)
            execution = planner.execute(episode, found.actions)
        else:
            seeds = np.random.SeedSequence(seed).generate_state(ATTEMPTS).tolist()
            found, execution = planner.plan_best(episode, self.key_points, algorithm, seeds, on_ask)
        engine = str(planner.evaluator)
        task = replace(self.task, num_actions=planner.task.num_actions)
        return GoalPlan(task, episode, self.key_points, seed, found, execution, engine)


def goal_planner(
    body: Body,
    goal: Positions,
    *,
    start: str | Float[np.ndarray, "N 3"] = "flat",
    search: str = "default",
    cost: str = "particles",
    tolerance: float | None = None,
    num_actions: int | None = None,
    num_pickers: int = 2,
    limits: tuple[float, float, float] | None = None,
    obstacles: tuple[Obstacle, ...] = (Table(),),
    pinch: Pinch | None = None,
    gripper_distance: float = 0.0,
    name: str = "reach",
) -> GoalPlanner:
    """A planner for a goal of your own.

    Args:
        body: the body.
        goal: goal positions, shape (N, 3), metres.
        start: start, as for `jaxsimp.reach`.
        search: name of the search, in `SEARCHES`.
        cost: cost of a state, a name in `jaxsimp.tasks.COSTS`.
        tolerance: error below which a model of the goal fits, metres; the method's own by default.
        num_actions: number of actions in a plan; by default two for one fold, four for a sheet
            without folds, and for a rope one for each key point and one more, rounded up to an
            even number. A goal of several folds is planned in stages, each of two actions.
        num_pickers: number of pickers.
        limits: largest displacement of an action, as for `jaxsimp.reach`.
        obstacles: rigid bodies at rest.
        pinch: what a picker holds besides the particle that an action names.
        gripper_distance: least distance of two pickers that both hold something, metres.
        name: name of the task.

    Raises:
        ValueError: if the search is unknown, the goal has no model within the tolerance, or
            `reach` raises.
    """
    require_choice("search", search, SEARCHES)
    key_points = simplify(body, goal, tolerance=tolerance)
    task = reach(
        body,
        goal,
        start=start,
        cost=cost,
        num_actions=_num_actions(body, goal, key_points) if num_actions is None else num_actions,
        num_pickers=num_pickers,
        limits=limits,
        obstacles=obstacles,
        pinch=pinch,
        gripper_distance=gripper_distance,
        name=name,
    )
    return GoalPlanner(task, key_points, search)


def _num_actions(body: Body, goal: Positions, key_points: KeyPoints) -> int:
    """The default number of actions."""
    if not len(body.faces):
        return 2 * math.ceil((len(key_points) + 1) / 2)
    try:
        folds = goals.find_folds(body, goal)
    except ValueError:  # no folds give the goal
        folds = ()
    return STAGE_ACTIONS if len(folds) == 1 else SHEET_ACTIONS


def plan(body: Body, goal: Positions, seed: int = 0, **options: Any) -> GoalPlan:
    """Plan how to bring a body to a goal, and carry the plan out.

    ```python
    import jaxsimp as js

    body = js.cloth((21, 21))
    goal = js.goals.fold_sequence(body, js.goals.rectangle_folds(body, "side"))
    plan = js.plan(body, goal)
    print(plan.score, plan.verify().score)
    ```

    Args:
        body: the body.
        goal: goal positions, shape (N, 3), metres.
        seed: seed of the search, and of a crumpled start.
        **options: options of `goal_planner`.

    Raises:
        ValueError: if an option or the seed is wrong, see `goal_planner`.
        TypeError: if there is no such option.
    """
    return goal_planner(body, goal, **options).plan(seed)


def plan_batch(
    body: Body,
    goals: Seq[Positions] | Float[np.ndarray, "B N 3"],
    seeds: Seq[int] | None = None,
    **options: Any,
) -> tuple[GoalPlan, ...]:
    """`plan` for several goals of one body; what is compiled for one serves those like it.

    Args:
        body: the body.
        goals: goal positions of each goal, shape (N, 3), metres.
        seeds: seed of each search; 0 by default.
        **options: options of `goal_planner`, for all goals.

    Raises:
        ValueError: if there are not as many seeds as goals, or `plan` raises.
        TypeError: if there is no such option.
    """
    seeds = [0] * len(goals) if seeds is None else seeds
    if len(seeds) != len(goals):
        raise ValueError(
            f"there are {len(goals)} goals and {len(seeds)} seeds; give a seed for each, or none"
        )
    made: dict[tuple[Any, ...], GoalPlanner] = {}
    plans = []
    for goal, seed in zip(goals, seeds, strict=True):
        planner = goal_planner(body, goal, **options)
        task = planner.task
        alike = num_stages(task), task.num_actions, task.limits
        planner = replace(planner, like=made.get(alike))
        made.setdefault(alike, planner)
        plans.append(planner.plan(seed))
    return tuple(plans)
