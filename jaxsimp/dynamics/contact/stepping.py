"""Time steps of a body that touches itself: plain steps, and contact between them."""

from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsimp.dynamics.contact.layers import Contacts, find_contacts, touch
from jaxsimp.dynamics.simulation import Simulation, State
from jaxsimp.dynamics.step import Motion, Packed, pack, unpack

PASSES = 2
"""Over all contacts, in an interval: after one, layers pressed hard are up to a third too close."""
Advance = Callable[[Simulation, Packed, Motion, Float[Array, " S"]], Packed]
"""Time steps without self-contact, see adjoint.py."""
Moving = tuple[Packed, Contacts | None]
"""A state as the steps want it, and its contacts, None without self-contact."""


def begin(simulation: Simulation, state: State) -> Moving:
    """A state made ready to be stepped."""
    packed, settings = pack(simulation, state), simulation.self_contact
    if settings is None:
        return packed, None
    missed = jnp.zeros((), jnp.int32) if state.missed is None else state.missed
    return packed, find_contacts(settings, packed[0], missed)


def end(simulation: Simulation, moving: Moving) -> State:
    """The state, as users want it."""
    packed, contacts = moving
    state = unpack(simulation, packed)
    return state if contacts is None else replace(state, missed=contacts.missed)


def touching_steps(
    advance: Advance,
    simulation: Simulation,
    moving: Moving,
    motion: Motion,
    shares: Float[Array, " S"],
) -> Moving:
    """Time steps; with self-contact, in runs of `interval` or fewer with contact after each."""
    packed, _ = moving
    settings, plain = simulation.self_contact, replace(simulation, self_contact=None)
    if settings is None:
        return advance(simulation, packed, motion, shares), None

    def run(moving: Moving, shares: Float[Array, " S"]) -> tuple[Moving, None]:
        packed, contacts = moving
        return _touch(simulation, motion, advance(plain, packed, motion, shares), contacts), None

    whole = len(shares) // settings.interval
    runs, rest = jnp.split(shares, [whole * settings.interval])
    moving, _ = jax.lax.scan(run, moving, runs.reshape(whole, settings.interval))
    return run(moving, rest)[0] if len(rest) else moving


def _touch(
    simulation: Simulation, motion: Motion, packed: Packed, contacts: Contacts | None
) -> Moving:
    """Contact, and contacts that are good until it acts again."""
    settings = simulation.self_contact
    assert settings is not None
    assert contacts is not None
    seconds = settings.interval * simulation.time_step
    inverse_mass = jnp.where(motion.held, 0.0, 1.0 / simulation.mass)
    contacts, position, velocity = touch(
        settings, contacts, inverse_mass, simulation.radius, seconds, *packed, passes=PASSES
    )
    return (position, velocity), contacts
