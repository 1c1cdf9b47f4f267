"""Spring forces, stored by the offset between the particle ids of a spring's ends.

In a rope or a row-major grid the springs have few distinct offsets `j - i` (2 and 6), so
the springs of one offset are a shifted copy of the particles: forces become sums of shifted
arrays, without gather or scatter. This is diagonal (DIA) storage of the spring matrix. It is
right for any body, and fast for those with few offsets.

Inside a simulation positions and velocities are (3, N + 2 H): x, y, z as rows, with a halo of
`H` inert particles, the largest offset, at either end, so that every shift stays in bounds.
"""

import dataclasses
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsimp.body import Body


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["stiffness", "damping", "rest_length", "shortest"],
    meta_fields=["offsets"],
)
@dataclass(frozen=True)
class Springs:
    """The springs of a body, by offset.

    Row `d`, column `H + i` is the spring from particle `i` to `i + offsets[d]`; stiffness and
    damping are zero where the body has none.

    Attributes:
        offsets: distinct values of `j - i`, ascending, static.
        stiffness: shape (D, H + N), newtons per metre.
        damping: shape (D, H + N), newton-seconds per metre.
        rest_length: shape (D, H + N), metres.
        shortest: length under which a spring's direction is regularised, metres.
    """

    offsets: tuple[int, ...]
    stiffness: Float[Array, "... D HN"]
    damping: Float[Array, "... D HN"]
    rest_length: Float[Array, "... D HN"]
    shortest: Float[Array, "..."]

    @property
    def halo(self) -> int:
        """Inert particles at either end of an array, `H`."""
        return max(self.offsets, default=0)


def make_springs(body: Body) -> Springs:
    """The springs of a body, sorted by offset."""
    low, high = body.springs.min(axis=1), body.springs.max(axis=1)
    offsets, row = np.unique(high - low, return_inverse=True)
    halo = int(offsets.max(initial=0))

    def by_offset(values: np.ndarray) -> Array:
        table = np.zeros((len(offsets), halo + body.num_particles))
        table[row, halo + low] = values
        return jnp.asarray(table, dtype=float)

    return Springs(
        offsets=tuple(int(offset) for offset in offsets),
        stiffness=by_offset(body.stiffness),
        damping=by_offset(body.damping),
        rest_length=by_offset(body.rest_length),
        # A thousandth of a spring: far below any state of interest, far above rounding.
        shortest=jnp.asarray(1e-3 * body.rest_length.min(initial=1.0), dtype=float),
    )


def spring_tensions(
    springs: Springs, position: Float[Array, "3 NHH"], velocity: Float[Array, "3 NHH"]
) -> list[Float[Array, " HN"]]:
    """Force of each spring over the distance of its ends, newtons per metre, by offset.

    Hooke's law with damping along the spring: the force on `i` towards `j` is
    `k (r - L) + c dr/dt`. Ends closer than `springs.shortest` are treated as that far apart
    along their difference, so that force and gradient stay finite, and the force is zero,
    where they coincide.

    Args:
        springs: of the body.
        position: with halo, metres.
        velocity: with halo, metres per second.
    """
    tensions = []
    for row in range(len(springs.offsets)):
        along, speed = _difference(springs, row, position), _difference(springs, row, velocity)
        squared = jnp.maximum(_dot(along, along), springs.shortest**2)
        stretch = squared - springs.rest_length[row] * jnp.sqrt(squared)
        force = springs.stiffness[row] * stretch + springs.damping[row] * _dot(along, speed)
        # The division comes last because XLA holds it too dear to repeat: it keeps the tension
        # in memory, where it would otherwise compute it again for each of its six uses.
        tensions.append(force / squared)
    return tensions


def pull(
    springs: Springs, weights: list[Float[Array, " HN"]], values: Float[Array, "3 NHH"]
) -> list[Float[Array, " N"]]:
    """Along each axis: the sum over a particle's springs of `weight (value_other - value_self)`.

    The forces of the springs, newtons, when the weights are tensions and the values positions.

    Args:
        springs: of the body.
        weights: of the springs, by offset.
        values: of the particles, with halo.
    """
    return [_pull(springs, weights, values[axis]) for axis in range(3)]


def _pull(
    springs: Springs, weights: list[Float[Array, " HN"]], values: Float[Array, " NHH"]
) -> Float[Array, " N"]:
    halo = springs.halo
    end = len(values) - halo
    here = slice(halo, end)
    total = jnp.zeros_like(values[here])
    for offset, weight in zip(springs.offsets, weights, strict=True):
        after, before = slice(halo + offset, end + offset), slice(halo - offset, end - offset)
        total = (
            total
            + weight[here] * (values[after] - values[here])
            - weight[before] * (values[here] - values[before])
        )
    return total


def spring_forces_vjp(
    springs: Springs,
    tensions: list[Float[Array, " HN"]],
    position: Float[Array, "3 NHH"],
    velocity: Float[Array, "3 NHH"],
    force_bar: Float[Array, "3 NHH"],
) -> tuple[Springs, list[Float[Array, " N"]], list[Float[Array, " N"]]]:
    """Cotangents of springs, positions and velocities for one of the spring forces.

    Let `d`, `w` and `e` be the differences of position, velocity and `force_bar` between a
    spring's ends. The force on its first end is `t d`, so the cotangent of `t` is `-e.d`, and
    the cotangents of `d` and `w` are

        -t e + a w + b d  and  a d,  with  a = -(e.d) dt/d(d.w),  b = -2 (e.d) dt/d(d.d):

    the cotangents of particles are pulls with the weights t, a and b. JAX's own transpose turns
    every shifted slice into a padded copy, and is many times slower.

    Args:
        springs: of the body.
        tensions: of its springs.
        position: with halo, metres.
        velocity: with halo, metres per second.
        force_bar: cotangent of the forces, with halo.
    """
    by_rate, by_square = [], []
    stiffness_bar, damping_bar, rest_length_bar = [], [], []
    shortest_bar = jnp.zeros_like(springs.shortest)
    for row, tension in enumerate(tensions):
        along, speed = _difference(springs, row, position), _difference(springs, row, velocity)
        stiffness, damping = springs.stiffness[row], springs.damping[row]
        tension_bar = -_dot(along, _difference(springs, row, force_bar))
        square, least, rate = _dot(along, along), springs.shortest**2, _dot(along, speed)
        squared = jnp.maximum(square, least)
        free_bar = jnp.where(square > least, tension_bar, 0.0)
        curvature = (stiffness - tension) * squared - damping * rate
        by_rate.append(tension_bar * damping / squared)
        by_square.append(free_bar * curvature / (squared * squared))
        inverse = 1.0 / jnp.sqrt(squared)
        stiffness_bar.append(tension_bar * (1.0 - springs.rest_length[row] * inverse))
        damping_bar.append(tension_bar * rate / squared)
        rest_length_bar.append(-tension_bar * stiffness * inverse)
        slope = (tension_bar - free_bar) * curvature / (squared * squared)
        shortest_bar += springs.shortest * slope.sum()
    springs_bar = dataclasses.replace(
        springs,
        stiffness=jnp.stack(stiffness_bar),
        damping=jnp.stack(damping_bar),
        rest_length=jnp.stack(rest_length_bar),
        shortest=shortest_bar,
    )
    position_bar = [
        _pull(springs, tensions, force_bar[axis])
        - _pull(springs, by_rate, velocity[axis])
        - _pull(springs, by_square, position[axis])
        for axis in range(3)
    ]
    velocity_bar = [-_pull(springs, by_rate, position[axis]) for axis in range(3)]
    return springs_bar, position_bar, velocity_bar


def _difference(
    springs: Springs, row: int, values: Float[Array, "3 NHH"]
) -> list[Float[Array, " HN"]]:
    """Along each axis: `value_other - value_self` of the springs of one offset."""
    offset = springs.offsets[row]
    end = values.shape[1] - springs.halo
    # Component by component: XLA does not vectorise a sum over the first axis.
    return [values[axis, offset : end + offset] - values[axis, :end] for axis in range(3)]


def _dot(a: list[Float[Array, " HN"]], b: list[Float[Array, " HN"]]) -> Float[Array, " HN"]:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
