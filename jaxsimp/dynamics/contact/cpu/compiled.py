"""The compiled kernels as functions of JAX, on the CPU."""

import warnings
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import jaxlib.version
from jax.tree_util import PyTreeDef
from jaxtyping import Array, Float

from jaxsimp.dynamics.contact.settings import LEVEL, SelfContact, listing_distances


@cache
def has_kernel(name: str, dtype: str) -> bool:
    """Whether this XLA calls a kernel, by its name in kernels.py and the type of its numbers.

    A kernel is compiled, or loaded, when it is first asked for. If XLA does not support the
    interface, or numba does not work here, a warning says so once: the definition in JAX gives the
    same, slower.
    """
    try:
        from jaxsimp.dynamics.contact.cpu import kernels  # numba takes a while to import

        kernels.register_kernel(name, dtype)
    except Exception as error:  # whatever the reason: it is told, and there is another way
        _warn_once(str(error))
        return False
    return True


_told: list[str] = []
"""The reason that was told: one warning is enough for all kernels."""


def _warn_once(reason: str) -> None:
    if _told:
        return
    _told.append(reason)
    warnings.warn(
        f"self-contact runs without its compiled kernel, many times slower on a CPU: it does not "
        f"work with this jaxlib ({jaxlib.version.__version__}) and numba ({reason})",
        stacklevel=2,
    )


def touch(tree: PyTreeDef, passes: int, leaves: list[Array]) -> list[Array]:
    """Position, velocity and fields of the contacts, as `layers.touch` defines them."""
    settings, contacts, inverse_mass, floor, seconds, position, velocity = jax.tree.unflatten(
        tree, leaves
    )
    real = position.dtype
    changing = [position, velocity, *jax.tree.leaves(contacts)]
    call = jax.ffi.ffi_call(
        f"jaxsimp_touch_{real}",
        [jax.ShapeDtypeStruct(each.shape, each.dtype) for each in changing],
        vmap_method="sequential",
        # All but positions and velocities: made to share those, XLA copies more, not less.
        input_output_aliases={place: place for place in range(2, len(changing))},
    )
    constant = (
        inverse_mass,
        _numbers(settings, floor, seconds, real),
        _sizes(settings, real),
        settings.frame.astype(jnp.int32),
        settings.adjacent.astype(jnp.int32),
        jnp.asarray(settings.is_sheet),
        jnp.asarray(passes, jnp.int32),
    )
    return list(call(*changing, *constant))


def touch_vjp(tree: PyTreeDef, passes: int, leaves: list[Array]) -> list[Array]:
    """Cotangents as in `layers.touch_vjp`, without those through directions."""
    settings, before, inverse_mass, floor, seconds, position, velocity, *bars = jax.tree.unflatten(
        tree, leaves
    )
    real, count = position.dtype, len(inverse_mass)
    shapes = ((3, count), (3, count), (3, 2, count), (count,), (4,))
    call = jax.ffi.ffi_call(
        f"jaxsimp_touch_vjp_{real}",
        [jax.ShapeDtypeStruct(shape, real) for shape in shapes],
        vmap_method="sequential",
    )
    numbers = _numbers(settings, floor, seconds, real)
    fields = before.partner, before.direction, before.carried
    constant = inverse_mass, settings.lateral.astype(real), numbers
    found = call(position, velocity, *fields, *constant, *bars, jnp.asarray(passes, jnp.int32))
    position_bar, velocity_bar, direction_bar, mass_bar, numbers_bar = found
    return [position_bar, velocity_bar, direction_bar, mass_bar, *numbers_bar]


def _numbers(
    settings: SelfContact, floor: Float[Array, ""], seconds: Float[Array, ""], real: Any
) -> Float[Array, " 6"]:
    """Numbers in the order in which the kernels read them."""
    _, _, search = listing_distances(settings)
    level = LEVEL * settings.thickness
    numbers = [settings.thickness, settings.friction, floor, seconds, level, search]
    return jnp.stack([jnp.asarray(each, real) for each in numbers])


def _sizes(settings: SelfContact, real: Any) -> Float[Array, "5 N"]:
    """Numbers of each particle, in the order in which the kernels read them."""
    touching, reach, _ = listing_distances(settings)
    sizes = settings.lateral, settings.slack, settings.squash, touching, reach
    return jnp.stack(sizes).astype(real)
