"""One time step of a body that may touch itself."""

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsimp.dynamics.contact.contacts import Contacts
from jaxsimp.dynamics.contact.layers import find_contacts, touch, touch_vjp
from jaxsimp.dynamics.simulation import Simulation, State
from jaxsimp.dynamics.step import Axes, Motion, Packed, pack, step_and_free, unpack

Moving = tuple[Packed, Contacts | None]
"""A state as the steps want it, and its contacts, None without self-contact."""


def begin(simulation: Simulation, state: State) -> Moving:
    """A state made ready to be stepped."""
    packed, settings = pack(simulation, state), simulation.self_contact
    return packed, None if settings is None else find_contacts(settings, packed[0], state.missed)


def end(simulation: Simulation, moving: Moving) -> State:
    """The state, as users want it."""
    packed, contacts = moving
    state = unpack(simulation, packed)
    return state if contacts is None else replace(state, missed=contacts.missed)


def advance(
    simulation: Simulation,
    moving: Moving,
    motion: Motion,
    share: Float[Array, ""],
    *,
    use_kernel: bool = True,
) -> Moving:
    """One time step: springs, obstacles and pickers, then self-contact; see `touch`."""
    packed, contacts = moving
    plain = replace(simulation, self_contact=None)
    packed, _ = step_and_free(plain, packed, motion, share)
    if contacts is None:
        return packed, None
    return touch_step(simulation, packed, motion, contacts, use_kernel=use_kernel)[0]


class Touch(NamedTuple):
    """Self-contact in one time step, as its adjoint needs it.

    Attributes:
        moved: state before it.
        before: fields of the contacts before it.
        touched: positions after it.
        after: fields of the contacts after it.
    """

    moved: Packed
    before: list[Any]
    touched: Float[Array, "3 NHH"]
    after: list[Any]


def touch_step(
    simulation: Simulation,
    packed: Packed,
    motion: Motion,
    contacts: Contacts,
    *,
    use_kernel: bool = True,
) -> tuple[Moving, Touch]:
    """Self-contact after a time step, and what its adjoint needs."""
    settings = simulation.self_contact
    assert settings is not None
    around = _around(simulation, motion)
    position, velocity, after = touch(settings, contacts, *around, *packed, use_kernel=use_kernel)
    fields = jax.tree.leaves(contacts), jax.tree.leaves(after)
    return ((position, velocity), after), Touch(packed, fields[0], position, fields[1])


def touch_step_vjp(
    simulation: Simulation,
    motion: Motion,
    touch: Touch,
    packed_bar: tuple[Axes, Axes],
    direction_bar: Float[Array, "3 2 N"],
) -> tuple[tuple[Axes, Axes], Float[Array, "3 2 N"], dict[str, Array]]:
    """Cotangents of the state and directions before `touch_step`, and of `PARAMETERS`."""
    settings = simulation.self_contact
    assert settings is not None
    position_bar, velocity_bar = (jnp.stack(bar) for bar in packed_bar)
    contacts = Contacts(*touch.before), Contacts(*touch.after)
    around = _around(simulation, motion)
    bars = position_bar, velocity_bar, direction_bar
    bars, parameters_bar = touch_vjp(
        settings, *contacts, *around, *touch.moved, touch.touched, bars
    )
    position_bar, velocity_bar, direction_bar = bars
    return (list(position_bar), list(velocity_bar)), direction_bar, parameters_bar


def _around(simulation: Simulation, motion: Motion) -> tuple[Array, Array, Array]:
    """Inverse masses, zero for particles that are held, the floor, and the time step.

    Layers pushed into an obstacle other than the table are pushed out by it in the next step.
    """
    inverse_mass = jnp.where(motion.held, 0.0, 1.0 / simulation.mass)
    return inverse_mass, simulation.floor, simulation.time_step
