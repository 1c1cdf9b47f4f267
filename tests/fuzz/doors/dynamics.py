"""Dynamics: pickers, simulations, obstacles, states, rollouts."""

from typing import Any

import jax
import numpy as np
from hypothesis import strategies as st

import jaxsimp as js
from tests.fuzz.core import Door, Parameter
from tests.fuzz.doors.goals import CLOTH
from tests.fuzz.telling import is_jax
from tests.fuzz.valid import as_floats, both, in_range, is_array, is_count, is_flag
from tests.fuzz.values import (
    anything,
    array,
    between,
    count,
    flag,
    number,
)

BODY = js.rope(5)
STEPS = 10
SIMULATION, PICKERS = js.make_simulation(BODY), js.make_pickers(steps=STEPS)
PICK = np.array([[0, -1], [2, 4]])
MOVE = np.array([[[0.02, 0.01, 0.03]] * 2, [[0.0, -0.02, 0.02]] * 2])
REST = BODY.rest + np.array([0.0, 0.0, BODY.radius])


def _is_limits(limits: Any) -> bool | None:
    try:
        each = list(limits)
    except TypeError:
        return False
    if len(each) != 3 or isinstance(limits, str | bytes | dict | set):
        return False
    verdicts = [in_range(one, 1e-3, 1.0, absurd=(1e-300, 1e6)) for one in each]
    return both(*verdicts, True if isinstance(limits, tuple) else None)


def _is_pickers(limits: Any = (0.08,) * 3, max_stretch: Any = 1.2, steps: Any = 150) -> Any:
    return both(
        _is_limits(limits),
        in_range(max_stretch, 1.01, 10.0, absurd=(1.0 + 1e-16, 1e12)),
        is_count(steps, 1, 1000),
    )


def _check_pickers(pickers: js.Pickers, limits: Any = (0.08,) * 3, **_: Any) -> None:
    assert np.allclose(pickers.limits, [float(each) for each in limits]), "other limits"
    assert isinstance(pickers.steps, int), f"steps is a {type(pickers.steps).__name__}"


three = st.tuples(*(between(-0.5, 0.5),) * 3)
odd_three = st.tuples(between(-0.5, 0.5), anything, st.just(0.0)) | st.tuples(anything) | anything


def _obstacle(shape: Any, **parts: Any) -> st.SearchStrategy[Any]:
    return st.builds(lambda **numbers: shape(**numbers), **parts)


sizes = between(0.1, 0.5)
odd_size = between(1e-3, 0.5) | anything
whole = st.one_of(
    st.just(js.Table()),
    _obstacle(js.Plane, point=three, normal=st.just((0.1, 0.0, 1.0))),
    _obstacle(js.Sphere, center=three, radius=sizes),
    _obstacle(js.Capsule, start=three, end=st.just((1.0, 0.0, 0.1)), radius=sizes),
    _obstacle(js.Box, center=three, half_sizes=st.just((0.2, 0.3, 0.2))),
)
broken = st.one_of(
    _obstacle(js.Plane, point=three, normal=odd_three),
    _obstacle(js.Plane, point=odd_three, normal=st.just((0, 0, 1))),
    _obstacle(js.Sphere, center=odd_three, radius=sizes),
    _obstacle(js.Sphere, center=three, radius=odd_size),
    _obstacle(js.Capsule, start=three, end=odd_three, radius=sizes),
    _obstacle(js.Capsule, start=st.just((0, 0, 0)), end=st.just((0, 0, 0)), radius=sizes),
    _obstacle(js.Box, center=three, half_sizes=odd_three),
    _obstacle(js.Box, center=three, half_sizes=st.just((0.2,) * 3), rounding=odd_size),
    _obstacle(js.Box, center=three, half_sizes=st.just((0.2,) * 3), turn=anything),
    st.just(js.Table),
    anything,
)


def is_obstacle(obstacle: Any) -> bool | None:
    """Whether an obstacle is one for a body whose gaps are small."""
    names = {
        js.Table: (),
        js.Plane: ("point", "normal"),
        js.Sphere: ("center", "radius"),
        js.Capsule: ("start", "end", "radius"),
        js.Box: ("center", "half_sizes", "rounding", "turn"),
    }
    if type(obstacle) not in names:
        return False
    verdicts: list[bool | None] = [True]
    for name in names[type(obstacle)]:
        value = getattr(obstacle, name)
        if name in ("radius", "rounding", "turn"):
            low = {"radius": 1e-3, "rounding": 0.0, "turn": -1e307}[name]
            verdicts.append(None if in_range(value, low, 1e6, absurd=(low, 1e307)) else False)
            if in_range(value, low, 1e6, absurd=(low, 1e307)) is None:
                verdicts[-1] = None
        else:
            verdicts.append(None if is_array(value, (3,)) is not False else False)
    if isinstance(obstacle, js.Plane) and verdicts[-1] is not False:
        verdicts.append(bool(np.linalg.norm(as_floats(obstacle.normal)) > 0))
    if isinstance(obstacle, js.Box) and verdicts[2] is not False:
        verdicts.append(bool((as_floats(obstacle.half_sizes) > 0).all()))
    if isinstance(obstacle, js.Capsule) and verdicts[1] is not False and verdicts[2] is not False:
        verdicts.append(not np.array_equal(as_floats(obstacle.start), as_floats(obstacle.end)))
    return both(*verdicts)


def are_obstacles(obstacles: Any) -> bool | None:
    """Whether a value is a sequence of obstacles."""
    if not isinstance(obstacles, list | tuple):
        return (
            None
            if isinstance(obstacles, np.ndarray | dict | set | str) and not len(obstacles)
            else False
        )
    return both(*map(is_obstacle, obstacles)) if obstacles else True


def _is_simulation(
    body: js.Body,
    time_step: Any = 1e-3,
    gravity: Any = 9.81,
    obstacles: Any = (),
    self_contact: Any = False,
    top_speed: Any = 2.1,
) -> bool | None:
    largest = js.largest_time_step(body)
    step = in_range(time_step, 1e-5, largest * (1 - 1e-6), absurd=(1e-12, largest * (1 + 1e-6)))
    fastest = in_range(top_speed, 0.1, 2.1, absurd=(1e-300, 1e12))
    # The speed counts for self-contact alone, and at which it is too high depends on the body.
    speed = fastest if fastest is False else None
    pull = in_range(gravity, -100.0, 100.0, absurd=(-1e9, 1e9))
    is_default = isinstance(top_speed, float) and top_speed == 2.1
    return both(
        step,
        pull,
        are_obstacles(obstacles),
        is_flag(self_contact),
        True if is_default and self_contact is False else speed,
    )


def _check_simulation(simulation: js.Simulation, body: js.Body, **_: Any) -> None:
    for name, leaf in zip(("leaf",) * 99, jax.tree.leaves(simulation), strict=False):
        assert np.isfinite(np.asarray(leaf)).all(), f"a {name} of the simulation is not finite"
    assert np.allclose(simulation.mass, body.mass, rtol=1e-6), "other masses"


def is_shaped(value: Any, shape: tuple[int | None, ...]) -> bool | None:
    """Whether a value has numbers of a shape; None for such that are not finite."""
    known, numbers = is_array(value, shape), as_floats(value)
    if known is False and numbers is not None and not np.isfinite(numbers).all():
        return None if is_array(np.nan_to_num(numbers), shape) else False
    return known


def _roll(pick: Any = PICK, displacement: Any = MOVE, position: Any = REST) -> Any:
    actions = js.Actions(pick, displacement)
    return js.rollout(SIMULATION, PICKERS, js.at_rest(position), actions)


def is_plain(array: Any) -> bool:
    """Whether an array is one of numbers, of JAX or NumPy's own."""
    return is_jax(array) or (type(array) is np.ndarray and array.dtype.kind in "iuf")


def is_plan(pick: Any, displacement: Any, num_particles: int, shape: Any = None) -> bool | None:
    """Whether picks and displacements are a plan: ids or -1, and finite metres."""
    ids, moves = as_floats(pick), as_floats(displacement)
    if ids is None or moves is None or ids.ndim != 2 or moves.shape != (*ids.shape, 3):
        return False
    if np.asarray(pick).dtype.kind not in "iu" or not np.isfinite(moves).all():
        return False
    if not np.isin(ids, range(-1, num_particles)).all() or (shape and ids.shape != shape):
        return False
    plain = all(is_plain(each) for each in (pick, displacement))
    return True if plain and np.abs(moves).max(initial=0) < 10 and ids.size else None


def _is_rollout(pick: Any = PICK, displacement: Any = MOVE, position: Any = REST) -> bool | None:
    place = is_array(position, (5, 3))
    far = place is not False and np.abs(as_floats(position) - REST).max() > 0.1
    return both(is_plan(pick, displacement, 5), place, None if far else True)


def _check_rollout(
    result: Any, pick: Any = PICK, displacement: Any = MOVE, position: Any = REST
) -> None:
    state, frames = result
    assert frames.shape == (len(np.asarray(pick)), 5, 3), f"shape {frames.shape}"
    sane = is_array(position, (5, 3)) and np.abs(as_floats(position) - REST).max() < 0.1
    assert not sane or np.isfinite(frames).all(), "a position is not finite"
    if sane and (np.asarray(pick) == -1).all():
        settled = js.settle(SIMULATION, js.at_rest(position), STEPS * len(np.asarray(pick)))
        assert np.allclose(settled.position, state.position, atol=1e-6), "idle pickers hold"


def _picks() -> Parameter:
    odd = (99, -7, 2**40, -2, 5, 2**31, 2**32)

    def with_odd(value: int, place: int) -> np.ndarray:
        changed = PICK.copy()
        changed.flat[place] = value
        return changed

    wrong = st.builds(with_odd, st.sampled_from(odd), st.integers(0, 3))
    plain = st.sampled_from([PICK, PICK * 0 - 1, PICK.astype(np.int32), PICK * 0 + 4])
    return Parameter(plain, wrong | array(st.just(PICK)).hostile)


def _is_table(**given: Any) -> bool | None:
    ranges = {
        "edge": ((-1.0, 1.0), (-1e6, 1e6)),
        "rounding": ((0.0, 0.05), (0.0, 1e6)),
        "half_width": ((0.5, 2.0), (1e-9, 1e6)),
        "height": ((0.25, 1.0), (1e-9, 1e6)),
    }
    return both(
        *(
            in_range(value, *ranges[name][0], absurd=ranges[name][1])
            for name, value in given.items()
        )
    )


def _use_table(**given: Any) -> Any:
    return js.make_simulation(CLOTH, 1e-3, obstacles=[js.table_with_edge(**given)])


DOORS = (
    Door(
        "dynamics.make_pickers",
        js.make_pickers,
        {
            "limits": Parameter(st.tuples(*(between(0.01, 0.5),) * 3), odd_three),
            "max_stretch": number(1.05, 3.0),
            "steps": count(1, 300),
        },
        _is_pickers,
        _check_pickers,
        weight=15,
    ),
    Door(
        "dynamics.make_simulation",
        js.make_simulation,
        {
            "body": Parameter(st.just(CLOTH), st.just(CLOTH), False),
            "time_step": number(1e-4, 2e-3),
            "gravity": number(-20.0, 20.0),
            "obstacles": Parameter(
                st.lists(whole, max_size=2), st.lists(broken, min_size=1, max_size=2) | anything
            ),
            "self_contact": flag(),
            "top_speed": number(0.5, 2.0),
        },
        _is_simulation,
        _check_simulation,
        weight=25,
    ),
    Door(
        "dynamics.table_with_edge",
        _use_table,
        {
            "edge": number(-1.0, 1.0),
            "rounding": number(0.0, 0.05),
            "half_width": number(0.5, 2.0),
            "height": number(0.25, 1.0),
        },
        _is_table,
    ),
    Door(
        "dynamics.at_rest",
        js.at_rest,
        {"position": array(st.just(REST))},
        lambda position: is_shaped(position, (None, 3)),
    ),
    Door(
        "dynamics.rollout",
        _roll,
        {
            "pick": _picks(),
            "displacement": array(st.sampled_from([MOVE, MOVE * 0, MOVE * 9]), optional=True),
            "position": array(st.just(REST), optional=True),
        },
        _is_rollout,
        _check_rollout,
        weight=8,
    ),
    Door(
        "dynamics.settle",
        lambda position, num_steps: js.settle(SIMULATION, js.at_rest(position), num_steps),
        {
            "position": array(st.just(REST)),
            "num_steps": Parameter(st.sampled_from((0, 5)), anything, False),
        },
        lambda position, num_steps: both(
            is_array(position, (5, 3)), is_count(num_steps, 0, 100), None
        ),
        weight=4,
    ),
)
