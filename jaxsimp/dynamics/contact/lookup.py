"""Lookup of the pairs that may touch: the nearest particle on either side of each.

The definition, in JAX, for any device; cpu/lookup.py finds the same by cells. Distances to all
particles are compared in tiles, so that memory grows with the number of particles alone.
"""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jax.tree_util import PyTreeDef
from jaxtyping import Array, Bool, Float, Int

from jaxsimp.dynamics.contact.contacts import CAPACITY, Contacts
from jaxsimp.dynamics.contact.directions import across, directions, dot
from jaxsimp.dynamics.contact.settings import LEVEL, SelfContact, listing_distances

TILE = 64
"""Particles that are compared with all others at a time."""
GROUP = 32
"""Samples of a batch that are looked up at a time."""
LOOKED_UP = ("partner", "listed_by", "found_at", "allowance", "renewed")
"""Fields of `Contacts` that a lookup replaces."""


def renew(settings: SelfContact, contacts: Contacts, position: Float[Array, "3 N"]) -> Contacts:
    """Contacts that hold for the next time step: looked up again where a particle moved too far.

    Under `vmap` only those samples are looked up that need it. Directions alone have derivatives.
    """
    arguments = settings, contacts, position
    leaves, tree = jax.tree.flatten(jax.lax.stop_gradient(arguments))

    # Of leaves: JAX makes trees of things that are no arrays here.
    @jax.custom_batching.custom_vmap
    def one(leaves: list[Array]) -> list[Array]:
        is_due = _is_due(tree, leaves)
        found = jax.lax.cond(is_due, lambda: _look_up(tree, leaves), lambda: _kept(tree, leaves))
        return [*found[:-1], is_due]

    @one.def_vmap
    def several(size: int, batched: Any, leaves: list[Array]) -> tuple[list[Array], list[bool]]:
        (is_batched,) = batched
        if not any(is_batched):
            return one(leaves), [False] * len(LOOKED_UP)
        axes = [0 if each else None for each in is_batched]
        is_due = jax.vmap(lambda leaves: _is_due(tree, leaves), (axes,))(leaves)
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
        return [*found[:-1], is_due], [True] * len(LOOKED_UP)

    found = replace(contacts, **dict(zip(LOOKED_UP, one(leaves), strict=True)))
    anew = directions(settings, found, position, across(settings, position))
    return replace(found, direction=jnp.where(found.renewed, anew, contacts.direction))


def _is_due(tree: PyTreeDef, leaves: list[Array]) -> Bool[Array, ""]:
    """Whether a particle moved too far, in itself and relative to the others.

    A move that all have in common brings none nearer to another. Where some move and some lie
    still, half of it is common to all.
    """
    _, contacts, position = jax.tree.unflatten(tree, leaves)
    move = position - contacts.found_at
    common = (move.min(axis=1) + move.max(axis=1)) / 2
    limit = contacts.allowance * jnp.abs(contacts.allowance)

    def any_beyond(move: Float[Array, "3 N"]) -> Bool[Array, ""]:
        return (~(dot(move, move) <= limit)).any()

    return any_beyond(move) & any_beyond(move - common[:, None])


def _kept(tree: PyTreeDef, leaves: list[Array]) -> list[Array]:
    _, contacts, _ = jax.tree.unflatten(tree, leaves)
    return [getattr(contacts, name) for name in LOOKED_UP]


def _look_up(tree: PyTreeDef, leaves: list[Array]) -> list[Array]:
    """The fields `LOOKED_UP`."""
    settings, _, position = jax.tree.unflatten(tree, leaves)
    normal = across(settings, position)
    best, nearest, clear = _nearest(settings, position, normal)
    partner, listed_by = list_pairs(best)
    touching, _, _ = listing_distances(settings)
    stretch = jnp.sqrt(1 + settings.squash)
    # A particle beside another may come nearer by its whole distance, one above it by less.
    free = jnp.maximum(
        (jnp.sqrt(nearest.min(axis=0)) - touching) / stretch, jnp.sqrt(clear) - touching
    )
    allowance = jnp.maximum(settings.slack, 0.5 * free)
    return [partner, listed_by, position, allowance, jnp.ones((), bool)]


def _nearest(
    settings: SelfContact, position: Float[Array, "3 N"], normal: Float[Array, "3 N"]
) -> tuple[Int[Array, "2 N"], Float[Array, "2 N"], Float[Array, " N"]]:
    """Nearest particle above and below each; squared distances to it and to any other.

    Its own id, and the squared distance up to which pairs are listed, where there is none.
    """
    count, level = position.shape[1], LEVEL * settings.thickness
    _, reach, search = listing_distances(settings)
    reach, search = reach * reach, search * search
    # Around a rope there is room for more: its sides are above and below.
    up = normal if settings.is_sheet else jnp.zeros_like(normal).at[2].set(1.0)

    def tile(ids: Int[Array, " T"]) -> tuple[Array, Array, Array]:
        away = position[:, None, :] - position[:, ids, None]
        squared, height = dot(away, away), dot(up[:, ids, None], away)
        may_touch = jnp.ones(squared.shape, bool)
        may_touch = may_touch.at[jnp.arange(TILE)[:, None], settings.adjacent[ids]].set(False)
        may_touch &= squared < search
        clear = jnp.where(may_touch, squared, search).min(axis=1)
        stretched = squared + settings.squash[ids, None] * height * height
        is_near = may_touch & (stretched < reach[ids, None])
        on_side = jnp.stack([height >= -level, height <= level])
        distances = jnp.where(is_near[None] & on_side, stretched[None], reach[None, ids, None])
        best, nearest = distances.argmin(axis=2), distances.min(axis=2)
        return jnp.where(nearest < reach[None, ids], best, ids[None]), nearest, clear

    tiles = -(-count // TILE)
    ids = jnp.minimum(jnp.arange(tiles * TILE), count - 1).reshape(tiles, TILE)
    best, nearest, clear = jax.lax.map(tile, ids)
    best, nearest = (jnp.moveaxis(each, 0, 1).reshape(2, -1)[:, :count] for each in (best, nearest))
    return best.astype(jnp.int32), nearest, clear.reshape(-1)[:count]


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
