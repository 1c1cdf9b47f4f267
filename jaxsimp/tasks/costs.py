"""Costs that tasks share: distances that are differentiable everywhere."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from jaxsimp.tasks.task import CostFn, Episode


def matching_cost(num_particles: int) -> CostFn:
    """SoftGym's bipartite matching distance between 11 particles, evenly chosen, and their goals.

    The mean distance in the best assignment, metres. SoftGym chooses 10.

    Args:
        num_particles: of the body.
    """
    chosen = np.unique(np.round(np.linspace(0, num_particles - 1, 11)).astype(int))

    def cost(episode: Episode, position: Float[Array, "N 3"]) -> Float[Array, ""]:
        return matching_distance(position[chosen], jnp.asarray(episode.goal)[chosen])

    return cost


def distance_cost(episode: Episode, position: Float[Array, "N 3"]) -> Float[Array, ""]:
    """Mean distance of the particles to their goals, metres."""
    return distance(position - jnp.asarray(episode.goal)).mean()


def matching_distance(
    points: Float[Array, "M 3"], targets: Float[Array, "M 3"]
) -> Float[Array, ""]:
    """Mean distance, metres, between points and targets in the best one-to-one assignment."""
    distances = distance(points[:, None] - targets[None, :])
    rows, columns = optax.assignment.hungarian_algorithm(jax.lax.stop_gradient(distances))
    return distances[rows, columns].mean()


def distance(difference: Float[Array, "*M 3"]) -> Float[Array, "*M"]:
    """Euclidean length, with a finite gradient where it is zero."""
    squared = jnp.sum(jnp.square(difference), axis=-1)
    apart = squared != 0  # a distance that is not a number stays none
    return jnp.where(apart, jnp.sqrt(jnp.where(apart, squared, 1.0)), 0.0)
