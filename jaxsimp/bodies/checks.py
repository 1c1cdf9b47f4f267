"""Checks of numbers: a `ValueError` for a number out of range."""

import numpy as np


def require_count(name: str, value: int, least: int) -> None:
    """Raise a `ValueError` if a count is below the least."""
    if value < least:
        raise ValueError(f"{name} is {value}; at least {least} is needed")


def require_positive(name: str, value: float | np.ndarray) -> None:
    """Raise a `ValueError` if a number, or one of an array, is not finite and above zero."""
    if not np.all((np.asarray(value) > 0) & np.isfinite(value)):
        raise ValueError(f"{name} is {np.min(value):g}; give a finite number above zero")


def require_at_least_zero(name: str, value: float | np.ndarray) -> None:
    """Raise a `ValueError` if a number, or one of an array, is not finite and zero or more."""
    if not np.all((np.asarray(value) >= 0) & np.isfinite(value)):
        raise ValueError(f"{name} is {np.min(value):g}; give a finite number, zero or more")


def require_finite(name: str, array: np.ndarray) -> None:
    """Raise a `ValueError` if a number of an array is not finite."""
    if not np.all(np.isfinite(array)):
        raise ValueError(f"{name} has a value that is not finite; give finite numbers")
