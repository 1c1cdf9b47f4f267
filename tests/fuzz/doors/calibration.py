"""Calibration: settings and recordings."""

from typing import Any

import numpy as np
from hypothesis import strategies as st

import jaxsimp as js
from tests.fuzz.core import Door, Parameter
from tests.fuzz.valid import as_floats, both, in_range, is_array, is_count, is_one_of
from tests.fuzz.values import anything, array, count, number

BODY = js.rope(5)
NAMES = ("stiffness", "damping", "drag", "friction")
REST = BODY.rest + np.array([0.0, 0.0, BODY.radius])
PICK = np.array([[0, -1], [2, 4]])
MOVE = 0.02 * np.ones((2, 2, 3))
SEEN = REST + np.array([[[0.0, 0.0, 0.01]], [[0.0, 0.0, 0.02]]])
ONE_STEP = js.CalibrationConfig(steps=1)


def _is_config(parameters: Any = NAMES, **given: Any) -> bool | None:
    ranges = {
        "learning_rate": ((1e-4, 1.0), (1e-300, 1e9)),
        "largest_factor": ((1.1, 100.0), (1.0 + 1e-16, 1e12)),
        "smallest_factor": ((1e-3, 0.9), (1e-300, 1.0 - 1e-16)),
        "longest_time_step": ((1e-4, 1e-2), (1e-12, 1e6)),
    }
    if not isinstance(parameters, tuple | list):
        return False
    named = bool(parameters) and all(is_one_of(each, NAMES) for each in parameters)
    numbers = [
        in_range(value, *ranges[name][0], absurd=ranges[name][1])
        if name in ranges
        else is_count(value, 1, 10**4)
        for name, value in given.items()
    ]
    twice = named and len(set(parameters)) < len(parameters)
    return both(named, None if twice or isinstance(parameters, list) else True, *numbers)


def _recording(given: dict[str, Any]) -> js.Recording:
    actions = js.Actions(given.pop("pick", PICK), given.pop("displacement", MOVE))
    start = js.State(given.pop("start", REST), given.pop("velocity", 0 * REST))
    return js.Recording(start, actions, given.pop("positions", SEEN))


def _error(action_seconds: Any = 0.05, **given: Any) -> Any:
    recording = _recording(given)
    return js.recording_error(BODY, [recording], action_seconds, **given)


def _calibrate(action_seconds: Any = 0.05, kinds: Any = None, **given: Any) -> Any:
    recording = _recording(given)
    return js.calibrate(BODY, [recording], action_seconds, ONE_STEP, kinds=kinds, **given)


def _compile() -> None:
    """Compile for each number of kinds that inputs have: 2 by default, 1 of their own."""
    _calibrate()
    _calibrate(kinds=np.zeros(len(BODY.springs), int))


def _is_recording(
    pick: Any = PICK,
    displacement: Any = MOVE,
    start: Any = REST,
    velocity: Any = REST,
    positions: Any = SEEN,
    action_seconds: Any = 0.05,
    gravity: Any = 9.81,
    longest_time_step: Any = 2e-3,
    kinds: Any = None,
) -> bool | None:
    ids = as_floats(pick)
    if ids is None or ids.ndim != 2 or np.asarray(pick).dtype.kind not in "iu":
        return False
    if not np.isin(ids, range(-1, 5)).all():
        return False
    frames = is_array(positions, (len(ids), 5, 3))
    places = [is_array(each, (5, 3)) for each in (start, velocity)]
    moves = is_array(displacement, (*ids.shape, 3))
    if False in (frames, moves, *places):
        return False
    values = [as_floats(each) for each in (displacement, start, velocity, positions)]
    far = any(np.abs(each).max(initial=0) > 1 for each in values) or ids.shape != PICK.shape
    springs = len(BODY.springs)
    kinds_fine = None
    if kinds is not None:
        kinds_fine = is_array(kinds, (springs,), "i")
        whole = kinds_fine is not False and np.asarray(kinds).dtype.kind in "iu"
        kinds_fine = both(kinds_fine, whole and as_floats(kinds).min() >= 0, None)
    return both(
        frames,
        moves,
        *places,
        None if far else True,
        in_range(action_seconds, 0.01, 1.0, absurd=(1e-9, 1e6)),
        in_range(gravity, 0.0, 100.0, absurd=(-1e9, 1e9)),
        in_range(longest_time_step, 1e-4, 1.0, absurd=(1e-9, 1e9)),
        True if kinds is None else kinds_fine,
        None,
    )


def _check_error(error: float, positions: Any = SEEN, **_: Any) -> None:
    assert np.abs(as_floats(positions)).max() > 1e3 or np.isfinite(error), f"the error is {error}"
    assert not error < 0, f"the error is {error}"


def _check_fit(found: js.Calibration, **_: Any) -> None:
    for name, factor in found.factors.items():
        assert np.isfinite(factor).all(), f"the factor on {name} is not finite"
    assert (found.body.mass == BODY.mass).all(), "another mass"


RECORDED = {
    "pick": array(st.just(PICK), optional=True),
    "displacement": array(st.just(MOVE), optional=True),
    "start": array(st.just(REST), optional=True),
    "velocity": array(st.just(0 * REST), optional=True),
    "positions": array(st.just(SEEN), optional=True),
}
SECONDS = Parameter(
    st.just(0.05), st.sampled_from((0.0, -1.0, 1e-300, 1e9, 1e300, 1e-12)) | anything
)

DOORS = (
    Door(
        "calibration.CalibrationConfig",
        js.CalibrationConfig,
        {
            "parameters": Parameter(
                st.lists(st.sampled_from(NAMES), min_size=1, unique=True).map(tuple),
                st.lists(st.sampled_from(NAMES) | anything, max_size=2).map(tuple)
                | st.just("drag")
                | anything,
            ),
            "steps": count(1, 300),
            "learning_rate": number(1e-3, 0.5),
            "largest_factor": number(1.2, 10.0),
            "smallest_factor": number(0.01, 0.9),
            "longest_time_step": number(5e-4, 5e-3),
        },
        _is_config,
    ),
    Door(
        "calibration.recording_error",
        _error,
        {
            **RECORDED,
            "action_seconds": SECONDS,
            "gravity": Parameter(st.just(9.81), anything),
            "longest_time_step": Parameter(st.just(2e-3), anything),
        },
        _is_recording,
        _check_error,
        weight=8,
    ),
    Door(
        "calibration.calibrate",
        _calibrate,
        {
            **RECORDED,
            "action_seconds": SECONDS,
            "gravity": Parameter(st.just(9.81), anything),
            "kinds": array(st.just(np.zeros(7, int)), optional=True),
        },
        _is_recording,
        _check_fit,
        weight=2,
        prepare=_compile,
    ),
)
