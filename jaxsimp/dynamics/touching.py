"""Time steps of a body that touches itself: plain steps, and contact between them."""

from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsimp.dynamics.self_contact import Contacts, find_contacts, renew, resolve
from jaxsimp.dynamics.simulation import Simulation, State
from jaxsimp.dynamics.step import Motion, Packed, pack, unpack

PASSES = 2
"""Over all contacts, in an interval: after one, layers pressed hard are up to a third too close."""
Advance = Callable[[Simulation, Packed, Motion, Float[Array, " S"]], Packed]
"""Time steps without self-contact, see steps.py."""
Moving = tuple[Packed, Contacts | None]
"""A state as the steps want it, and its contacts, None without self-contact."""


def begin(simulation: Simulation, state: State) -> Moving:
    """A state made ready to be stepped."""
    settings, contacts = simulation.self_contact, None
    if settings is not None:
        missed = jnp.zeros((), dtype=int) if state.missed is None else state.missed
        contacts = find_contacts(
            settings, state.position.T, jnp.zeros_like(simulation.mass), missed
        )
    return pack(simulation, state), contacts


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
    halo, count = simulation.springs.halo, len(simulation.mass)
    position, velocity = (array[:, halo : halo + count] for array in packed)
    seconds = settings.interval * simulation.time_step
    inverse_mass = jnp.where(motion.held, 0.0, 1.0 / simulation.mass)
    for _ in range(PASSES):
        contacts, position, velocity = resolve(
            settings, contacts, inverse_mass, simulation.radius, seconds, position, velocity
        )
    contacts = renew(settings, contacts, position)
    padding = ((0, 0), (halo, halo))
    return (jnp.pad(position, padding), jnp.pad(velocity, padding)), contacts
