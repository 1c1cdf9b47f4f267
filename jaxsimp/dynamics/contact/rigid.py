"""Contact with obstacles: impulses along their normals, and Coulomb friction."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsimp.dynamics.contact.obstacles import UP, Axes
from jaxsimp.dynamics.simulation import Simulation

Rows = list[Float[Array, "N *B"]]
"""Values of particles along x, y and z."""


def contact(simulation: Simulation, position: Rows, velocity: Rows) -> Rows:
    """Velocities after contact: no particle enters an obstacle, and Coulomb friction acts.

    The obstacles act one after another, in their order. The normal impulse is the one that leaves
    a particle at its radius from the plane at the nearest point of the surface at the end of the
    step (inelastic). Since obstacles are convex, the particle is then no closer to the obstacle
    itself, at any speed; two obstacles can press it a little into the one that acts first.
    Friction takes at most its coefficient times that impulse from the tangential velocity: all
    of it when the particle sticks, a part when it slides.

    Args:
        simulation: whose obstacles, radius, friction and time step count.
        position: of the particles, metres.
        velocity: that they would have without contact, metres per second.
    """
    for obstacle in simulation.obstacles:
        distance, normal = obstacle.distance(*position)
        approach, across = _split(normal, velocity)
        above = distance - simulation.radius
        along = jnp.maximum(approach, -above * (1.0 / simulation.time_step))
        squared = _squared(across)
        # The floor keeps the gradient finite at rest; 1e-6 m/s is below any sliding of interest.
        slowdown = simulation.friction * (along - approach)
        slowdown = slowdown * jax.lax.rsqrt(jnp.maximum(squared, 1e-12))
        kept = jnp.maximum(0.0, 1.0 - slowdown)
        velocity = _joined(normal, along, [each * kept for each in across])
    return velocity


def _split(normal: Axes, vector: Rows) -> tuple[Float[Array, "N *B"], Rows]:
    """The part of vectors along a normal, and the rest, without its zeros."""
    if normal is UP:
        return vector[2], vector[:2]
    along = normal[0] * vector[0] + normal[1] * vector[1] + normal[2] * vector[2]
    return along, [each - along * part for each, part in zip(vector, normal, strict=True)]


def _joined(normal: Axes, along: Float[Array, "N *B"], across: Rows) -> Rows:
    """Vectors of such parts."""
    if normal is UP:
        return [*across, along]
    return [each + along * part for each, part in zip(across, normal, strict=True)]


def _squared(parts: Rows) -> Float[Array, "N *B"]:
    """Squared lengths."""
    first, *others = (each * each for each in parts)
    for each in others:
        first = first + each
    return first
