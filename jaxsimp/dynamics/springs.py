"""Spring forces, stored by the offset between the particle ids of a spring's ends.

In a rope or a row-major grid the springs have few distinct offsets `j - i` (2 and 6), so
the springs of one offset are a shifted copy of the particles: forces become sums of shifted
arrays, without gather or scatter. This is diagonal (DIA) storage of the spring matrix. It is
right for any body, and fast for those with few offsets.

Inside a simulation positions and velocities are (3, N + 2 H): x, y, z as rows, with a halo of
`H` inert particles, the largest offset, at either end, so that every shift stays in bounds.
"""

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


def spring_forces(
    springs: Springs, position: Float[Array, "3 NHH"], velocity: Float[Array, "3 NHH"]
) -> list[Float[Array, " N"]]:
    """Forces of all springs on the particles along x, y and z, newtons, each of shape (N,).

    Hooke's law with damping along the spring: the force on `i` towards `j` is
    `k (r - L) + c dr/dt`. Ends closer than `springs.shortest` are treated as that far apart
    along their difference, so that force and gradient stay finite, and the force is zero,
    where they coincide.

    Args:
        springs: of the body.
        position: with halo, metres.
        velocity: with halo, metres per second.
    """
    tensions = [_tension(springs, row, position, velocity) for row in range(len(springs.offsets))]
    return [_pull(springs, tensions, position[axis]) for axis in range(3)]


def _pull(
    springs: Springs, tensions: list[Float[Array, " HN"]], position: Float[Array, " NHH"]
) -> Float[Array, " N"]:
    """Force along one axis: each spring pulls at the particles at its either end."""
    halo = springs.halo
    end = len(position) - halo
    here = slice(halo, end)
    force = jnp.zeros_like(position[here])
    for offset, tension in zip(springs.offsets, tensions, strict=True):
        after, before = slice(halo + offset, end + offset), slice(halo - offset, end - offset)
        force = (
            force
            + tension[here] * (position[after] - position[here])
            - tension[before] * (position[here] - position[before])
        )
    return force


def _tension(
    springs: Springs, row: int, position: Float[Array, "3 NHH"], velocity: Float[Array, "3 NHH"]
) -> Float[Array, " HN"]:
    """Force per distance of the ends, newtons per metre, of the springs of one offset."""
    offset = springs.offsets[row]
    end = position.shape[1] - springs.halo
    # Component by component: XLA does not vectorise a sum over the first axis.
    along = [position[axis, offset : end + offset] - position[axis, :end] for axis in range(3)]
    speed = [velocity[axis, offset : end + offset] - velocity[axis, :end] for axis in range(3)]
    squared = along[0] * along[0] + along[1] * along[1] + along[2] * along[2]
    squared = jnp.maximum(squared, springs.shortest**2)
    rate = along[0] * speed[0] + along[1] * speed[1] + along[2] * speed[2]
    stretch = squared - springs.rest_length[row] * jnp.sqrt(squared)
    # The division comes last because XLA holds it too dear to repeat: it keeps the tension in
    # memory, where it would otherwise compute it again for each of its six uses.
    return (springs.stiffness[row] * stretch + springs.damping[row] * rate) / squared
