"""Self-contact: layers of a body rest on each other, and rub.

A particle of a sheet stands for a disc in the sheet's plane, one of a rope for a piece of its
line. It touches the nearest on either side that is not its neighbour in the body, and those whose
nearest it is; each such pair is listed once. A contact keeps the direction that it was found with,
from one particle to the other and square to both sheets or lines, until all are looked up again.
That is when one has moved farther than its distance from what it does not touch allows.

Contact acts every `interval` time steps on velocities, as impulses that are inelastic and look
ahead (nobody approaches faster than would close the gap within the interval), with Coulomb
friction, and on positions, where particles are closer than the thickness. Particles in several
contacts share their mass out among them (mass splitting: Tonge, Benevolenski and Voroshilov,
"Mass Splitting for Jitter-Free Parallel Rigid Body Simulation", 2012), so that one pass in
parallel does not overshoot.

Values are those of cpu/kernels.py, compiled by numba, on the CPU only. Derivatives are those
of `resolve` and `directions`, the same in JAX, at these values.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import PyTreeDef
from jaxtyping import Array, Float, Int

from jaxsimp.dynamics.contact.settings import SelfContact

LEVEL = 0.3
"""Layers closer than this, of the thickness, count as side by side."""
SEARCH = 1.5
"""How far is looked for what may come near, in distances at which it is listed."""
Padded = Float[Array, "3 NHH"]
"""Something of every particle, with the halo of springs.py on either side."""


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["pairs", "direction", "found_at", "allowance", "carried", "missed"],
    meta_fields=[],
)
@dataclass(frozen=True)
class Contacts:
    """Who may touch whom.

    Attributes:
        pairs: particle ids, shape (2, 2 N); after the last pair 0 and 0.
        direction: of unit length, from the second of each pair to the first, shape (3, 2 N).
        found_at: positions when they were looked up, shape (3, N), metres.
        allowance: how far each may move from there, shape (N,), metres.
        carried: 1 for a particle that lies on the table or on one that is carried, shape (N,).
        missed: contacts so far whose particles got past each other within an interval.
    """

    pairs: Int[Array, "2 NN"]
    direction: Float[Array, "3 NN"]
    found_at: Float[Array, "3 N"]
    allowance: Float[Array, " N"]
    carried: Float[Array, " N"]
    missed: Int[Array, ""]


def find_contacts(settings: SelfContact, position: Padded, missed: Int[Array, ""]) -> Contacts:
    """Look up who may touch whom, with so many contacts missed before."""
    count, real = settings.apart.shape[1], position.dtype
    nobody = Contacts(
        pairs=jnp.zeros((2, 2 * count), jnp.int32),
        direction=jnp.zeros((3, 2 * count), real),
        found_at=jnp.zeros((3, count), real),
        allowance=jnp.full(count, -1.0, real),
        carried=jnp.zeros(count, real),
        missed=missed.astype(jnp.int32),
    )
    nothing, zero = jnp.zeros(count, real), jnp.zeros((), real)
    still = jnp.zeros_like(position)
    return touch(settings, nobody, nothing, zero, zero, position, still, passes=0)[0]


def touch(
    settings: SelfContact,
    contacts: Contacts,
    inverse_mass: Float[Array, " N"],
    floor: Float[Array, ""],
    seconds: Float[Array, ""],
    position: Padded,
    velocity: Padded,
    *,
    passes: int,
) -> tuple[Contacts, Padded, Padded]:
    """Positions and velocities after contact, and contacts that are good until it acts again.

    Args:
        settings: of the body.
        contacts: that were looked up.
        inverse_mass: 1 / kilograms, 0 for a particle that is held.
        floor: height below which no particle is pushed, metres.
        seconds: until contact acts again.
        position: metres.
        velocity: metres per second.
        passes: over all contacts.
    """
    arguments = (settings, contacts, inverse_mass, floor, seconds, position, velocity)
    leaves, tree = jax.tree.flatten(arguments)
    position, velocity, *of_contacts = _touch(tree, passes, leaves)[:-1]
    return Contacts(*of_contacts), position, velocity


# Of leaves: JAX makes trees of things that are no arrays here.
@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _touch(tree: PyTreeDef, passes: int, leaves: list[Array]) -> list[Array]:
    """Position, velocity, fields of the contacts, and whether they were looked up again."""
    from jaxsimp.dynamics.contact.cpu.kernels import touch_target  # numba takes a while to import

    settings, contacts, inverse_mass, floor, seconds, position, velocity = jax.tree.unflatten(
        tree, leaves
    )
    real, stretch = position.dtype, jnp.sqrt(1 + settings.squash)
    near = stretch * settings.thickness
    reach = jnp.hypot(settings.lateral, near + stretch * settings.margin)
    numbers = [
        settings.adjacent,
        settings.thickness,
        settings.lateral,
        settings.slack,
        settings.squash,
        settings.friction,
        floor,
        seconds,
        LEVEL * settings.thickness,
        jnp.hypot(settings.lateral, near),
        reach,
        SEARCH * reach,
    ]
    changing = [
        position,
        velocity,
        contacts.pairs,
        contacts.direction,
        contacts.found_at,
        contacts.allowance,
        contacts.carried,
        contacts.missed,
    ]
    kinds = [jax.ShapeDtypeStruct(each.shape, each.dtype) for each in changing]
    call = jax.ffi.ffi_call(
        touch_target(np.dtype(real)),
        (*kinds, jax.ShapeDtypeStruct((), np.dtype(bool))),
        vmap_method="sequential",
        # All but positions and velocities: made to share those, XLA copies more, not less.
        input_output_aliases={place: place for place in range(2, len(changing))},
    )
    constant = (
        inverse_mass,
        jnp.stack(numbers).astype(real),
        settings.frame.astype(jnp.int32),
        settings.apart,
        jnp.asarray(settings.is_sheet),
        jnp.asarray(passes, jnp.int32),
    )
    return list(call(*changing, *constant))


@_touch.defjvp
def _touch_jvp(
    tree: PyTreeDef, passes: int, primals: tuple[list[Array]], tangents: tuple[list[Any]]
) -> tuple[list[Array], list[Any]]:
    """Ids, and whether contacts are looked up, count as constants."""
    result = _touch(tree, passes, *primals)
    pairs, renewed = result[2], result[-1]

    def smooth(leaves: list[Array]) -> tuple[Array, Array, Array]:
        settings, contacts, inverse_mass, floor, seconds, *moving = jax.tree.unflatten(tree, leaves)
        count = len(inverse_mass)
        halo = (moving[0].shape[1] - count) // 2
        position, velocity = (array[:, halo : halo + count] for array in moving)
        carried = contacts.carried
        for _ in range(passes):
            carried, position, velocity = resolve(
                settings, contacts, carried, inverse_mass, floor, seconds, position, velocity
            )
        anew = directions(settings, pairs, position)
        direction = jnp.where(renewed, anew, contacts.direction)
        ends = ((0, 0), (halo, halo))
        return jnp.pad(position, ends), jnp.pad(velocity, ends), direction

    _, (by_position, by_velocity, by_direction) = jax.jvp(smooth, primals, tangents)
    nothing = [
        jnp.zeros_like(each)
        if jnp.issubdtype(each.dtype, jnp.floating)
        else np.zeros(each.shape, jax.dtypes.float0)
        for each in result
    ]
    return result, [by_position, by_velocity, nothing[2], by_direction, *nothing[4:]]


def resolve(
    settings: SelfContact,
    contacts: Contacts,
    carried: Float[Array, " N"],
    inverse_mass: Float[Array, " N"],
    floor: Float[Array, ""],
    seconds: Float[Array, ""],
    position: Float[Array, "3 N"],
    velocity: Float[Array, "3 N"],
) -> tuple[Float[Array, " N"], Float[Array, "3 N"], Float[Array, "3 N"]]:
    """What is carried, positions and velocities after one pass over all contacts."""
    along, (first, second) = contacts.direction, contacts.pairs
    rows = jnp.concatenate([position, velocity, inverse_mass[None], carried[None]])
    ours, theirs = rows[:, first], rows[:, second]
    away, speed = ours[:3] - theirs[:3], ours[3:6] - theirs[3:6]
    distance, approach = _dot(along, away), _dot(along, speed)
    beside = _dot(away, away) - distance * distance
    gap = distance - settings.thickness
    lacking = -jnp.maximum(gap, 0.0) / seconds - approach
    near = (first != second) & (beside < settings.lateral**2)
    touches = near & ((gap < 0.0) | (lacking > 0.0))
    # What is carried does not give way to what lies on it: the push would be lost in the table.
    below, above = along[2] < -0.5, along[2] > 0.5
    mine = jnp.where(touches, 1.0 - below * ours[7], 0.0)
    yours = jnp.where(touches, 1.0 - above * theirs[7], 0.0)
    shares = jnp.zeros_like(carried).at[first].add(mine).at[second].add(yours)
    both = mine * ours[6] * shares[first] + yours * theirs[6] * shares[second]
    # Zero where neither can move, or nothing touches.
    per = jnp.where(both > 0.0, 1.0 / jnp.where(both > 0.0, both, 1.0), 0.0)
    impulse = per * jnp.maximum(lacking, 0.0)
    sliding = speed - approach[None] * along
    squared = jnp.maximum(_dot(sliding, sliding), 1e-12)
    # Half of what would stop a particle that another carries: both are slowed.
    rub = jnp.minimum(0.5 * per, settings.friction * impulse * jax.lax.rsqrt(squared))
    push = (per * jnp.clip(-gap, 0.0, settings.thickness))[None] * along
    change = impulse[None] * along - rub[None] * sliding
    total = jnp.zeros_like(rows[:6])
    total = total.at[:, first].add(jnp.concatenate([mine[None] * push, change]))
    total = total.at[:, second].add(-jnp.concatenate([yours[None] * push, change]))
    total = inverse_mass[None] * total
    pushed = position + total[:3]
    pushed = pushed.at[2].max(jnp.minimum(position[2], floor))
    lies = near & (gap < LEVEL * settings.thickness)
    lying = jnp.zeros_like(carried).at[first].max(jnp.where(lies & above, theirs[7], 0.0))
    lying = lying.at[second].max(jnp.where(lies & below, ours[7], 0.0))
    on_table = position[2] < floor + 0.1 * settings.thickness
    carried = jnp.where(on_table, 1.0, jax.lax.stop_gradient(lying))
    return carried, pushed, velocity + total[3:]


def directions(
    settings: SelfContact, pairs: Int[Array, "2 NN"], position: Float[Array, "3 N"]
) -> Float[Array, "3 NN"]:
    """Unit vectors between pairs, square to both sheets or lines; any where there is none."""
    across, (first, second) = _across(settings, position), pairs
    direct = _directions_of_sheets if settings.is_sheet else _directions_of_lines
    away = position[:, first] - position[:, second]
    return direct(settings.thickness, away, across[:, first], across[:, second])


def _across(settings: SelfContact, position: Float[Array, "3 N"]) -> Float[Array, "3 N"]:
    """Unit normals of a sheet, or tangents of a rope."""
    a, b, c, d = (position[:, ids] for ids in settings.frame)
    across = jnp.cross(a - b, c - d, axis=0) if settings.is_sheet else a - b
    return _unit(across, jnp.zeros_like(across).at[2].set(1.0))


def _directions_of_sheets(
    thickness: Float[Array, ""],
    away: Float[Array, "3 NN"],
    mine: Float[Array, "3 NN"],
    yours: Float[Array, "3 NN"],
) -> Float[Array, "3 NN"]:
    """Along both normals, each turned to point away from the partner.

    Where the partner is beside the particle and not above or below it, straight away from it.
    """
    above, below = _dot(mine, away), _dot(yours, away)
    bisector = jnp.where(above[None] < 0, -mine, mine) + jnp.where(below[None] < 0, -yours, yours)
    straight = _unit(away, jnp.zeros_like(away).at[2].set(1.0))
    beside = jnp.maximum(jnp.abs(above), jnp.abs(below)) < LEVEL * thickness
    folded = _dot(bisector, bisector) < 1.0
    return jnp.where((beside | folded)[None], straight, _unit(bisector, straight))


def _directions_of_lines(
    thickness: Float[Array, ""],
    away: Float[Array, "3 NN"],
    mine: Float[Array, "3 NN"],
    yours: Float[Array, "3 NN"],
) -> Float[Array, "3 NN"]:
    """Square to both tangents, or straight away from the partner where that is no direction."""
    square = away - _dot(mine, away)[None] * mine
    other = yours - _dot(mine, yours)[None] * mine
    turned = _dot(other, other)
    crossing = turned > 0.05
    part = _dot(other, square) / jnp.where(crossing, turned, 1.0)
    square = jnp.where(crossing[None], square - part[None] * other, square)
    straight = _unit(away, jnp.zeros_like(away).at[2].set(1.0))
    beside = _dot(square, square) < (LEVEL * thickness) ** 2
    return jnp.where(beside[None], straight, _unit(square, straight))


def _unit(vector: Float[Array, "3 *N"], otherwise: Float[Array, "3 *N"]) -> Float[Array, "3 *N"]:
    """Of length one; something else where there is no length."""
    squared = _dot(vector, vector)
    some = squared > 1e-20
    scale = jax.lax.rsqrt(jnp.where(some, squared, 1.0))
    return jnp.where(some[None], vector * scale[None], otherwise)


def _dot(a: Float[Array, "3 *N"], b: Float[Array, "3 *N"]) -> Float[Array, "*N"]:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
