"""Contacts of a body with itself: the pairs of particles that may touch, listed both ways.

Each particle lists at most one particle on either side of it. A pair that both would list is
listed once. `listed_by` has the same pairs by their second particle, so that sums over the
contacts of a particle are gathers of a fixed number, in a fixed order, on any device.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

CAPACITY = 8
"""Most particles that may list the same particle; further pairs are left out."""
Pairs = Float[Array, "2 N"]
"""A number for each pair, by side and particle."""


@partial(
    jax.tree_util.register_dataclass,
    data_fields=[
        "partner",
        "listed_by",
        "direction",
        "found_at",
        "allowance",
        "carried",
        "missed",
        "renewed",
    ],
    meta_fields=[],
)
@dataclass(frozen=True)
class Contacts:
    """Pairs of particles that may touch. Slot `k N + i` is the pair that particle `i` lists.

    Attributes:
        partner: id of the particle listed by each particle, above (`k = 0`) and below (`k = 1`),
            shape (2, N); its own id where it lists none.
        listed_by: slots that list each particle, shape (CAPACITY, N); 2 N after the last.
        direction: unit vector from the partner to the particle, shape (3, 2, N).
        found_at: positions at the last lookup, shape (3, N), metres.
        allowance: distance from there that each particle may move until the next lookup, shape
            (N,), metres.
        carried: 1 for a particle that lies on the table or on a carried particle, shape (N,).
        missed: number of contacts so far whose particles passed each other within a time step.
        renewed: whether the pairs were looked up in the last step.
    """

    partner: Int[Array, "... 2 N"]
    listed_by: Int[Array, "... C N"]
    direction: Float[Array, "... 3 2 N"]
    found_at: Float[Array, "... 3 N"]
    allowance: Float[Array, "... N"]
    carried: Float[Array, "... N"]
    missed: Float[Array, "..."]
    renewed: Bool[Array, "..."]

    @property
    def is_pair(self) -> Bool[Array, "2 N"]:
        """Slots that hold a pair."""
        return self.partner != jnp.arange(self.partner.shape[1])[None]


DIRECTION = list(Contacts.__dataclass_fields__).index("direction")
"""Place of the directions among the fields."""


def no_contacts(count: int, missed: Float[Array, ""]) -> Contacts:
    """Contacts of `count` particles that list no pair, and are due for a lookup."""
    real = missed.dtype
    return Contacts(
        partner=jnp.tile(jnp.arange(count, dtype=jnp.int32), (2, 1)),
        listed_by=jnp.full((CAPACITY, count), 2 * count, jnp.int32),
        direction=jnp.zeros((3, 2, count), real),
        found_at=jnp.zeros((3, count), real),
        allowance=jnp.full(count, -1.0, real),
        carried=jnp.zeros(count, real),
        missed=missed,
        renewed=jnp.zeros((), bool),
    )


def of_partners(
    partner: Int[Array, "2 N"], listed_by: Int[Array, "C N"], values: Float[Array, "K N"]
) -> Float[Array, "K 2 N"]:
    """Values of the partner in each slot; a particle's own in a slot without a pair."""
    return values.at[:, partner].get(mode="promise_in_bounds")


def over_listings(
    partner: Int[Array, "2 N"], listed_by: Int[Array, "C N"], values: Float[Array, "K 2 N"]
) -> Float[Array, "K N"]:
    """Sum of the values of the slots that list each particle."""
    return listings(listed_by, values).sum(axis=1)


def listings(listed_by: Int[Array, "C N"], values: Float[Array, "K 2 N"]) -> Float[Array, "K C N"]:
    """Values of the slots that list each particle; zero after the last."""
    flat = jnp.pad(values.reshape(len(values), -1), ((0, 0), (0, 1)))
    return flat.at[:, listed_by].get(mode="promise_in_bounds")


Exchange = tuple[Callable[..., Array], Callable[..., Array]]
"""`of_partners` and `over_listings`, or functions of the same values."""
PLAIN: Exchange = of_partners, over_listings
"""Differentiable by JAX in either mode. In reverse, gathers become scatters, whose order is not
fixed on a GPU."""


Ids = tuple[Array, Array]


def _keep_ids(partner: Array, listed_by: Array, values: Array) -> tuple[Array, Ids]:
    return of_partners(partner, listed_by, values), (partner, listed_by)


def _of_partners_bar(ids: Ids, bar: Array) -> tuple[None, None, Array]:
    """Slots without a pair hold the particle's own values."""
    is_pair = ids[0] != jnp.arange(ids[0].shape[1])[None]
    own = jnp.where(is_pair[None], 0.0, bar).sum(axis=1)
    return None, None, own + over_listings(ids[0], ids[1], bar)


def _keep_ids_too(partner: Array, listed_by: Array, values: Array) -> tuple[Array, Ids]:
    return over_listings(partner, listed_by, values), (partner, listed_by)


def _over_listings_bar(ids: Ids, bar: Array) -> tuple[None, None, Array]:
    is_pair = ids[0] != jnp.arange(ids[0].shape[1])[None]
    return None, None, jnp.where(is_pair[None], of_partners(ids[0], ids[1], bar), 0.0)


_of_partners, _over_listings = jax.custom_vjp(of_partners), jax.custom_vjp(over_listings)
_of_partners.defvjp(_keep_ids, _of_partners_bar)
_over_listings.defvjp(_keep_ids_too, _over_listings_bar)
REVERSIBLE: Exchange = _of_partners, _over_listings
"""Differentiable in reverse mode alone, by gathers of a fixed number in a fixed order."""
