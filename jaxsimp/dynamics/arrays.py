"""The door for arrays of JAX, traced or not, of NumPy, or lists: values are checked if known."""

import reprlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxsimp.checks import require_numbers

FARTHEST = 1e6
"""Largest coordinate of a displacement or a position, metres; limits end displacements earlier."""


def as_array(name: str, values: Any, wanted: str = "an array of real numbers") -> Any:
    """Real numbers as an array: one of JAX, traced or not, as it is; any other of NumPy's own.

    Args:
        name: name of the array, for the message.
        values: what was given.
        wanted: what to give, for the message.

    Raises:
        ValueError: if they are no real numbers, no rectangular array, or some are masked.
    """
    try:
        array = values if isinstance(values, jax.Array) else np.asarray(values)
    except (ValueError, TypeError) as error:  # rows of several lengths, or of no numbers
        raise ValueError(
            f"{name} is {reprlib.repr(values)}; give {wanted}, with rows of one length"
        ) from error
    if not any(jnp.issubdtype(array.dtype, kind) for kind in (jnp.integer, jnp.floating)):
        told = f"an array of {array.dtype}" if array.ndim else reprlib.repr(values)
        raise ValueError(f"{name} is {told}; give {wanted}")
    if np.ma.is_masked(values):
        raise ValueError(
            f"{name} has {np.ma.count_masked(values)} masked numbers; give numbers for them, as by "
            f"filled()"
        )
    if isinstance(array, jax.Array):
        return array
    return array.astype(array.dtype.newbyteorder("="), copy=False)  # JAX takes no other order


def require_positions(name: str, values: Any, num_particles: int | None = None) -> Any:
    """Positions as an array, shape (N, 3), metres; their values are not checked.

    Args:
        name: name of the positions, for the message.
        values: what was given.
        num_particles: number of particles, `N`; any by default.

    Raises:
        ValueError: if `as_array` raises, or the shape is another one.
    """
    array = as_array(name, values)
    count = "N" if num_particles is None else num_particles
    if array.ndim != 2 or array.shape[1] != 3 or count not in ("N", len(array)):
        raise ValueError(
            f"{name} has shape {array.shape}; give shape ({count}, 3), one row of x, y, z for each "
            f"particle"
        )
    return array


def require_known(name: str, array: Array | np.ndarray, unit: str = "m") -> None:
    """Raise a `ValueError` if an array is known, and a number not finite or beyond `FARTHEST`."""
    if not isinstance(array, jax.core.Tracer):
        require_numbers(name, np.asarray(array), -FARTHEST, FARTHEST, unit)
