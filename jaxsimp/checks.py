"""The door for numbers and paths: a `ValueError` that names the value, limits and remedy."""

from collections.abc import Collection
from numbers import Integral
from pathlib import Path
from typing import Any

import numpy as np

MOST = 2**31 - 1
"""Largest count, that of a 32-bit index."""


def require_count(name: str, value: object, least: int, most: int = MOST) -> int:
    """A whole number, as an `int`.

    Args:
        name: name of the number, for the message.
        value: what was given. A bool is no number.
        least: smallest value allowed.
        most: largest value allowed.

    Raises:
        ValueError: if the value is no whole number from `least` to `most`.
    """
    whole = int(value) if isinstance(value, Integral) and not isinstance(value, bool) else None
    if whole is None or not least <= whole <= most:
        limits = f"of at least {least}" if most == MOST else f"from {least} to {most}"
        raise ValueError(f"{name} is {told(value)}; give a whole number {limits}")
    return whole


def keep(settings: Any, **values: object) -> None:
    """Set fields of frozen settings to what a check returned, as plain numbers."""
    for name, value in values.items():
        object.__setattr__(settings, name, value)


def require_seed(value: object) -> int:
    """A seed: a whole number of 32 bits, of which JAX and NumPy both use every bit.

    Raises:
        ValueError: if it is anything else.
    """
    return require_count("seed", value, 0, 2**32 - 1)


def require_number(
    name: str, value: object, lowest: float, highest: float, unit: str = ""
) -> float:
    """A real number within limits, as a `float`.

    Args:
        name: name of the number, for the message.
        value: what was given.
        lowest: smallest value allowed.
        highest: largest value allowed.
        unit: its unit, for the message.

    Raises:
        ValueError: if the value is not one real number from `lowest` to `highest`.
    """
    array = as_reals(value)
    if array is None or array.ndim or not lowest <= array <= highest:
        raise ValueError(f"{name} is {told(value)}; give a number {_limits(lowest, highest, unit)}")
    return float(array)


def require_numbers(
    name: str, values: object, lowest: float, highest: float, unit: str = ""
) -> np.ndarray:
    """Real numbers within limits, of any shape, as an array of floats.

    Args:
        name: name of the numbers, for the message.
        values: what was given.
        lowest: smallest value allowed.
        highest: largest value allowed.
        unit: their unit, for the message.

    Raises:
        ValueError: if a value is not a real number from `lowest` to `highest`.
    """
    array = as_reals(values)
    limits = _limits(lowest, highest, unit)
    if array is None:
        raise ValueError(f"{name} is {told(values)}; give an array of numbers {limits}")
    wrong = np.argwhere(~((lowest <= array) & (array <= highest)))  # NaN, too
    if len(wrong):
        where = tuple(wrong[0].tolist())
        which = f"{name}[{', '.join(map(str, where))}]" if where else name
        raise ValueError(f"{which} is {array[where]:g}; give numbers {limits}")
    return array


def require_choice(name: str, value: object, known: Collection[str]) -> None:
    """Raise a `ValueError` unless a value is one of the known names."""
    if not isinstance(value, str) or value not in known:
        raise ValueError(f"{name} is {told(value)}; choose from {', '.join(known)}")


def require_flag(name: str, value: object) -> None:
    """Raise a `ValueError` unless a value is true or false."""
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"{name} is {told(value)}; give True or False")


def require_ids(name: str, values: object, count: int, of: str = "particles") -> np.ndarray:
    """Whole numbers from 0 to below `count`, of any shape, as an array of int64.

    Args:
        name: name of the ids, for the message.
        values: what was given.
        count: number of things that they name.
        of: what they name, for the message.

    Raises:
        ValueError: if a value is no whole number, or names nothing.
    """
    array = require_whole(name, values)
    wrong = array[(array < 0) | (array >= count)]
    if wrong.size and not count:
        raise ValueError(f"{name} names {wrong[0]}, and there are no {of}; give at least one first")
    if wrong.size:
        raise ValueError(
            f"{name} names {wrong[0]}; the ids of {count} {of} are 0 to {count - 1}: give one of "
            f"these"
        )
    return array


def require_whole(name: str, values: object) -> np.ndarray:
    """Whole numbers, of any shape, as an array of int64.

    Raises:
        ValueError: if they are no array of whole numbers.
    """
    try:
        array = np.asarray(None if np.ma.is_masked(values) else values)
    except (ValueError, TypeError):
        array = np.asarray(None)
    if not np.issubdtype(array.dtype, np.integer):
        raise ValueError(f"{name} is {told(values)}; give an array of whole numbers")
    return array.astype(np.int64)


def require_shape(name: str, array: np.ndarray, wanted: tuple[int | str, ...], why: str) -> None:
    """Raise a `ValueError` unless an array has a shape.

    Args:
        name: name of the array, for the message.
        array: what was given.
        wanted: the shape; a letter for an axis of any length.
        why: what the array has rows of, for the message.
    """
    fits = array.ndim == len(wanted) and all(
        isinstance(axis, str) or axis == length
        for axis, length in zip(wanted, array.shape, strict=True)
    )
    if not fits:
        axes = ", ".join(map(str, wanted)) + "," * (len(wanted) == 1)
        raise ValueError(f"{name} has shape {array.shape}; give shape ({axes}), {why}")


def require_reals(name: str, values: object, wanted: tuple[int | str, ...], why: str) -> np.ndarray:
    """Real numbers of a shape, finite or not, as an array of floats.

    Args:
        name: name of the array, for the message.
        values: what was given.
        wanted: its shape, as for `require_shape`.
        why: what the array has rows of, for the message.

    Raises:
        ValueError: if the values are no real numbers, or the shape is another one.
    """
    array = as_reals(values)
    if array is None:
        raise ValueError(f"{name} is {told(values)}; give real numbers, {why}")
    require_shape(name, array, wanted, why)
    return array


def require_rows(name: str, values: object, width: int, unit: str = "m") -> np.ndarray:
    """Rows of finite real numbers, shape (_, `width`), as an array of floats.

    Args:
        name: name of the array, for the message.
        values: what was given.
        width: numbers in a row.
        unit: their unit, for the message.

    Raises:
        ValueError: if the shape or a value is another one.
    """
    array = as_reals(values)
    if array is None or array.ndim != 2 or array.shape[1] != width:
        given = told(values) if array is None else f"an array of shape {array.shape}"
        raise ValueError(f"{name} is {given}; give rows of {width} real numbers, in {unit}")
    bad = np.flatnonzero(~np.isfinite(array).all(axis=1))
    if bad.size:
        raise ValueError(
            f"{name}[{bad[0]}] is {array[bad[0]].tolist()} ({bad.size} such rows); give finite "
            f"numbers, in {unit}"
        )
    return array


def require_path(path: Path, remedy: str) -> None:
    """Raise a `ValueError` with a remedy for a path that no file can have, as with a null byte."""
    try:
        path.stat()
    except (FileNotFoundError, NotADirectoryError):
        pass
    except (OSError, ValueError) as error:
        raise ValueError(f"{str(path)[:60]!r} can be no file ({error}); {remedy}") from error


def as_reals(values: object) -> np.ndarray | None:
    """Values as an array of floats; None if they are no real numbers, or no rectangular array.

    A value that is masked is NaN: it is not known.
    """
    try:
        array = np.asanyarray(values)
    except (ValueError, TypeError):
        return None
    if not (np.issubdtype(array.dtype, np.floating) or np.issubdtype(array.dtype, np.integer)):
        return None
    floats = array.astype(float)
    return np.asarray(np.ma.filled(floats, np.nan) if np.ma.is_masked(array) else floats)


def _limits(lowest: float, highest: float, unit: str) -> str:
    return f"from {lowest:g} to {highest:g}{' ' * bool(unit)}{unit}"


def told(value: Any) -> str:
    """A value as a short text: an array by its type and shape."""
    if isinstance(value, np.ndarray) and value.ndim:
        return f"an array of {value.dtype}, shape {value.shape}"
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
