"""What documents promise, as predicates: True, False, or None where both will do."""

from collections.abc import Collection
from typing import Any

import numpy as np

from tests.fuzz.telling import is_jax

SMALLEST, LARGEST = 0.01, 5.0
"""Limits of the largest extent of a body, metres."""


def both(*verdicts: bool | None) -> bool | None:
    """False if one is, True if all are, None otherwise."""
    if any(each is False for each in verdicts):
        return False
    return None if any(each is None for each in verdicts) else True


def float_of(value: Any) -> float:
    """A number as a float; infinity for an integer that is too large for one."""
    try:
        return float(value)
    except OverflowError:
        return float("inf")


def is_number(value: Any) -> bool | None:
    """Whether a value is a real number; None for one in an unusual form."""
    if isinstance(value, bool | np.bool_):
        return False
    if isinstance(value, int | float | np.integer | np.floating):
        return -1e308 < float_of(value) < 1e308  # no NaN, which compares with nothing
    name = type(value).__name__
    if name in ("Fraction", "Decimal") or (is_jax(value) and np.ndim(value) == 0):
        return None
    if isinstance(value, np.ndarray) and value.ndim == 0 and value.dtype.kind in "iuf":
        return None if np.isfinite(value) else False
    return False


def in_range(value: Any, low: float, high: float, *, absurd: tuple[float, float]) -> bool | None:
    """Whether a number is valid: sure from `low` to `high`, surely not outside `absurd`."""
    verdict = is_number(value)
    if verdict is False:
        return False
    number = float_of(value)
    if not absurd[0] <= number <= absurd[1]:
        return False
    return both(verdict, True if low <= number <= high else None)


def is_count(
    value: Any, low: int, high: int, *, least: int | None = None, most: int = 2**31 - 1
) -> bool | None:
    """Whether a value is a whole number: sure from `low` to `high`, surely not outside the rest.

    Args:
        value: what was given.
        low: smallest number that is valid for sure.
        high: largest number that is valid for sure.
        least: smallest number that may be valid; `low` by default.
        most: largest number that may be valid.
    """
    least = low if least is None else least
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not whole and not (is_number(value) is None and float(value).is_integer()):
        return False
    if not least <= float_of(value) <= most:
        return False
    return True if whole and low <= int(value) <= high else None


def is_one_of(value: Any, names: Collection[Any]) -> bool:
    """Whether a value is one of some names."""
    return isinstance(value, str) and value in names


def is_flag(value: Any) -> bool | None:
    """Whether a value is true or false: others may count as either."""
    return True if isinstance(value, bool) else None


def as_floats(value: Any) -> np.ndarray | None:
    """Values as an array of floats, if they are real numbers in a rectangular form."""
    try:
        array = np.asarray(value)
    except (ValueError, TypeError):
        return None
    if array.dtype.kind == "O":  # numbers in an array of objects are still numbers
        known = [is_number(each) for each in array.ravel()]
        array = array.astype(float) if False not in known else array
    return array.astype(float) if array.dtype.kind in "iuf" else None


def is_array(value: Any, shape: tuple[int | None, ...], kinds: str = "f") -> bool | None:
    """Whether a value is an array of finite numbers of a shape; None for the same in another form.

    A `None` in the shape stands for any length.
    """
    array = as_floats(value)
    if array is None or not np.isfinite(array).all() or array.ndim != len(shape):
        return False
    if any(wanted not in (None, found) for wanted, found in zip(shape, array.shape, strict=True)):
        return False
    if isinstance(value, np.ma.MaskedArray) and np.any(np.ma.getmaskarray(value)):
        return None
    plain = type(value) is np.ndarray and value.dtype.kind in kinds
    return True if plain else None


def extent(points: Any) -> float:
    """Largest extent of points along an axis."""
    return float(np.ptp(as_floats(points), axis=0).max())


def is_size(size: float) -> bool | None:
    """Whether a body or goal of an extent is allowed; None at a limit."""
    if not np.isfinite(size) or not 0.99 * SMALLEST <= size <= 1.01 * LARGEST:
        return False
    return True if 1.001 * SMALLEST <= size <= 0.999 * LARGEST else None
