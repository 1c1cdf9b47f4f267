"""How large a body may be: one rule for every body and goal, with a guess of the unit."""

import numpy as np

from jaxsimp.checks import as_reals, require_number

SMALLEST, LARGEST = 0.01, 5.0
"""Limits of a body's largest extent, metres."""
MOST_PARTICLES = 250_000
"""Largest number of particles of a body: a cloth of 500 by 500."""
MOST_TRIANGLES = 2 * MOST_PARTICLES
"""Largest number of triangles of a mesh: a sheet has two a particle."""
UNITS = (("millimetres", 1e-3), ("centimetres", 1e-2), ("inches", 0.0254))


def require_size(what: str, extent: object, *, smallest: float = SMALLEST) -> float:
    """An extent that a body may have, metres, as a `float`.

    Args:
        what: what has it, for the message, as "length".
        extent: largest extent along an axis, metres.
        smallest: smallest extent allowed, metres: less for a body's shorter side.

    Raises:
        ValueError: if it is none, with a guess of its unit.
    """
    number = as_reals(extent)
    if number is None or number.ndim or np.isnan(number):
        return require_number(what, extent, smallest, LARGEST, "m")
    if not smallest <= number <= LARGEST:
        raise ValueError(
            f"{what} is {number:.4g} m; a body is {SMALLEST:g} to {LARGEST:g} m large. Give "
            f"metres ({unit_of(float(number))})"
        )
    return float(number)


def unit_of(extent: float, low: float = 0.1, high: float = 2.0) -> str:
    """A guess of the unit, as a remedy: one in which an extent is in some limits.

    Args:
        extent: what was given.
        low: lowest extent of the usual body, metres.
        high: highest extent of the usual body, metres.
    """
    for name, scale in UNITS:
        if low <= extent * scale <= high:
            return f"{name}? scale={scale:g}, or multiply by {scale:g}"
    if low <= extent * 1e3 <= high:
        return "converted from millimetres twice? scale=1000, or multiply by 1000"
    return "scale is the metres in one unit"


def require_scale(scale: object) -> float:
    """The metres in one unit, as a `float`; `ValueError` if it is none."""
    return require_number("scale", scale, 1e-9, 1e9, "m, the metres in one unit")
