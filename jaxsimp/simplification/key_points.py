"""Key points: the particles of a body that the model of a goal keeps, as candidates to grasp."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields
from enum import IntEnum
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsimp.checks import keep, require_ids


class FitStatus(IntEnum):
    """Result of the search for a goal's model."""

    FITS = 0
    NO_FIT = 1
    INFEASIBLE = 2


@dataclass(frozen=True, eq=False)
class KeyPoints:
    """The smallest model that fits a goal, as particles of the body.

    A model is piecewise linear in rest coordinates: particles at `W positions`, where row `i` of
    `W` interpolates between the key points around the rest coordinates of particle `i` (see
    interpolation.py). `max_error` and `rms_error` are thus defined alike for ropes and surfaces;
    `errors` are in the norm by which the method chooses. Arrays are copied, and read-only, also
    after unpickling.

    Attributes:
        particles: ids of the key points in ascending order, shape (K,).
        positions: positions of the key points in the model, shape (K, 3), metres.
        elements: the model's segments, shape (K - 1, 2), or triangles, shape (M, 3), as
            indices into `particles`.
        num_particles: number of particles of the body, `N`.
        method: name of the method that found them.
        sizes: numbers of key points tried, in ascending order: up to the first that fits, and
            a few more, which show the effect of further key points on the error.
        errors: error of the model at each size, metres.
        tolerance: error below which a model fits, metres.
        max_error: largest distance of a particle from the model, metres.
        rms_error: root mean square of those distances, metres.
        certified: whether a proof exists that no model with fewer key points fits.
        status: `FITS`, or the reason why no model fits. With `NO_FIT` the model is one of those
            tried (see the method); with `INFEASIBLE` there are no key points.

    Raises:
        ValueError: if `particles` are no ids of the body's particles, or another array does not
            fit to them.
    """

    particles: Int[np.ndarray, " K"]
    positions: Float[np.ndarray, "K 3"]
    elements: Int[np.ndarray, "M E"]
    num_particles: int
    method: str
    sizes: tuple[int, ...]
    errors: tuple[float, ...]
    tolerance: float
    max_error: float
    rms_error: float
    certified: bool = False
    status: FitStatus = FitStatus.FITS

    def __post_init__(self) -> None:
        require_ids("particles", self.particles, self.num_particles)
        require_ids("elements", self.elements, len(self.particles), "key points")
        if np.shape(self.positions) != (len(self.particles), 3):
            raise ValueError(
                f"positions has shape {np.shape(self.positions)}; give x, y, z for each of "
                f"{len(self.particles)} key points"
            )
        for name in ("particles", "positions", "elements"):
            own = np.array(getattr(self, name))
            own.flags.writeable = False
            keep(self, **{name: own})

    def __reduce__(self) -> tuple[type["KeyPoints"], tuple[Any, ...]]:
        """Make copies with the constructor, since pickled arrays lose their read-only flag."""
        return type(self), tuple(getattr(self, field.name) for field in fields(self))

    def __len__(self) -> int:
        return len(self.particles)

    @property
    def mask(self) -> Bool[np.ndarray, " N"]:
        """True at the particles that may be grasped: indexes the particle axis of an action."""
        mask = np.zeros(self.num_particles, dtype=bool)
        mask[self.particles] = True
        return mask

    @property
    def error(self) -> float:
        """Error of the model, metres."""
        return self.errors[self.sizes.index(len(self))]


SMALLEST_TOLERANCE = 1e-9
"""Smallest tolerance, metres: below it rounding decides."""
SIZES_BEYOND = 3
"""Number of sizes tried after the first that fits."""


def smallest_fit(
    error_fn: Callable[[int], float], sizes: Iterable[int], tolerance: float
) -> tuple[int | None, dict[int, float]]:
    """The first size whose error is below the tolerance, and the errors of all sizes tried.

    Tries the sizes one by one, since a further key point may raise the error.

    Args:
        error_fn: error of the model of a size, metres.
        sizes: in ascending order.
        tolerance: metres.

    Returns:
        The size, None if no model fits, and the errors by size, `SIZES_BEYOND` sizes further.
    """
    errors: dict[int, float] = {}
    fitting: list[int] = []
    for size in sizes:
        errors[size] = error_fn(size)
        if fitting or errors[size] < tolerance:
            fitting.append(size)
        if len(fitting) > SIZES_BEYOND:
            break
    return (fitting[0] if fitting else None), errors
