"""Tasks: the registry, tasks of a user's own, episodes, scores."""

from typing import Any

import numpy as np
from hypothesis import strategies as st

import jaxsimp as js
from jaxsimp.tasks import FixedStart, distance_cost
from tests.fuzz.core import Door, Parameter
from tests.fuzz.doors.dynamics import are_obstacles, broken, is_shaped, odd_three, whole
from tests.fuzz.doors.goals import CLOTH, GOALS, goals_of, is_goal
from tests.fuzz.valid import as_floats, both, in_range, is_count, is_flag, is_one_of
from tests.fuzz.values import anything, array, between, choice, count, number

GOAL = GOALS[id(CLOTH)][1]
EPISODE = js.Episode(js.goals.flat(CLOTH), GOAL)
QUICK = js.make_task("rope_folding", 5)


def _is_task_name(name: Any, resolution: Any = None, quick: Any = True) -> bool | None:
    size = True if resolution is None else is_count(resolution, 5, 9, most=10**4)
    few = is_one_of(name, js.task_names()) and not ("shirt" in name or "trousers" in name)
    return both(is_one_of(name, js.task_names()), size, is_flag(quick), True if few else None)


def _check_task(task: js.Task, name: Any, **_: Any) -> None:
    assert task.name == name, "another name"
    assert np.isfinite(task.goal).all(), "the goal is not finite"
    reached = js.goals.check_goal(task.body, task.goal, has_table=False)
    assert reached.shape == task.body.rest.shape, "another shape"


def _make(**changes: Any) -> js.Task:
    given = {
        "body": CLOTH,
        "goal": GOAL,
        "episode_fn": FixedStart(EPISODE),
        "running_cost": distance_cost,
        "terminal_cost": distance_cost,
        "limits": (0.1, 0.1, 0.1),
    }
    task = js.Task(**(given | changes))
    return task, task.pickers(), task.simulation()


def _wrong_shape(episode: Any, state: Any, action: Any = None) -> Any:
    return state.position


def _in_numpy(episode: Any, state: Any, action: Any = None) -> Any:
    return np.linalg.norm(np.asarray(state.position))


def _no_scalar(episode: Any, state: Any, action: Any = None) -> Any:
    return 3


def _failing(episode: Any, state: Any, action: Any = None) -> Any:
    raise RuntimeError("my cost fails")


COSTS = (_wrong_shape, _in_numpy, _no_scalar, _failing, lambda: 0.0)


def _is_task(**given: Any) -> bool | None:
    limits = given.get("limits", (0.1,) * 3)
    fine_limits = isinstance(limits, tuple) and len(limits) == 3
    verdicts = [
        is_goal(CLOTH, given.get("goal", GOAL), strict=True),
        both(*(in_range(each, 1e-3, 1.0, absurd=(1e-300, 1e6)) for each in limits))
        if fine_limits
        else False,
        is_count(given.get("num_actions", 4), 1, 100),
        is_count(given.get("num_pickers", 2), 1, 10),
        is_count(given.get("settle_actions", 4), 0, 100),
        in_range(given.get("action_seconds", 0.3), 0.05, 10.0, absurd=(1e-12, 1e9)),
        in_range(given.get("longest_time_step", 2e-3), 1e-4, 1.0, absurd=(1e-12, 1e300)),
        in_range(given.get("running_weight", 1.0), 0.0, 100.0, absurd=(0.0, 1e300)),
        are_obstacles(given.get("obstacles", (js.Table(),))),
        given.get("running_cost", distance_cost) is distance_cost,
        given.get("terminal_cost", distance_cost) is distance_cost,
    ]
    return both(*verdicts)


def _check_own(result: Any, **given: Any) -> None:
    task, pickers, simulation = result
    assert pickers.steps >= 1, f"{pickers.steps} steps an action"
    assert 0 < task.time_step < js.largest_time_step(CLOTH), "the time step is not stable"
    seconds = pickers.steps * float(simulation.time_step)
    wanted = float(given.get("action_seconds", 0.3))
    rounding = task.time_step + 1e-5 * wanted
    assert abs(seconds - wanted) <= rounding, f"an action takes {seconds:g} s for {wanted:g}"


def _scored(start: Any = EPISODE.start, goal: Any = GOAL, state: Any = GOAL) -> Any:
    return float(js.score(OWN, js.Episode(start, goal), state))


def _is_scored(**given: Any) -> bool | None:
    verdicts = [is_shaped(each, (25, 3)) for each in given.values()]
    if False in verdicts:
        return False
    near = all(np.abs(as_floats(each)).max() < 1e6 for each in given.values())  # else no metres
    return both(*verdicts, True if near else None)


def _check_score(
    value: float, start: Any = EPISODE.start, goal: Any = GOAL, state: Any = GOAL
) -> None:
    given = [as_floats(each) for each in (start, goal, state)]
    if not all(np.abs(each).max() < 100 for each in given):
        return
    assert not np.isnan(value), "the score is NaN"
    assert value <= 1.0 + 1e-6, f"the score is {value:g}"
    if np.array_equal(as_floats(state), as_floats(goal)):
        assert value > 0.999, f"the score of the goal is {value:g}"


OWN = js.Task(
    body=CLOTH,
    goal=GOAL,
    episode_fn=FixedStart(EPISODE),
    running_cost=distance_cost,
    terminal_cost=distance_cost,
    limits=(0.1, 0.1, 0.1),
)


def _check_episode(episode: js.Episode, seed: Any) -> None:
    again = TURNED.episode_fn(seed)
    assert np.array_equal(again.start, episode.start), "the same seed gives another episode"


TURNED = js.make_task("cloth_side_folding", 5)

DOORS = (
    Door(
        "tasks.make_task",
        js.make_task,
        {
            "name": choice(*js.task_names(), optional=False),
            "resolution": count(5, 9),
            "quick": Parameter(st.just(True), anything, optional=False),
        },
        _is_task_name,
        _check_task,
    ),
    Door(
        "tasks.Task",
        _make,
        {
            "goal": array(goals_of(CLOTH), optional=True),
            "limits": Parameter(st.tuples(*(between(0.02, 0.3),) * 3), odd_three),
            "num_actions": count(1, 9),
            "num_pickers": count(1, 4),
            "settle_actions": count(0, 9),
            "action_seconds": number(0.1, 2.0),
            "longest_time_step": number(5e-4, 1e-2),
            "running_weight": number(0.0, 2.0),
            "obstacles": Parameter(
                st.just((js.Table(),)), st.lists(broken | whole, max_size=2) | anything
            ),
            "running_cost": Parameter(st.just(distance_cost), st.sampled_from(COSTS) | anything),
            "terminal_cost": Parameter(st.just(distance_cost), st.sampled_from(COSTS) | anything),
        },
        _is_task,
        _check_own,
        weight=30,
    ),
    Door(
        "tasks.score",
        _scored,
        {
            "start": array(goals_of(CLOTH), optional=True),
            "goal": array(goals_of(CLOTH), optional=True),
            "state": array(goals_of(CLOTH), optional=True),
        },
        _is_scored,
        _check_score,
        weight=8,
    ),
    Door(
        "tasks.episode_fn",
        TURNED.episode_fn,
        {"seed": count(0, 10**6, optional=False)},
        lambda seed: is_count(seed, 0, 2**31 - 1, most=2**64),
        _check_episode,
        weight=6,
    ),
    Door(
        "tasks.task_names",
        js.task_names,
        {"group": choice("paper", "goals", "obstacles")},
        weight=1,  # a group that nobody registered a task in has none
    ),
)
