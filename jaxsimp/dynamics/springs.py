"""Spring forces: sums over the springs of each particle, without scatter.

Springs are stored in rows, a row with at most one spring from each particle:

- By offset, where ids of neighbours differ by few distinct offsets `j - i` (2 in a rope, 6 in a
  row-major grid): the springs of one offset are a shifted copy of the particles, and forces
  become sums of shifted arrays. This is diagonal (DIA) storage of the spring matrix.
- By neighbour, for any other body: row `s` holds the `s`-th spring of each particle, so each
  spring is stored twice, once from either end. This is ELLPACK storage.

Inside a simulation positions and velocities are (3, N + 2 H, *B): x, y, z as rows, with a halo
of `H` inert particles, the largest offset or 0, at either end, so that every shift stays in
bounds. `*B` are axes of a batch: last, so that the samples of one particle are contiguous.
"""

import dataclasses
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxsimp.bodies import Body

MOST_OFFSETS = 16
"""Largest number of distinct offsets for storage by offset."""


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["neighbours", "stiffness", "damping", "rest_length", "shortest"],
    meta_fields=["offsets"],
)
@dataclass(frozen=True)
class Springs:
    """The springs of a body, by offset or by neighbour.

    Row `d`, column `H + i` is the spring from particle `i` to `i + offsets[d]`, or, where there
    are no offsets, to `neighbours[d, i]`. Entries without a spring have zero stiffness and damping.

    Attributes:
        offsets: distinct values of `j - i`, ascending, static; empty for storage by neighbour.
        neighbours: particle ids, shape (D, N); `D` is 0 for storage by offset.
        stiffness: stiffnesses, shape (D, H + N), newtons per metre.
        damping: damping coefficients, shape (D, H + N), newton-seconds per metre.
        rest_length: rest lengths, shape (D, H + N), metres.
        shortest: length below which a spring's direction is regularised, metres.
    """

    offsets: tuple[int, ...]
    neighbours: Int[Array, "... E N"]
    stiffness: Float[Array, "... D HN"]
    damping: Float[Array, "... D HN"]
    rest_length: Float[Array, "... D HN"]
    shortest: Float[Array, "..."]

    @property
    def halo(self) -> int:
        """Inert particles at either end of an array, `H`."""
        return max(self.offsets, default=0)


def make_springs(body: Body) -> Springs:
    """The springs of a body, by offset if they have at most `MOST_OFFSETS`, else by neighbour."""
    low, high = body.springs.min(axis=1), body.springs.max(axis=1)
    distinct, row = np.unique(high - low, return_inverse=True)
    if len(distinct) <= MOST_OFFSETS:
        offsets = tuple(int(offset) for offset in distinct)
        halo, spring, column = max(offsets, default=0), np.arange(len(low)), low
        neighbours = np.zeros((0, body.num_particles), dtype=int)
    else:
        offsets, halo = (), 0
        column, other = np.concatenate([low, high]), np.concatenate([high, low])
        order = np.argsort(column, kind="stable")
        column, other, spring = column[order], other[order], np.tile(np.arange(len(low)), 2)[order]
        row = np.arange(len(column)) - np.searchsorted(column, column)
        neighbours = np.tile(np.arange(body.num_particles), (row.max() + 1, 1))
        neighbours[row, column] = other

    def in_rows(values: np.ndarray) -> Array:
        table = np.zeros((max(len(offsets), len(neighbours)), halo + body.num_particles))
        table[row, halo + column] = values[spring]
        return jnp.asarray(table, dtype=float)

    return Springs(
        offsets=offsets,
        neighbours=jnp.asarray(neighbours, dtype=int),
        stiffness=in_rows(body.stiffness),
        damping=in_rows(body.damping),
        rest_length=in_rows(body.rest_length),
        # A thousandth of a spring: far below any length of interest, far above rounding.
        shortest=jnp.asarray(1e-3 * body.rest_length.min(initial=1.0), dtype=float),
    )


def spring_tensions(
    springs: Springs, position: Float[Array, "3 NHH *B"], velocity: Float[Array, "3 NHH *B"]
) -> list[Float[Array, "HN *B"]]:
    """Force of each spring over the distance of its ends, newtons per metre, by offset.

    Hooke's law with damping along the spring: the force on `i` towards `j` is
    `k (r - L) + c dr/dt`. Ends closer than `springs.shortest` count as that far apart along their
    difference, so force and gradient stay finite, and the force is zero, where the ends coincide.

    Args:
        springs: springs of the body.
        position: positions with halo, metres.
        velocity: velocities with halo, metres per second.
    """
    tensions = []
    for row in range(len(springs.stiffness)):
        along, speed = _difference(springs, row, position), _difference(springs, row, velocity)
        stiffness, damping, rest_length = _row(springs, row, along[0])
        squared = jnp.maximum(_dot(along, along), springs.shortest**2)
        stretch = squared - rest_length * jnp.sqrt(squared)
        force = stiffness * stretch + damping * _dot(along, speed)
        # The division comes last because XLA does not repeat divisions: it keeps the tension in
        # memory; otherwise it would compute it again for each of its six uses.
        tensions.append(force / squared)
    return tensions


def pull(
    springs: Springs, weights: list[Float[Array, "HN *B"]], values: Float[Array, "3 NHH *B"]
) -> list[Float[Array, "N *B"]]:
    """Along each axis: the sum over a particle's springs of `weight (value_other - value_self)`.

    With tensions as weights and positions as values, these are the spring forces, newtons.

    Args:
        springs: springs of the body.
        weights: weights of the springs, by offset.
        values: values of the particles, with halo.
    """
    return [_pull(springs, weights, values[axis]) for axis in range(3)]


def _pull(
    springs: Springs,
    weights: list[Float[Array, "HN *B"]],
    values: Float[Array, "NHH *B"],
    sign: int = 1,
) -> Float[Array, "N *B"]:
    """`pull` along one axis, times `sign`, 1 or -1; see `_subtract`."""
    halo = springs.halo
    end = len(values) - halo
    here = slice(halo, end)
    total = jnp.zeros_like(values[here])
    if not springs.offsets:
        for row, weight in enumerate(weights):
            total = total + weight * _subtract(_neighbours(springs, row, values), values, sign)
        return total
    for offset, weight in zip(springs.offsets, weights, strict=True):
        after, before = slice(halo + offset, end + offset), slice(halo - offset, end - offset)
        total = (
            total
            + weight[here] * _subtract(values[after], values[here], sign)
            + weight[before] * _subtract(values[before], values[here], sign)
        )
    return total


def spring_forces_vjp(
    springs: Springs,
    tensions: list[Float[Array, "HN *B"]],
    position: Float[Array, "3 NHH *B"],
    velocity: Float[Array, "3 NHH *B"],
    force_bar: Float[Array, "3 NHH *B"],
) -> tuple[list[Float[Array, "N *B"]], list[Float[Array, "N *B"]]]:
    """Cotangents of positions and velocities, from a cotangent of the spring forces.

    Let `d`, `w` and `e` be the differences of position, velocity and `force_bar` between a
    spring's ends. The force on its first end is `t d`, so the cotangent of `t` is `-e.d`, and
    the cotangents of `d` and `w` are

        -t e + a w + b d  and  a d,  with  a = -(e.d) dt/d(d.w),  b = -2 (e.d) dt/d(d.d):

    the cotangents of particles are pulls with the weights t, a and b. JAX's own transpose turns
    every shifted slice into a padded copy, and is many times slower. Each loop that takes
    differences of positions writes them in a different form, see `_subtract`.

    Args:
        springs: springs of the body.
        tensions: tensions of the springs.
        position: positions with halo, metres.
        velocity: velocities with halo, metres per second.
        force_bar: cotangent of the forces, with halo.
    """
    by_rate, by_square = [], []
    for row, tension in enumerate(tensions):
        away = _difference(springs, row, position, sign=-1)
        apart = _difference(springs, row, force_bar)
        together = _difference_together(springs, row, position)
        along = [together[axis] for axis in range(3)]
        stiffness, damping, rest_length = _row(springs, row, tension)
        least = springs.shortest**2
        share = _dot(away, apart) / jnp.maximum(_dot(away, away), least)
        by_rate.append(damping * share)
        square = _dot(along, along)
        length = jnp.sqrt(jnp.maximum(square, least))
        slope = 2.0 * (stiffness - tension) * length - stiffness * rest_length
        by_square.append(jnp.where(square > least, share, 0.0) * slope / length)
    position_bar = [
        _pull(springs, tensions, force_bar[axis])
        - _pull(springs, by_rate, velocity[axis])
        - _pull(springs, by_square, position[axis])
        for axis in range(3)
    ]
    velocity_bar = [_pull(springs, by_rate, position[axis], sign=-1) for axis in range(3)]
    return position_bar, velocity_bar


def springs_vjp(
    springs: Springs,
    tensions: list[Float[Array, " HN"]],
    position: Float[Array, "3 NHH"],
    velocity: Float[Array, "3 NHH"],
    force_bar: Float[Array, "3 NHH"],
) -> Springs:
    """Cotangents of the springs, from a cotangent of their forces; see `spring_forces_vjp`."""
    stiffness_bar, damping_bar, rest_length_bar = [], [], []
    shortest_bar = jnp.zeros_like(springs.shortest)
    for row, tension in enumerate(tensions):
        along, speed = _difference(springs, row, position), _difference(springs, row, velocity)
        stiffness, damping, rest_length = _row(springs, row, along[0])
        # Each of the two entries of a spring stored twice acts on one end.
        apart = _difference(springs, row, force_bar) if springs.offsets else list(-force_bar)
        tension_bar = -_dot(along, apart)
        square, least, rate = _dot(along, along), springs.shortest**2, _dot(along, speed)
        squared = jnp.maximum(square, least)
        curvature = (stiffness - tension) * squared - damping * rate
        short = jnp.where(square > least, 0.0, tension_bar)
        shortest_bar += springs.shortest * (short * curvature / (squared * squared)).sum()
        inverse = 1.0 / jnp.sqrt(squared)
        stiffness_bar.append(tension_bar * (1.0 - rest_length * inverse))
        damping_bar.append(tension_bar * rate / squared)
        rest_length_bar.append(-tension_bar * stiffness * inverse)

    def table(rows: list[Float[Array, " HN"]]) -> Float[Array, "D HN"]:
        return jnp.asarray(rows).reshape(springs.stiffness.shape)  # also for no row

    return dataclasses.replace(
        springs,
        stiffness=table(stiffness_bar),
        damping=table(damping_bar),
        rest_length=table(rest_length_bar),
        shortest=shortest_bar,
    )


def _difference(
    springs: Springs, row: int, values: Float[Array, "3 NHH *B"], sign: int = 1
) -> list[Float[Array, "HN *B"]]:
    """Along each axis: `value_other - value_self` of the springs of one row, times `sign`."""
    # Component by component: XLA does not vectorise a sum over the first axis.
    if not springs.offsets:
        return [
            _subtract(_neighbours(springs, row, values[axis]), values[axis], sign)
            for axis in range(3)
        ]
    offset = springs.offsets[row]
    end = values.shape[1] - springs.halo
    return [
        _subtract(values[axis, offset : end + offset], values[axis, :end], sign)
        for axis in range(3)
    ]


def _difference_together(
    springs: Springs, row: int, values: Float[Array, "3 NHH *B"]
) -> Float[Array, "3 HN *B"]:
    """`_difference` as one array; see `_subtract`."""
    if not springs.offsets:
        return values.at[:, springs.neighbours[row]].get(mode="promise_in_bounds") - values
    offset = springs.offsets[row]
    end = values.shape[1] - springs.halo
    return values[:, offset : end + offset] - values[:, :end]


def _subtract(a: Array, b: Array, sign: int) -> Array:
    """`sign * (a - b)`, for a sign of 1 or -1.

    If several loops take the same difference, XLA computes it once, in a loop of its own, and
    keeps it in memory, which is slower than recomputing it. It does not merge differences of
    opposite sign.
    """
    return a - b if sign > 0 else b - a


def _neighbours(springs: Springs, row: int, values: Float[Array, "N *B"]) -> Float[Array, "N *B"]:
    return values.at[springs.neighbours[row]].get(mode="promise_in_bounds")


def _row(springs: Springs, row: int, like: Array) -> list[Array]:
    """Stiffness, damping and rest length of the springs of one row, for a batch."""
    tables = (springs.stiffness, springs.damping, springs.rest_length)
    return [over_batch(table[row], like) for table in tables]


def over_batch(values: Float[Array, " N"], like: Float[Array, "N *B"]) -> Array:
    """Values of particles with an axis of length 1 for each axis of a batch."""
    return values.reshape(values.shape + (1,) * (like.ndim - 1))


def _dot(a: list[Float[Array, "HN *B"]], b: list[Float[Array, "HN *B"]]) -> Float[Array, "HN *B"]:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
