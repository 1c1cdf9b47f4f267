"""The nearest particle on one side of each, by sweep and prune: candidates of self-contact.

Particles are sorted along the axis in which they are spread widest. Each is then compared with
those that follow and precede it in that order, all particles at once and a few places at a time,
until nobody is within reach along the axis. The work follows what is there; whatever is within
reach is found, however much that is.

Comparisons are written for XLA's CPU compiler, which makes vectors of sums, products and minima
of float32, and not, in loops as long as these, of selections and of bits of integers.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

PLACES = 8
"""Places of the sorted order that are compared at a time."""
FAR = 1e3
"""Where those beyond the ends of the order stand, metres."""
PASSED_OVER = 1e30
"""Penalty a unit of being too close at rest, or on the wrong side."""
EXACT = 1 << 24
"""Whole numbers below this are exact in float32."""


def nearest_above(
    position: Float[Array, "3 N"],
    normal: Float[Array, "3 N"],
    apart: Float[Array, "3 N"],
    *,
    adjacent: Float[Array, ""],
    squash: Float[Array, ""],
    level: Float[Array, ""],
    reach: Float[Array, ""],
) -> tuple[Int[Array, " N"], Float[Array, " N"]]:
    """The nearest particle on the side that the normal points to.

    Distances are `sqrt(r^2 + squash (n.r)^2)`: with a squash above 0 what is beside a particle is
    nearer than what is as far above it. Their squares are told apart to `N / 2^24` of that of the
    reach.

    Args:
        position: metres.
        normal: of unit length.
        apart: pairs are passed over that are closer than `adjacent` here, metres.
        adjacent: metres.
        squash: see above.
        level: whatever is no farther below a particle counts as above it, too, metres.
        reach: largest distance that is looked at, metres.

    Returns:
        The particles' ids, their own where there is nobody within reach, and the distances,
        metres, rounded down, at most the reach.
    """
    count = position.shape[1]
    order, axis = _sorted_ids(position)
    rows = _rows(position, normal, apart, order, adjacent, squash, level, reach)
    margin = count + PLACES
    ahead = jnp.pad(position[axis, order], (0, margin), constant_values=FAR)
    padded = jnp.pad(rows, ((0, 0), (margin, margin)), constant_values=FAR)
    here = list(rows)

    def within_reach(carry: tuple[Array, Array]) -> Array:
        following = jax.lax.dynamic_slice_in_dim(ahead, carry[0], count)
        return (following - ahead[:count]).min() <= reach

    def compare(carry: tuple[Array, Array]) -> tuple[Array, Array]:
        first, best = carry
        after = jax.lax.dynamic_slice_in_dim(padded, margin + first, margin, 1)
        before = jax.lax.dynamic_slice_in_dim(padded, count + 1 - first, margin, 1)
        for block in (after, before):
            for place in range(PLACES):
                other = [row[place : place + count] for row in block]
                best = jnp.minimum(best, _keys(here, other))
        return first + PLACES, best

    nobody = jnp.full(count, jnp.inf, jnp.float32)
    _, best = jax.lax.while_loop(within_reach, compare, (jnp.int32(1), nobody))
    return _decoded(best, order, reach)


def _rows(
    position: Float[Array, "3 N"],
    normal: Float[Array, "3 N"],
    apart: Float[Array, "3 N"],
    order: Int[Array, " N"],
    adjacent: Float[Array, ""],
    squash: Float[Array, ""],
    level: Float[Array, ""],
    reach: Float[Array, ""],
) -> Float[Array, "11 N"]:
    """What `_keys` compares, in order, and in units in which no parameter is left.

    A scalar in the loop over particles would keep XLA from making vectors of it.
    """
    count = position.shape[1]
    scale, stretch = jnp.sqrt(_levels(count)) / reach, jnp.sqrt(jnp.maximum(squash, 1e-6))
    rows = [
        position * scale,
        normal * stretch,
        apart / adjacent,
        jnp.full((1, count), level * scale * stretch),
    ]
    places = jnp.arange(count, dtype=jnp.float32)[None]
    return jnp.concatenate([jnp.concatenate(rows)[:, order].astype(jnp.float32), places])


def _levels(count: int) -> int:
    """Of squared distance, up to that of the reach: all that leave room for N places."""
    return EXACT // count


def _sorted_ids(position: Float[Array, "3 N"]) -> tuple[Int[Array, " N"], Int[Array, ""]]:
    """Ids in the order of the widest axis, and that axis.

    Sorted as one integer each, coordinate before id, which XLA does many times as fast as pairs.
    """
    count = position.shape[1]
    ids = 1 << max(1, (count - 1).bit_length())
    low, width = position.min(axis=1), jnp.ptp(position, axis=1)
    axis = jnp.argmax(width)
    share = (position[axis] - low[axis]) / jnp.maximum(width[axis], 1e-9)
    # Short of the levels that there are: a float32 cannot tell the last from the next.
    level = (share.astype(jnp.float32) * ((1 << 32) // ids * 0.999)).astype(jnp.uint32)
    keys = jax.lax.sort(level * ids + jnp.arange(count, dtype=jnp.uint32))
    return (keys % ids).astype(int), axis


def _keys(here: list[Float[Array, " N"]], other: list[Float[Array, " N"]]) -> Float[Array, " N"]:
    """`level * N + place` of the others; far more of those that are passed over."""
    away = [other[row] - here[row] for row in range(3)]
    apart = [other[row] - here[row] for row in range(6, 9)]
    above = away[0] * here[3] + away[1] * here[4] + away[2] * here[5]
    squared = away[0] * away[0] + away[1] * away[1] + away[2] * away[2] + above * above
    rest = apart[0] * apart[0] + apart[1] * apart[1] + apart[2] * apart[2]
    key = jnp.floor(squared) * len(here[0]) + other[10]
    too_close, wrong_side = jnp.maximum(1.0 - rest, 0.0), jnp.maximum(-above - here[9], 0.0)
    return key + PASSED_OVER * (too_close + wrong_side)


def _decoded(
    best: Float[Array, " N"], order: Int[Array, " N"], reach: Float[Array, ""]
) -> tuple[Int[Array, " N"], Float[Array, " N"]]:
    """Ids and distances out of keys, in the order of the particles."""
    count = len(order)
    levels = _levels(count)
    found = best < levels * count
    key = jnp.where(found, best, 0.0).astype(int)
    ids = jnp.where(found, order[key % count], order)
    level = jnp.where(found, key // count, levels)
    back = jnp.zeros_like(order).at[order].set(jnp.arange(count), unique_indices=True)
    return ids[back], reach * jnp.sqrt(level / levels)[back].astype(reach.dtype)
