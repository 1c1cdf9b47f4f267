"""Self-contact: layers of a body rest on each other, and rub.

A particle of a sheet stands for a disc in the sheet's plane, one of a rope for a piece of its
line. It touches the nearest on either side that is not its neighbour in the body, and those whose
nearest it is; each such pair is listed once. A contact keeps the direction that it was found with,
from one particle to the other and square to both sheets or lines, until all are looked up again:
when one has moved farther than its distance to the particles that it does not touch allows.

Contact acts after every time step on velocities, as impulses that are inelastic and look ahead (no
particle approaches faster than would close the gap within a step), with Coulomb friction, and on
positions, where particles are closer than the thickness. Particles in several contacts split
their mass among them (mass splitting: Tonge, Benevolenski and Voroshilov, "Mass Splitting for
Jitter-Free Parallel Rigid Body Simulation", 2012), so that one parallel pass does not overshoot.

The definition is in JAX, for any device: lookup.py, directions.py, impulses.py. On a CPU the same
is computed by the kernels of cpu/, compiled by numba, several times as fast.
"""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
from jax.tree_util import PyTreeDef
from jaxtyping import Array, Float

from jaxsimp.dynamics.contact.contacts import REVERSIBLE, Contacts, no_contacts
from jaxsimp.dynamics.contact.cpu import compiled
from jaxsimp.dynamics.contact.directions import across, directions
from jaxsimp.dynamics.contact.impulses import resolve
from jaxsimp.dynamics.contact.lookup import renew
from jaxsimp.dynamics.contact.settings import SelfContact

PASSES = 2
"""Passes over all contacts in a time step: after one, layers pressed hard are up to a third too
close."""
Padded = Float[Array, "3 NHH"]
"""A vector for each particle, with the halo of springs.py on either side."""
Touched = tuple[Padded, Padded, Contacts]
"""Positions, velocities, and contacts."""


def find_contacts(settings: SelfContact, position: Padded, missed: Float[Array, ""]) -> Contacts:
    """Look up the pairs that may touch, with so many contacts missed before."""
    count, real = settings.frame.shape[1], position.dtype
    nothing, zero = jnp.zeros(count, real), jnp.zeros((), real)
    still, missed = jnp.zeros_like(position), missed.astype(real)
    arguments = settings, no_contacts(count, zero), nothing, zero, zero, position, still
    # The kernel has no derivatives; the pairs have none anyway.
    _, _, found = touch(*jax.lax.stop_gradient(arguments), passes=0)
    (here,) = _without_halo(found, position)
    direction = directions(settings, found, here, across(settings, here))
    return replace(found, direction=direction, missed=missed)


def touch(
    settings: SelfContact,
    contacts: Contacts,
    inverse_mass: Float[Array, " N"],
    floor: Float[Array, ""],
    seconds: Float[Array, ""],
    position: Padded,
    velocity: Padded,
    *,
    passes: int = PASSES,
    use_kernel: bool = True,
) -> Touched:
    """Positions and velocities after contact, and contacts that hold until it acts again.

    Args:
        settings: how the body touches itself.
        contacts: pairs of the last lookup.
        inverse_mass: 1 / kilograms, 0 for a particle that is held.
        floor: height below which no particle is pushed, metres.
        seconds: time until contact acts again.
        position: metres.
        velocity: metres per second.
        passes: number of passes over all contacts.
        use_kernel: whether a CPU runs the compiled kernel, which JAX cannot differentiate (its
            adjoint is `touch_vjp`). The definition is differentiable in any mode and order.
    """
    arguments = (settings, contacts, inverse_mass, floor, seconds, position, velocity)
    leaves, tree = jax.tree.flatten(arguments)
    has_kernel = use_kernel and compiled.has_kernel("touch", str(position.dtype))
    position, velocity, *fields = _touch(tree, passes, has_kernel, leaves)
    return position, velocity, Contacts(*fields)


# Of leaves: JAX makes trees of things that are no arrays here.
@partial(jax.jit, static_argnums=(0, 1, 2))
def _touch(tree: PyTreeDef, passes: int, has_kernel: bool, leaves: list[Array]) -> list[Array]:
    """Position, velocity and fields of the contacts."""
    define = partial(_defined, tree, passes)
    if not has_kernel:
        return define(leaves)
    kernel = partial(compiled.touch, tree, passes)
    return jax.lax.platform_dependent(leaves, cpu=kernel, default=define)


def _defined(tree: PyTreeDef, passes: int, leaves: list[Array]) -> list[Array]:
    """`_touch`, as it is defined."""
    settings, contacts, mass, floor, seconds, *moving = jax.tree.unflatten(tree, leaves)
    position, velocity = _without_halo(contacts, *moving)
    carried, missed = contacts.carried, contacts.missed
    for turn in range(passes):
        carried, position, velocity, past = resolve(
            settings, contacts, mass, floor, seconds, carried, position, velocity
        )
        missed = missed + past.sum() if turn == 0 else missed
    contacts = replace(contacts, carried=carried, missed=missed)
    contacts = renew(settings, contacts, position)
    halo = (moving[0].shape[1] - position.shape[1]) // 2
    return [*_pad(halo, position, velocity), *jax.tree.leaves(contacts)]


Bars = tuple[Float[Array, "3 N"], Float[Array, "3 N"], Float[Array, "3 2 N"]]
"""Cotangents of positions, velocities and directions."""
PARAMETERS = ("inverse_mass", "thickness", "friction", "floor", "seconds")
"""Names of the parameters that have a cotangent."""


def touch_vjp(
    settings: SelfContact,
    before: Contacts,
    after: Contacts,
    inverse_mass: Float[Array, " N"],
    floor: Float[Array, ""],
    seconds: Float[Array, ""],
    position: Padded,
    velocity: Padded,
    touched: Padded,
    bars: Bars,
) -> tuple[Bars, dict[str, Array]]:
    """Cotangents of what goes into `touch`, for those of its result; also of its `PARAMETERS`.

    Args:
        settings: how the body touches itself.
        before: contacts before.
        after: contacts after.
        inverse_mass: 1 / kilograms, 0 for a particle that is held.
        floor: height below which no particle is pushed, metres.
        seconds: time until contact acts again.
        position: positions before, metres.
        velocity: velocities before, metres per second.
        touched: positions after, metres.
        bars: cotangents of positions, velocities and directions after, without halo.
    """
    position_bar, velocity_bar, direction_bar = bars
    nothing = jnp.zeros_like(position_bar)
    looked_up = partial(_directions_bar, settings, after, touched, direction_bar)
    position_bar += jax.lax.cond(after.renewed.any(), looked_up, lambda: nothing)
    direction_bar = jnp.where(after.renewed[None], 0.0, direction_bar)
    arguments = settings, before, inverse_mass, floor, seconds, position, velocity
    leaves, tree = jax.tree.flatten((*arguments, position_bar, velocity_bar))
    if compiled.has_kernel("touch_vjp", str(position.dtype)):
        kernel = partial(compiled.touch_vjp, tree, PASSES)
        found = jax.lax.platform_dependent(leaves, cpu=kernel, default=partial(_passes_vjp, tree))
    else:
        found = _passes_vjp(tree, leaves)
    position_bar, velocity_bar, more_bar, *parameters_bar = found
    bars = position_bar, velocity_bar, direction_bar + more_bar
    return bars, dict(zip(PARAMETERS, parameters_bar, strict=True))


def _directions_bar(
    settings: SelfContact, after: Contacts, touched: Padded, direction_bar: Float[Array, "3 2 N"]
) -> Float[Array, "3 N"]:
    """Cotangent of the positions at which directions were found."""
    (position,) = _without_halo(after, touched)
    direction_bar = jnp.where(after.renewed[None], direction_bar, 0.0)

    def found(position: Float[Array, "3 N"]) -> Float[Array, "3 2 N"]:
        normal = across(settings, position, reversible=True)
        return directions(settings, after, position, normal, REVERSIBLE)

    return jax.vjp(found, position)[1](direction_bar)[0]


def _passes_vjp(tree: PyTreeDef, leaves: list[Array]) -> list[Array]:
    """Cotangents of positions, velocities, directions and `PARAMETERS`, through all passes."""
    settings, before, *around, position_bar, velocity_bar = jax.tree.unflatten(tree, leaves)
    inverse_mass, floor, seconds, position, velocity = around
    position, velocity = _without_halo(before, position, velocity)

    def passes(*moving: Array) -> tuple[Array, Array]:
        position, velocity, direction, mass, thickness, friction, floor, seconds = moving
        changed = replace(settings, thickness=thickness, friction=friction)
        contacts, carried = replace(before, direction=direction), before.carried
        for _ in range(PASSES):
            carried, position, velocity, _ = resolve(
                *(changed, contacts, mass, floor, seconds, carried, position, velocity),
                exchange=REVERSIBLE,
            )
        return position, velocity

    numbers = settings.thickness, settings.friction, floor, seconds
    moving = position, velocity, before.direction, inverse_mass, *numbers
    return list(jax.vjp(passes, *moving)[1]((position_bar, velocity_bar)))


def _without_halo(contacts: Contacts, *arrays: Padded) -> list[Float[Array, "3 N"]]:
    count = contacts.partner.shape[1]
    halo = (arrays[0].shape[1] - count) // 2
    return [array[:, halo : halo + count] for array in arrays]


def _pad(halo: int, *arrays: Float[Array, "3 N"]) -> list[Padded]:
    return [jnp.pad(array, ((0, 0), (halo, halo))) for array in arrays]
