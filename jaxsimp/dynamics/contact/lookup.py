"""Lookup of the pairs that may touch: the nearest particle on either side of each.

A particle is due for a lookup when it has moved farther than its distance to those that it does
not touch allows. If these are few, they alone are compared with all. Of the others, each then takes
one of them as its nearest if that is nearer than its own, and is compared with all if its own has
gone away. If they are many, all are compared with all.

The definition, in JAX, for any device; cpu/lookup.py finds the same. Distances are compared in
tiles, so that memory grows with the number of particles alone.
"""

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.tree_util import PyTreeDef
from jaxtyping import Array, Bool, Float, Int

from jaxsimp.dynamics.contact.contacts import CAPACITY, Contacts
from jaxsimp.dynamics.contact.directions import across, directions, dot
from jaxsimp.dynamics.contact.settings import (
    ALONE,
    FEW,
    LEVEL,
    SelfContact,
    listing_distances,
)

TILE = 64
"""Particles that are compared with all others at a time."""
GROUP = 32
"""Samples of a batch that are looked up at a time."""
LOOKED_UP = (
    "nearest",
    "distance",
    "partner",
    "listed_by",
    "found_at",
    "allowance",
    "renewed",
)
"""Fields of `Contacts` that a lookup replaces."""


def renew(settings: SelfContact, contacts: Contacts, position: Float[Array, "3 N"]) -> Contacts:
    """Contacts that hold for the next time step: particles that moved too far are looked up.

    Under `vmap` only those samples are looked up that need it. Directions alone have derivatives.
    """
    arguments = settings, contacts, position
    leaves, tree = jax.tree.flatten(jax.lax.stop_gradient(arguments))

    # Of leaves: JAX makes trees of things that are no arrays here.
    @jax.custom_batching.custom_vmap
    def one(leaves: list[Array]) -> list[Array]:
        is_due = _any_due(tree, leaves)
        return jax.lax.cond(is_due, lambda: _look_up(tree, leaves), lambda: _kept(tree, leaves))

    @one.def_vmap
    def several(size: int, batched: Any, leaves: list[Array]) -> tuple[list[Array], list[bool]]:
        (is_batched,) = batched
        if not any(is_batched):
            return one(leaves), [False] * len(LOOKED_UP)
        axes = [0 if each else None for each in is_batched]
        is_due = jax.vmap(lambda leaves: _any_due(tree, leaves), (axes,))(leaves)
        kept = jax.vmap(lambda leaves: _kept(tree, leaves), (axes,))(leaves)

        def group(carry: tuple[Array, list[Array]]) -> tuple[Array, list[Array]]:
            waiting, contacts = carry
            is_member, members = jax.lax.top_k(waiting.astype(jnp.int32), min(GROUP, size))
            chosen = [
                leaf[members] if each else leaf
                for each, leaf in zip(is_batched, leaves, strict=True)
            ]
            found = jax.vmap(lambda leaves: _look_up(tree, leaves), (axes,))(chosen)
            places = jnp.where(is_member > 0, members, size)
            contacts = [
                old.at[places].set(new, mode="drop")
                for old, new in zip(contacts, found, strict=True)
            ]
            return waiting.at[places].set(False, mode="drop"), contacts

        _, found = jax.lax.while_loop(lambda carry: carry[0].any(), group, (is_due, kept))
        return found, [True] * len(LOOKED_UP)

    found = replace(contacts, **dict(zip(LOOKED_UP, one(leaves), strict=True)))
    anew = directions(settings, found, position, across(settings, position))
    return replace(found, direction=jnp.where(found.renewed[None], anew, contacts.direction))


def _any_due(tree: PyTreeDef, leaves: list[Array]) -> Bool[Array, ""]:
    return _due(*jax.tree.unflatten(tree, leaves)[1:])[0].any()


def _due(
    contacts: Contacts, position: Float[Array, "3 N"]
) -> tuple[Bool[Array, " N"], Float[Array, "3 N"]]:
    """Particles that moved too far, and where all were found, moved along with all.

    A move that all have in common brings none nearer to another. Where some move and some lie
    still, half of it is common to all. Either view is right: that with fewer that are due is taken.
    """
    move = position - contacts.found_at
    common = (move.min(axis=1) + move.max(axis=1)) / 2
    limit = contacts.allowance * jnp.abs(contacts.allowance)

    def beyond(move: Float[Array, "3 N"]) -> Bool[Array, " N"]:
        return ~(dot(move, move) <= limit)

    alone, along = beyond(move), beyond(move - common[:, None])
    fewer = along.sum() < alone.sum()
    found_at = contacts.found_at + jnp.where(fewer, common, 0.0)[:, None]
    return jnp.where(fewer, along, alone), found_at


def _kept(tree: PyTreeDef, leaves: list[Array]) -> list[Array]:
    """The fields `LOOKED_UP`, where no particle is due."""
    _, contacts, _ = jax.tree.unflatten(tree, leaves)
    contacts = replace(contacts, renewed=jnp.zeros_like(contacts.renewed))
    return [getattr(contacts, name) for name in LOOKED_UP]


def _look_up(tree: PyTreeDef, leaves: list[Array]) -> list[Array]:
    """The fields `LOOKED_UP`, where some particles are due."""
    settings, contacts, position = jax.tree.unflatten(tree, leaves)
    due, found_at = _due(contacts, position)
    number = due.sum()
    due |= (number > ALONE) | (FEW * number > len(due))
    nearest, distance, free, *offers = _compare(tree, leaves, due)
    offered = Offered(*offers)
    # The others: what they had is due, too, and is among what is offered, if it is near still.
    known = jnp.where(due[contacts.nearest], jnp.inf, contacts.distance)
    is_taken = ~due[None] & (offered.distance < known)
    nearest = jnp.where(is_taken, offered.nearest, nearest)
    distance = jnp.where(due[None], distance, jnp.minimum(known, offered.distance))
    farthest = jnp.sqrt(contacts.distance) + settings.slack[None]
    is_lost = (distance > contacts.distance) & (distance > farthest * farthest)
    lost = is_lost.any(axis=0) & ~due
    found = replace(contacts, nearest=nearest, distance=distance)
    nearest, distance, *_ = _compare(tree, jax.tree.leaves((settings, found, position)), lost)
    partner, listed_by = list_pairs(nearest)
    found_at = jnp.where(due, position, found_at)
    moved = position - found_at
    # Half of what is free until one touches one that is due.
    within = jnp.sqrt(dot(moved, moved)) + jnp.maximum(settings.slack, 0.5 * offered.free)
    kept = jnp.minimum(contacts.allowance, within)
    allowance = jnp.where(due, jnp.maximum(settings.slack, 0.5 * free), kept)
    anew = due | lost
    is_listed = partner != jnp.arange(len(due), dtype=partner.dtype)[None]
    renewed = is_listed & ((partner != contacts.partner) | anew[None] | anew[partner])
    return [nearest, distance, partner, listed_by, found_at, allowance, renewed]


class Offered(NamedTuple):
    """The nearest of some particles to each.

    Attributes:
        nearest: ids of the nearest above and below, shape (2, N).
        distance: squared distances to them, see `Contacts.distance`; infinite where there is none.
        free: distance that each may come nearer to them until it touches one, shape (N,), metres;
            infinite where none is found.
    """

    nearest: Int[Array, "2 N"]
    distance: Float[Array, "2 N"]
    free: Float[Array, " N"]


@partial(jax.jit, static_argnums=0)
def _compare(tree: PyTreeDef, leaves: list[Array], chosen: Bool[Array, " N"]) -> list[Array]:
    """Compare the chosen particles with all, in tiles.

    Returns:
        The fields `nearest` and `distance` with new values for the chosen, the distance that each
        of them may come nearer to others until it touches one, and what they offer to the others,
        the fields of `Offered`.
    """
    settings, contacts, position = jax.tree.unflatten(tree, leaves)
    count, level = position.shape[1], LEVEL * settings.thickness
    stretch = jnp.sqrt(1 + settings.squash)
    touching, reach, search = listing_distances(settings)
    reach, search = reach * reach, search * search
    # Around a rope there is room for more: its sides are above and below.
    normal = across(settings, position)
    up = normal if settings.is_sheet else jnp.zeros_like(normal).at[2].set(1.0)
    order = jnp.argsort(~chosen, stable=True)
    number, tiles = chosen.sum(), -(-count // TILE)
    order = jnp.pad(order, (0, tiles * TILE - count), constant_values=count)
    everyone = jnp.arange(count, dtype=contacts.nearest.dtype)

    def by_side(seen_from: Array, away: Array, may_touch: Array) -> Float[Array, "2 T N"]:
        """Squared distances above and below; infinite where a particle is not there."""
        squared, height = dot(away, away), dot(up[:, seen_from], away)
        stretched = squared + settings.squash[seen_from] * height * height
        is_near = may_touch & (stretched < reach[seen_from])
        on_side = jnp.stack([height >= -level, height <= level])
        return jnp.where(is_near[None] & on_side, stretched[None], jnp.inf)

    def free(distance: Array, clear: Array, ids: Array) -> Array:
        """One beside a particle may come nearer by its whole distance, one above it by less."""
        stretched = jnp.minimum(distance.min(axis=0), reach[ids])
        return jnp.maximum(
            (jnp.sqrt(stretched) - touching[ids]) / stretch[ids], jnp.sqrt(clear) - touching[ids]
        )

    def tile(carry: tuple[Array, ...]) -> tuple[Array, ...]:
        turn, nearest, distance, own_free, offered, offered_distance, offered_clear = carry
        places = turn * TILE + jnp.arange(TILE)
        rows = jax.lax.dynamic_slice_in_dim(order, turn * TILE, TILE)
        rows = jnp.where(places < number, rows, count)  # Out of bounds: read as the last, dropped.
        ids = jnp.minimum(rows, count - 1)
        away = position[:, None, :] - position[:, ids, None]
        squared = dot(away, away)
        may_touch = jnp.ones((TILE, count), bool)
        may_touch = may_touch.at[jnp.arange(TILE)[:, None], settings.adjacent[ids]].set(False)
        may_touch &= (squared < search) & (rows < count)[:, None]
        clear = jnp.where(may_touch, squared, search)
        distances = by_side(ids[:, None], away, may_touch)
        best, least = distances.argmin(axis=2), distances.min(axis=2)
        best = jnp.where(jnp.isfinite(least), best, ids[None]).astype(nearest.dtype)
        own_free = own_free.at[rows].set(free(least, clear.min(axis=1), ids), mode="drop")
        nearest = nearest.at[:, rows].set(best, mode="drop")
        distance = distance.at[:, rows].set(jnp.minimum(least, reach[None, ids]), mode="drop")
        # The same pairs, seen from the others.
        distances = by_side(everyone[None], -away, may_touch)
        best, least = ids[distances.argmin(axis=1)].astype(offered.dtype), distances.min(axis=1)
        is_nearer = least < offered_distance
        offered = jnp.where(is_nearer, best, offered)
        offered_distance = jnp.where(is_nearer, least, offered_distance)
        offered_clear = jnp.minimum(offered_clear, clear.min(axis=0))
        return turn + 1, nearest, distance, own_free, offered, offered_distance, offered_clear

    nothing, far = jnp.zeros_like(position[0]), jnp.full_like(contacts.distance, jnp.inf)
    carry: tuple[Array, ...] = (
        *(jnp.zeros((), order.dtype), contacts.nearest, contacts.distance, nothing),
        *(contacts.nearest, far, nothing + search),
    )
    _, nearest, distance, own_free, offered, offered_distance, clear = jax.lax.while_loop(
        lambda carry: carry[0] * TILE < number, tile, carry
    )
    free_of = jnp.where(clear < search, free(offered_distance, clear, everyone), jnp.inf)
    return [nearest, distance, own_free, offered, offered_distance, free_of]


def list_pairs(best: Int[Array, "2 N"]) -> tuple[Int[Array, "2 N"], Int[Array, "C N"]]:
    """Fields `partner` and `listed_by` of `Contacts`, for the nearest particles on either side.

    Of two particles that are nearest to each other the lower id lists the pair.
    """
    count = best.shape[1]
    ids = jnp.arange(count, dtype=best.dtype)[None]
    is_mutual = (best[0][best] == ids) | (best[1][best] == ids)
    is_listed = (best != ids) & ~((best < ids) & is_mutual)
    is_listed = is_listed.at[1].set(is_listed[1] & (best[1] != best[0]))
    # In the order of particles, each one's slots together.
    target = jnp.where(is_listed, best, count).T.reshape(-1)
    order = jnp.argsort(target, stable=True).astype(best.dtype)
    target = target[order]
    first = jnp.searchsorted(target, jnp.arange(count + 1)).astype(best.dtype)
    rank = jnp.arange(2 * count, dtype=best.dtype) - first[target]
    rank = rank[jnp.argsort(order)].reshape(count, 2).T
    partner = jnp.where(is_listed & (rank < CAPACITY), best, ids)
    place = first[None, :-1] + jnp.arange(CAPACITY, dtype=best.dtype)[:, None]
    slot = order[jnp.minimum(place, 2 * count - 1)]
    slot = slot % 2 * count + slot // 2
    return partner, jnp.where(place < first[None, 1:], slot, 2 * count)
