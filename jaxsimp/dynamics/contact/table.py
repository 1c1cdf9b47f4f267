"""Contact with the table, the half-space below z = 0."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def table_contact(
    height: Float[Array, "N *B"],
    velocity: list[Float[Array, "N *B"]],
    friction: Float[Array, ""],
    time_step: Float[Array, ""],
) -> list[Float[Array, "N *B"]]:
    """Velocities after contact: no particle sinks into the table, and Coulomb friction acts.

    The normal impulse is the one that leaves a particle on the table at the end of the step
    (inelastic). Friction takes at most `friction` times that impulse from the tangential
    velocity: all of it when the particle sticks, a part when it slides.

    Args:
        height: of the particles above their resting height, metres.
        velocity: along x, y and z, that they would have without contact, metres per second.
        friction: Coulomb coefficient.
        time_step: seconds.
    """
    x, y, z = velocity
    normal = jnp.maximum(z, -height * (1.0 / time_step))
    squared = x * x + y * y
    # The floor keeps the gradient finite at rest; 1e-6 m/s is below any sliding of interest.
    slowdown = friction * (normal - z) * jax.lax.rsqrt(jnp.maximum(squared, 1e-12))
    kept = jnp.maximum(0.0, 1.0 - slowdown)
    return [x * kept, y * kept, normal]
