"""Directions of contacts: square to both sheets, or to both lines of a rope."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxsimp.dynamics.contact.contacts import PLAIN, Contacts, Exchange
from jaxsimp.dynamics.contact.settings import LEVEL, SelfContact


def directions(
    settings: SelfContact,
    contacts: Contacts,
    position: Float[Array, "3 N"],
    normal: Float[Array, "3 N"],
    exchange: Exchange = PLAIN,
) -> Float[Array, "3 2 N"]:
    """Unit vectors from each partner to the particle, square to both sheets or lines.

    Args:
        settings: how the body touches itself.
        contacts: pairs; slots without one get any unit vector.
        position: positions, metres.
        normal: see `across`.
        exchange: how values are handed to partners.
    """
    direct = _of_sheets if settings.is_sheet else _of_lines
    gather, _ = exchange
    theirs = gather(contacts.partner, contacts.listed_by, jnp.concatenate([position, normal]))
    away = position[:, None] - theirs[:3]
    mine = jnp.broadcast_to(normal[:, None], away.shape)
    return direct(settings.thickness, away, mine, theirs[3:])


def across(
    settings: SelfContact, position: Float[Array, "3 N"], *, reversible: bool = False
) -> Float[Array, "3 N"]:
    """Unit normals of a sheet, or tangents of a rope.

    Args:
        settings: how the body touches itself.
        position: positions, metres.
        reversible: whether to be differentiable in reverse mode alone, by gathers of a fixed
            number in a fixed order: JAX's own reverse is a scatter, whose order a GPU does not fix.
    """
    gather = _reversible_corners if reversible else _corners
    corners = gather(settings.frame, settings.framed, position)
    a, b, c, d = (corners[:, each] for each in range(4))
    vector = jnp.cross(a - b, c - d, axis=0) if settings.is_sheet else a - b
    return unit(vector, jnp.zeros_like(vector).at[2].set(1.0))


def _corners(
    frame: Int[Array, "4 N"], framed: Int[Array, "D N"], position: Float[Array, "3 N"]
) -> Float[Array, "3 4 N"]:
    """Positions of the particles of each frame."""
    return position.at[:, frame].get(mode="promise_in_bounds")


def _keep_places(frame: Array, framed: Array, position: Array) -> tuple[Array, Array]:
    return _corners(frame, framed, position), framed


def _corners_bar(framed: Array, bar: Array) -> tuple[None, None, Array]:
    flat = jnp.pad(bar.reshape(3, -1), ((0, 0), (0, 1)))
    return None, None, flat.at[:, framed].get(mode="promise_in_bounds").sum(axis=1)


_reversible_corners = jax.custom_vjp(_corners)
_reversible_corners.defvjp(_keep_places, _corners_bar)


def _of_sheets(
    thickness: Float[Array, ""],
    away: Float[Array, "3 *K"],
    mine: Float[Array, "3 *K"],
    yours: Float[Array, "3 *K"],
) -> Float[Array, "3 *K"]:
    """Along both normals, each turned to point away from the partner.

    Where the partner is beside the particle and not above or below it, straight away from it.
    """
    above, below = dot(mine, away), dot(yours, away)
    bisector = jnp.where(above[None] < 0, -mine, mine) + jnp.where(below[None] < 0, -yours, yours)
    straight = unit(away, jnp.zeros_like(away).at[2].set(1.0))
    beside = jnp.maximum(jnp.abs(above), jnp.abs(below)) < LEVEL * thickness
    folded = dot(bisector, bisector) < 1.0
    return jnp.where((beside | folded)[None], straight, unit(bisector, straight))


def _of_lines(
    thickness: Float[Array, ""],
    away: Float[Array, "3 *K"],
    mine: Float[Array, "3 *K"],
    yours: Float[Array, "3 *K"],
) -> Float[Array, "3 *K"]:
    """Square to both tangents, or straight away from the partner where that is no direction."""
    square = away - dot(mine, away)[None] * mine
    other = yours - dot(mine, yours)[None] * mine
    turned = dot(other, other)
    crossing = turned > 0.05
    part = dot(other, square) / jnp.where(crossing, turned, 1.0)
    square = jnp.where(crossing[None], square - part[None] * other, square)
    straight = unit(away, jnp.zeros_like(away).at[2].set(1.0))
    beside = dot(square, square) < (LEVEL * thickness) ** 2
    return jnp.where(beside[None], straight, unit(square, straight))


def unit(vector: Float[Array, "3 *K"], otherwise: Float[Array, "3 *K"]) -> Float[Array, "3 *K"]:
    """Vectors of length one; other values where there is no length."""
    squared = dot(vector, vector)
    some = squared > 1e-20
    scale = jax.lax.rsqrt(jnp.where(some, squared, 1.0))
    return jnp.where(some[None], vector * scale[None], otherwise)


def dot(a: Float[Array, "3 *#K"], b: Float[Array, "3 *#K"]) -> Float[Array, "*_"]:
    """Scalar products of vectors along the first axis."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
