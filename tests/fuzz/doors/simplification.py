"""Simplification: key points of goals, one or many, and workspaces."""

from typing import Any

import numpy as np
from hypothesis import strategies as st

import jaxsimp as js
from jaxsimp import goals
from tests.fuzz.core import Door, Parameter
from tests.fuzz.doors.goals import CLOTH, GOALS, ROPE, is_goal
from tests.fuzz.valid import as_floats, both, in_range, is_array, is_count, is_flag, is_one_of
from tests.fuzz.values import (
    NO_NUMBERS,
    ODD_NUMBERS,
    anything,
    array,
    between,
    choice,
    count,
    flag,
    made,
    number,
)

METHODS = ("robust", "paper", "meshlab")


def _clean(body: js.Body) -> st.SearchStrategy[np.ndarray]:
    """Goals without noise, moved by a step on the table."""

    def moved(goal: np.ndarray, step: int) -> np.ndarray:
        return goal + np.array([0.01 * step, 0.0, 0.0])

    return st.builds(moved, st.sampled_from(GOALS[id(body)]), st.integers(0, 9))


def _is_call(
    body: js.Body,
    goal: Any,
    method: Any = "robust",
    tolerance: Any = None,
    max_size: Any = None,
    workspace: Any = None,
) -> bool | None:
    limit = None if tolerance is None else in_range(tolerance, 1e-3, 0.05, absurd=(1e-300, 1e6))
    most = None if max_size is None else is_count(max_size, 4, 100, least=1)
    room = workspace is None or isinstance(workspace, js.Workspace)
    own = not (isinstance(workspace, js.Workspace) and body is CLOTH)
    reached = is_goal(body, goal, strict=False)
    verdict = both(is_one_of(method, METHODS), room, own)
    if verdict is False or False in (limit, most, reached):
        return False
    # No model may be within the tolerance: a refusal that says so.
    return None


def _check(points: js.KeyPoints, body: js.Body, goal: Any, **options: Any) -> None:
    ids, given = points.particles, as_floats(goal)
    fits = js.FitStatus.FITS
    assert points.status == fits or points.status in js.FitStatus, "no status"
    assert (np.diff(ids) > 0).all(), "key points are not in ascending order"
    assert len(ids) == 0 or (ids.min() >= 0 and ids.max() < body.num_particles), "an id is none"
    assert points.num_particles == body.num_particles, "another number of particles"
    assert np.array_equal(np.flatnonzero(points.mask), ids), "the mask has other particles"
    if points.status != fits:
        return
    assert np.isfinite(points.positions).all(), "a position is not finite"
    assert np.isfinite(points.max_error), f"max_error is {points.max_error:g}"
    assert points.error <= points.tolerance, (
        f"FITS with an error of {points.error:g} m, and the tolerance is {points.tolerance:g} m"
    )
    if options.get("tolerance") is not None:
        assert np.isclose(points.tolerance, float(options["tolerance"])), "another tolerance"
    if options.get("max_size") is not None:
        assert len(ids) <= int(options["max_size"]), f"{len(ids)} key points"
    if body is ROPE and options.get("method", "robust") == "robust":
        _check_rope_error(points, given)  # of models whose breakpoints are particles


def _check_rope_error(points: js.KeyPoints, goal: np.ndarray) -> None:
    """The error of a rope's model, computed anew."""
    model = np.stack(
        [np.interp(np.arange(len(goal)), points.particles, each) for each in points.positions.T],
        axis=1,
    )
    error = float(np.linalg.norm(model - goal, axis=1).max())
    tiny = 1e-6 + 1e-6 * float(np.abs(goal).max())
    assert abs(error - points.max_error) <= tiny, (
        f"max_error is {points.max_error:g} m, and it is {error:g} m off"
    )


def _check_one(points: js.KeyPoints, body: js.Body, goal: Any, **options: Any) -> None:
    assert points.status == js.FitStatus.FITS, f"the status is {points.status.name}"
    _check(points, body, goal, **options)
    if body is not ROPE or options.get("workspace") or options.get("method", "robust") != "robust":
        return
    turned = goals.turn(as_floats(goal), 0.7) + np.array([0.2, -0.1, 0.0])
    again = js.simplify(body, turned, **options)
    assert len(again) == len(points), (
        f"{len(points)} key points, and {len(again)} of the goal turned and moved"
    )


def _one(body: js.Body) -> Door:
    return Door(
        f"simplification.simplify.{body.name}",
        lambda goal, **options: js.simplify(body, goal, **options),
        {
            "goal": array(_clean(body)),
            "method": choice(*METHODS),
            "tolerance": number(2e-3, 0.05),
            "max_size": count(4, 20),
            "workspace": Parameter(st.just(None), st.just(ROOM) | anything),
        },
        lambda goal, **options: _is_call(body, goal, **options),
        lambda points, goal, **options: _check_one(points, body, goal, **options),
        weight=20,
        prepare=lambda: js.simplify(body, GOALS[id(body)][1]),  # which compiles
    )


ROOM = js.Workspace((-1.0, -1.0, 0.0), (1.0, 1.0, 1.0), above_table=True)


def _batches(body: js.Body) -> Parameter:
    one = _clean(body)
    stacked = st.lists(one, min_size=1, max_size=3).map(np.stack)
    odd = st.lists(one | array(one).hostile, min_size=0, max_size=3)
    return Parameter(stacked, array(stacked).hostile | odd, optional=False)


def _is_batch(body: js.Body, goals: Any, **options: Any) -> bool | None:
    try:
        each = list(goals)
    except TypeError:
        return False
    if not each:
        return None  # no goal, no result: the options do not matter
    shape = is_array(goals, (None, *body.rest.shape)) if isinstance(goals, np.ndarray) else None
    return both(shape, *(_is_call(body, goal, **options) for goal in each))


def _check_batch(found: Any, body: js.Body, goals: Any, **options: Any) -> None:
    assert len(found) == len(goals), f"{len(found)} results for {len(goals)} goals"
    for points, goal in zip(found, goals, strict=True):
        _check(points, body, goal, **options)


def _many(body: js.Body) -> Door:
    return Door(
        f"simplification.simplify_batch.{body.name}",
        lambda goals, **options: js.simplify_batch(body, goals, **options),
        {
            "goals": _batches(body),
            "method": choice("robust", "paper"),
            "tolerance": number(2e-3, 0.05),
        },
        lambda goals, **options: _is_batch(body, goals, **options),
        lambda found, goals, **options: _check_batch(found, body, goals, **options),
    )


def _is_workspace(
    lower: Any = (-np.inf,) * 3,
    upper: Any = (np.inf,) * 3,
    above_table: Any = False,
    fixed_ends: Any = False,
    max_stretch: Any = None,
) -> bool | None:
    bounds = [as_floats(each) for each in (lower, upper)]
    if any(each is None or each.shape != (3,) or np.isnan(each).any() for each in bounds):
        return False
    if (
        (bounds[0] > bounds[1]).any()
        or np.isposinf(bounds[0]).any()
        or np.isneginf(bounds[1]).any()
    ):
        return False
    numbers = int | float | np.integer | np.floating
    tuples = all(
        isinstance(each, tuple) and all(isinstance(one, numbers) for one in each)
        for each in (lower, upper)
    )
    stretch = True if max_stretch is None else in_range(max_stretch, 0, 1, absurd=(0, 1e300))
    flags = both(is_flag(above_table), is_flag(fixed_ends))
    return both(True if tuples else None, stretch, flags)


def _use_workspace(**given: Any) -> Any:
    workspace = js.Workspace(**given)
    return js.simplify_batch(ROPE, GOALS[id(ROPE)][1][None], workspace=workspace)[0]


def _check_workspace(points: js.KeyPoints, lower: Any = None, upper: Any = None, **_: Any) -> None:
    if points.status == js.FitStatus.INFEASIBLE:
        assert not len(points), "key points of a goal that is infeasible"
        return
    if lower is not None:
        assert (points.positions >= np.array(lower) - 1e-4).all(), "a key point is below lower"
    if upper is not None:
        assert (points.positions <= np.array(upper) + 1e-4).all(), "a key point is above upper"


odd = made(ODD_NUMBERS + NO_NUMBERS)
bounds = st.tuples(*(between(-2.0, -0.5),) * 3)
DOORS = (
    _one(ROPE),
    _one(CLOTH),
    _many(ROPE),
    _many(CLOTH),
    Door(
        "simplification.Workspace",
        _use_workspace,
        {
            "lower": Parameter(bounds, st.tuples(odd, odd, odd) | st.tuples(odd, odd) | anything),
            "upper": Parameter(
                bounds.map(lambda each: tuple(-x for x in each)),
                st.tuples(odd, odd, odd) | bounds | anything,
            ),
            "above_table": flag(),
            "fixed_ends": flag(),
            "max_stretch": number(0.0, 0.5),
        },
        _is_workspace,
        _check_workspace,
    ),
)
