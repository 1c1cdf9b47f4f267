"""Strategies of values: numbers and arrays near and far from limits, and what is none at all."""

from collections.abc import Callable
from decimal import Decimal
from fractions import Fraction
from typing import Any

import jax.numpy as jnp
import numpy as np
from hypothesis import strategies as st
from hypothesis.strategies import SearchStrategy

from tests.fuzz.core import Parameter

STEPS = 2**16
"""Number of steps between limits: enough to be near any number, few enough to shrink."""

NO_NUMBERS: tuple[Callable[[], Any], ...] = (
    lambda: True,
    lambda: False,
    lambda: "3",
    lambda: "",
    lambda: "nan",
    lambda: "x" * 3000,
    lambda: None,
    lambda: 1j,
    lambda: object(),
    list,
    tuple,
    dict,
    lambda: b"1",
    lambda: np.zeros(0),
    lambda: np.ones((2, 2)),
    lambda: np.array([1.0]),
    lambda: np.array(["a", None], dtype=object),
    lambda: np.datetime64("2020-01-01"),
    lambda: lambda: 1,
    lambda: int,
    lambda: {1, 2},
)
"""Values that are no numbers."""
ODD_NUMBERS: tuple[Callable[[], Any], ...] = (
    lambda: float("nan"),
    lambda: float("inf"),
    lambda: -float("inf"),
    lambda: -1,
    lambda: 0,
    lambda: -0.0,
    lambda: 1,
    lambda: 2.5,
    lambda: 2**40,
    lambda: -(2**63),
    lambda: 10**400,
    lambda: 1e-320,
    lambda: 1e-300,
    lambda: 1e-12,
    lambda: 1e12,
    lambda: 1e300,
    lambda: -1e300,
    lambda: np.float32(np.nan),
    lambda: np.float64(0.5),
    lambda: np.float16(0.5),
    lambda: np.int64(7),
    lambda: np.uint8(200),
    lambda: np.array(0.5),
    lambda: np.array(5),
    lambda: jnp.asarray(0.5),
    lambda: jnp.asarray(6),
    lambda: Fraction(1, 3),
    lambda: Decimal("0.3"),
)
"""Numbers far from limits, and of unusual types."""


def made(factories: tuple[Callable[[], Any], ...]) -> SearchStrategy[Any]:
    """A fresh value of one of some factories."""
    return st.sampled_from(factories).map(lambda factory: factory())


anything = made(ODD_NUMBERS + NO_NUMBERS)
"""Numbers far from limits, and values that are no numbers."""


def between(low: float, high: float) -> SearchStrategy[float]:
    """Floats from `low` to `high`, limits included; evenly in the logarithm if `low` is above 0."""

    def at(step: int) -> float:
        share = step / STEPS
        if step in (0, STEPS):
            return float(high if step else low)
        return float(low * (high / low) ** share if low > 0 else low + share * (high - low))

    return st.integers(0, STEPS).map(at)


def around(low: float, high: float) -> SearchStrategy[float]:
    """Floats just outside limits and far outside."""
    factors = (1 - 1e-9, 1 - 1e-3, 0.5, 1e-3, 1e-6, -1.0)
    outside = [low * each for each in factors] + [high / each for each in factors]
    return st.sampled_from([*outside, low - 1.0, high + 1.0])


def number(low: float, high: float, *, optional: bool = True) -> Parameter:
    """A parameter that is a real number, valid from `low` to `high`."""
    return Parameter(between(low, high), around(low, high) | anything, optional)


def count(low: int, high: int, *, optional: bool = True) -> Parameter:
    """A parameter that is a whole number, valid from `low` to `high`."""
    wrong = st.sampled_from((low - 1, low - 0.5, -high, float(low), np.float64(high), 2**31))
    return Parameter(st.integers(low, high), wrong | anything, optional)


def choice(*names: Any, optional: bool = True) -> Parameter:
    """A parameter that is one of some names."""
    wrong = st.sampled_from((str(names[0]).upper(), f"{names[0]} ", "unknown", "", names))
    return Parameter(st.sampled_from(names), wrong | anything, optional)


def flag(*, optional: bool = True) -> Parameter:
    """A parameter that is true or false."""
    return Parameter(st.booleans(), anything, optional)


def fixed(*values: Any, optional: bool = False) -> Parameter:
    """A parameter that is one of some values, and never hostile."""
    return Parameter(st.sampled_from(values), st.sampled_from(values), optional)


def value_of(strategy: SearchStrategy[Any], *, optional: bool = False) -> Parameter:
    """A parameter with valid values of a strategy, and anything as hostile ones."""
    return Parameter(strategy, anything, optional)


class Own(np.ndarray):
    """A subclass of arrays, as those of libraries of units."""


def _with(array: np.ndarray, value: float, *, at: int) -> np.ndarray:
    changed = np.array(array, dtype=float)
    if changed.size:
        changed.flat[at % changed.size] = value
    return changed


def _read_only(array: np.ndarray) -> np.ndarray:
    own = np.array(array)
    own.flags.writeable = False
    return own


Change = Callable[[np.ndarray], Any]
SAME: tuple[Change, ...] = (
    np.asfortranarray,
    _read_only,
    lambda array: np.repeat(array, 2, axis=0)[::2] if np.ndim(array) else array,
    lambda array: array.astype(array.dtype.newbyteorder()),
    lambda array: array.view(Own),
    lambda array: array.tolist(),
    lambda array: jnp.asarray(array),
    lambda array: np.ma.masked_array(array, np.zeros(array.shape, bool)),
    lambda array: array.astype(np.float32 if array.dtype.kind == "f" else np.int32),
)
"""The same numbers in another form."""
BAD: tuple[Change, ...] = (
    lambda array: _with(array, np.nan, at=1),
    lambda array: _with(array, np.inf, at=4),
    lambda array: _with(array, -np.inf, at=5),
    lambda array: _with(array, 1e6, at=3),
    lambda array: _with(array, 1e16, at=3),
    lambda array: _with(array, 1e300, at=6),
    lambda array: _with(array, -7.0, at=2),
    lambda array: array * 1e3,
    lambda array: array * 1e-4,
    lambda array: array * 1e30,
    lambda array: array * 0,
    lambda array: ~array if array.dtype == bool else -array,
    lambda array: array[:-1],
    lambda array: array[:0],
    lambda array: array[:1],
    lambda array: np.concatenate([array, array[:1]]),
    lambda array: array[..., :-1] if array.ndim else array,
    lambda array: array[None],
    lambda array: array.ravel(),
    lambda array: array.T,
    lambda array: array.astype(complex),
    lambda array: array.astype(object),
    lambda array: array.astype(str),
    lambda array: array.astype(bool),
    lambda array: array.astype(np.float16),
    lambda array: array.astype(int),
    lambda array: array.astype(float) + 0.25,
    lambda array: np.ma.masked_array(array, np.arange(array.size).reshape(array.shape) == 1),
    lambda array: [*array.tolist()[:-1], [1.0]] if array.ndim == 2 else array.tolist(),
    lambda array: array.astype([("x", array.dtype)]),
    lambda array: array[np.random.default_rng(0).permutation(len(array))] if len(array) else array,
)
"""Other numbers, shapes and types, few of them valid."""


def array(valid: SearchStrategy[np.ndarray], *, optional: bool = False) -> Parameter:
    """A parameter that is an array: hostile values are changes of a valid one."""
    changed = st.tuples(valid, st.sampled_from(SAME + BAD)).map(lambda pair: pair[1](pair[0]))
    return Parameter(valid, changed | changed | anything, optional)


def normal(shape: tuple[int, ...], scale: float) -> SearchStrategy[np.ndarray]:
    """Arrays of normal random numbers, from a seed that can shrink."""

    def drawn(seed: int) -> np.ndarray:
        return scale * np.random.default_rng(seed).normal(size=shape)

    return st.integers(0, 10**6).map(drawn)
