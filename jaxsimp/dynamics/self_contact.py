"""Self-contact: layers of a body rest on each other, and rub.

A particle of a sheet stands for a disc in the sheet's plane, one of a rope for a piece of its
line. Each touches at most one other on either side: the nearest that is not its neighbour in the
body (see nearest.py). A contact keeps the direction that it was found with, from one particle to
the other and square to both sheets or lines, until all are looked up again. That is when one has
moved farther than its distance from what it does not touch allows.

Contact acts every `interval` time steps on velocities, as impulses that are inelastic and look
ahead (nobody approaches faster than would close the gap within the interval), with Coulomb
friction, and on positions, where particles are closer than the thickness. Particles in several
contacts share their mass out among them (mass splitting: Tonge, Benevolenski and Voroshilov,
"Mass Splitting for Jitter-Free Parallel Rigid Body Simulation", 2012), so that one pass in
parallel does not overshoot.
"""

from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxsimp.dynamics.layers import SelfContact
from jaxsimp.dynamics.nearest import nearest_above

LEVEL = 0.3
"""Layers closer than this, of the thickness, count as side by side."""


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["partner", "direction", "listed", "found_at", "allowance", "carried", "missed"],
    meta_fields=[],
)
@dataclass(frozen=True)
class Contacts:
    """Who may touch whom.

    Attributes:
        partner: particle ids, one on either side, shape (2, N).
        direction: of unit length, from the partner, shape (3, 2, N).
        listed: whether there is a partner, shape (2, N).
        found_at: positions when they were looked up, shape (3, N), metres.
        allowance: how far each may move from there, shape (N,), metres.
        carried: 1 for a particle that lies on the table or on one that is carried, shape (N,).
        missed: contacts so far whose particles got past each other within an interval.
    """

    partner: Int[Array, "2 N"]
    direction: Float[Array, "3 2 N"]
    listed: Bool[Array, "2 N"]
    found_at: Float[Array, "3 N"]
    allowance: Float[Array, " N"]
    carried: Float[Array, " N"]
    missed: Int[Array, ""]


def find_contacts(
    settings: SelfContact,
    position: Float[Array, "3 N"],
    carried: Float[Array, " N"],
    missed: Int[Array, ""],
) -> Contacts:
    """Look up who may touch whom. Ids count as constants in derivatives, directions do not."""
    still = jax.lax.stop_gradient
    across = _across(settings, position)
    stretch = jnp.sqrt(1 + settings.squash)
    touching = jnp.hypot(settings.lateral, stretch * settings.thickness)
    reach = jnp.hypot(settings.lateral, stretch * (settings.thickness + settings.margin))

    # The sides of a sheet; around a rope there is room for more: it is above and below.
    upwards = jnp.zeros_like(position).at[2].set(1.0)
    normal = still(across) if settings.is_sheet else upwards

    def look(normal: Float[Array, "3 N"]) -> tuple[Array, Array]:
        return nearest_above(
            still(position),
            normal,
            settings.apart,
            adjacent=settings.adjacent,
            squash=settings.squash,
            level=LEVEL * settings.thickness,
            reach=reach,
        )

    found = look(normal), look(-normal)
    partner, distance = (jnp.stack(each) for each in zip(*found, strict=True))
    away = position[:, None] - position[:, partner]
    direct = _directions_of_sheets if settings.is_sheet else _directions_of_lines
    mine = jnp.broadcast_to(across[:, None], away.shape)
    direction = direct(settings.thickness, away, mine, across[:, partner])
    free = (distance.min(axis=0) - touching) / (2.0 * stretch)
    return Contacts(
        partner=partner,
        direction=direction,
        listed=partner != jnp.arange(position.shape[1])[None],
        found_at=still(position),
        allowance=jnp.maximum(settings.slack, free),
        carried=carried,
        missed=missed,
    )


def renew(
    settings: SelfContact,
    contacts: Contacts,
    position: Float[Array, "3 N"],
) -> Contacts:
    """The contacts, looked up again if a particle has gone too far."""
    moved = jax.lax.stop_gradient(position - contacts.found_at)
    return jax.lax.cond(
        (_dot(moved, moved) > contacts.allowance**2).any(),
        lambda: find_contacts(settings, position, contacts.carried, contacts.missed),
        lambda: contacts,
    )


def resolve(
    settings: SelfContact,
    contacts: Contacts,
    inverse_mass: Float[Array, " N"],
    floor: Float[Array, ""],
    seconds: Float[Array, ""],
    position: Float[Array, "3 N"],
    velocity: Float[Array, "3 N"],
) -> tuple[Contacts, Float[Array, "3 N"], Float[Array, "3 N"]]:
    """Positions and velocities after contact, and the contacts with the count of those missed.

    Args:
        settings: of the body.
        contacts: that were looked up.
        inverse_mass: 1 / kilograms, 0 for a particle that is held.
        floor: height below which no particle is pushed, metres.
        seconds: until contact acts again.
        position: metres.
        velocity: metres per second.
    """
    partner, along = contacts.partner, contacts.direction
    rows = jnp.concatenate([position, velocity, inverse_mass[None], contacts.carried[None]])
    theirs = rows[:, partner]
    away, speed = rows[:3, None] - theirs[:3], rows[3:6, None] - theirs[3:6]
    distance, approach = _dot(along, away), _dot(along, speed)
    beside = _dot(away, away) - distance * distance
    gap = distance - settings.thickness
    lacking = -jnp.maximum(gap, 0.0) / seconds - approach
    near = contacts.listed & (beside < settings.lateral**2)
    touches = near & ((gap < 0.0) | (lacking > 0.0))
    # What is carried does not give way to what lies on it: the push would be lost in the table.
    below, above = along[2] < -0.5, along[2] > 0.5
    mine = jnp.where(touches, 1.0 - below * rows[7, None], 0.0)
    yours = jnp.where(touches, 1.0 - above * theirs[7], 0.0)
    shares = mine.sum(axis=0).at[partner].add(yours)
    both = mine * (inverse_mass * shares)[None] + yours * theirs[6] * shares[partner]
    # Zero where neither can move, or nothing touches.
    per = jnp.where(both > 0.0, 1.0 / jnp.where(both > 0.0, both, 1.0), 0.0)
    impulse = per * jnp.maximum(lacking, 0.0)
    sliding = speed - approach[None] * along
    squared = jnp.maximum(_dot(sliding, sliding), 1e-12)
    # Half of what would stop a particle that another carries: both are slowed.
    rub = jnp.minimum(0.5 * per, settings.friction * impulse * jax.lax.rsqrt(squared))
    push = (per * jnp.clip(-gap, 0.0, settings.thickness))[None] * along
    change = impulse[None] * along - rub[None] * sliding
    total = jnp.concatenate([mine[None] * push, change]).sum(axis=1)
    total = total.at[:, partner].add(-jnp.concatenate([yours[None] * push, change]))
    total = inverse_mass[None] * total
    pushed = position + total[:3]
    pushed = pushed.at[2].max(jnp.minimum(position[2], floor))
    lies = near & (gap < LEVEL * settings.thickness)
    carried = jnp.where(lies & above, theirs[7], 0.0).max(axis=0, initial=0.0)
    carried = carried.at[partner].max(jnp.where(lies & below, rows[7, None], 0.0))
    carried = jnp.maximum(carried, position[2] < floor + 0.1 * settings.thickness)
    missed = contacts.missed + (near & (distance < 0.0)).sum()
    contacts = replace(contacts, missed=missed, carried=jax.lax.stop_gradient(carried))
    return contacts, pushed, velocity + total[3:]


def _across(settings: SelfContact, position: Float[Array, "3 N"]) -> Float[Array, "3 N"]:
    """Unit normals of a sheet, or tangents of a rope."""
    a, b, c, d = (position[:, ids] for ids in settings.frame)
    across = jnp.cross(a - b, c - d, axis=0) if settings.is_sheet else a - b
    return _unit(across, jnp.zeros_like(across).at[2].set(1.0))


def _directions_of_sheets(
    thickness: Float[Array, ""],
    away: Float[Array, "3 2 N"],
    mine: Float[Array, "3 2 N"],
    yours: Float[Array, "3 2 N"],
) -> Float[Array, "3 2 N"]:
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
    away: Float[Array, "3 2 N"],
    mine: Float[Array, "3 2 N"],
    yours: Float[Array, "3 2 N"],
) -> Float[Array, "3 2 N"]:
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
