"""One pass over all contacts: impulses, friction, and pushes apart."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxsimp.dynamics.contact.contacts import PLAIN, Contacts, Exchange, listings
from jaxsimp.dynamics.contact.directions import dot
from jaxsimp.dynamics.contact.settings import LEVEL, SelfContact


def resolve(
    settings: SelfContact,
    contacts: Contacts,
    inverse_mass: Float[Array, " N"],
    floor: Float[Array, ""],
    seconds: Float[Array, ""],
    carried: Float[Array, " N"],
    position: Float[Array, "3 N"],
    velocity: Float[Array, "3 N"],
    *,
    exchange: Exchange = PLAIN,
) -> tuple[Float[Array, " N"], Float[Array, "3 N"], Float[Array, "3 N"], Bool[Array, "2 N"]]:
    """Carried particles, positions and velocities after one pass, and pairs past each other.

    Args:
        settings: how the body touches itself.
        contacts: pairs, with their directions.
        inverse_mass: 1 / kilograms, 0 for a particle that is held.
        floor: height below which no particle is pushed, metres.
        seconds: time until contact acts again.
        carried: 1 for a particle that lies on the table or on a carried particle.
        position: metres.
        velocity: metres per second.
        exchange: how values are handed to partners and back.
    """
    gather, collect = exchange
    ids, along = (contacts.partner, contacts.listed_by), contacts.direction
    numbers = jnp.stack([inverse_mass, carried, settings.lateral])
    rows = jnp.concatenate([position, velocity, numbers])
    theirs = gather(*ids, rows)
    away, speed = position[:, None] - theirs[:3], velocity[:, None] - theirs[3:6]
    distance, approach = dot(along, away), dot(along, speed)
    beside = dot(away, away) - distance * distance
    gap = distance - settings.thickness
    lacking = -jnp.maximum(gap, 0.0) / seconds - approach
    near = contacts.is_pair & (beside < jnp.maximum(settings.lateral[None], theirs[8]) ** 2)
    touches = near & ((gap < 0.0) | (lacking > 0.0))
    # A carried particle does not give way to what lies on it: the table would take the push.
    below, above = along[2] < -0.5, along[2] > 0.5
    mine = jnp.where(touches, 1.0 - below * carried[None], 0.0)
    yours = jnp.where(touches, 1.0 - above * theirs[7], 0.0)
    shares = mine.sum(axis=0) + collect(*ids, yours[None])[0]
    both = mine * (inverse_mass * shares)[None]
    both += yours * theirs[6] * gather(*ids, shares[None])[0]
    # Zero where neither can move, or nothing touches.
    per = jnp.where(both > 0.0, 1.0 / jnp.where(both > 0.0, both, 1.0), 0.0)
    impulse = per * jnp.maximum(lacking, 0.0)
    sliding = speed - approach[None] * along
    squared = jnp.maximum(dot(sliding, sliding), 1e-12)
    # Half the impulse that would stop a particle that another carries: both are slowed.
    rub = jnp.minimum(0.5 * per, settings.friction * impulse * jax.lax.rsqrt(squared))
    push = (per * jnp.clip(-gap, 0.0, settings.thickness))[None] * along
    change = impulse[None] * along - rub[None] * sliding
    own = jnp.concatenate([mine[None] * push, change])
    total = own.sum(axis=1) - collect(*ids, jnp.concatenate([yours[None] * push, change]))
    total = inverse_mass[None] * total
    height = position[2] + total[2]
    least = jnp.minimum(position[2], floor)
    pushed = (position + total[:3]).at[2].set(jnp.where(height >= least, height, least))
    # Whether a particle is carried is a constant to derivatives.
    lies = near & (gap < LEVEL * settings.thickness)
    on_theirs = jnp.where(lies & above, theirs[7], 0.0).max(axis=0)
    on_mine = jnp.where(lies & below, carried[None], 0.0)
    lying = jnp.maximum(on_theirs, listings(contacts.listed_by, on_mine[None])[0].max(axis=0))
    on_table = position[2] < floor + 0.1 * settings.thickness
    carried = jnp.where(on_table, 1.0, jax.lax.stop_gradient(lying))
    return carried, pushed, velocity + total[3:], near & (distance < 0.0)
