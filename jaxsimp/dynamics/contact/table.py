"""Contact with the table, the half-space below z = 0."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsimp.dynamics.simulation import Simulation


def table_contact(
    simulation: Simulation,
    height: Float[Array, "N *B"],
    velocity: list[Float[Array, "N *B"]],
) -> list[Float[Array, "N *B"]]:
    """Velocities after contact: no particle sinks into the table, and Coulomb friction acts.

    The normal impulse is the one that leaves a particle on the table at the end of the step
    (inelastic). Friction takes at most its coefficient times that impulse from the tangential
    velocity: all of it when the particle sticks, a part when it slides.

    Args:
        simulation: whose radius, friction and time step count.
        height: z of the particles, metres.
        velocity: along x, y and z, that they would have without contact, metres per second.
    """
    x, y, z = velocity
    above = height - simulation.radius
    normal = jnp.maximum(z, -above * (1.0 / simulation.time_step))
    squared = x * x + y * y
    # The floor keeps the gradient finite at rest; 1e-6 m/s is below any sliding of interest.
    slowdown = simulation.friction * (normal - z) * jax.lax.rsqrt(jnp.maximum(squared, 1e-12))
    kept = jnp.maximum(0.0, 1.0 - slowdown)
    return [x * kept, y * kept, normal]
