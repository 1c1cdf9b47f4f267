"""The constraint on plans that grippers stay apart (C of Eq. 2 of the paper)."""

from itertools import combinations

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsimp.dynamics import NONE, Actions

WEIGHT = 10.0
"""Cost of a violation of a metre, in metres of the cost, or in scores: 1 cm costs 0.1."""


def violation(least: float, position: Float[Array, "N 3"], action: Actions) -> Float[Array, ""]:
    """Sum over pairs of pickers of how much nearer than `least` they come in an action, metres.

    Pickers move along straight lines, all in the same time, and end where the particles do that
    they hold.

    Args:
        least: least distance of two pickers that both hold something, metres.
        position: positions at the end of the action, shape (N, 3), metres.
        action: the action, shapes (G,) and (G, 3).
    """
    held = jnp.maximum(action.pick, 0)
    ends = position[held]
    total = jnp.zeros((), position.dtype)
    for first, second in combinations(range(action.pick.shape[0]), 2):
        end = ends[first] - ends[second]
        way = action.displacement[first] - action.displacement[second]
        both = (action.pick[first] != NONE) & (action.pick[second] != NONE)
        short = jnp.maximum(least - _nearest(end - way, way), 0.0)
        total += jnp.where(both, short, 0.0)
    return total


def _nearest(start: Float[Array, "3"], way: Float[Array, "3"]) -> Float[Array, ""]:
    """Distance of the origin from the segment that begins at `start` and goes along `way`."""
    length = way @ way
    share = -(start @ way) / jnp.where(length > 0, length, 1.0)
    nearest = start + jnp.clip(jnp.where(length > 0, share, 0.0), 0.0, 1.0) * way
    square = nearest @ nearest
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)
