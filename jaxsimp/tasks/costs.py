"""Costs that tasks share: distances that are differentiable everywhere.

A cost of positions ignores the action: it serves as the running and as the terminal cost of a task.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int

from jaxsimp.checks import require_count
from jaxsimp.dynamics import Actions, State
from jaxsimp.tasks.episode import Episode

RUNNING_WEIGHT = 0.3
"""Weight of the running costs of our tasks. With 1, the paper's sum, plans that take the way of
lowest cost win over those of the best end; with 0 nothing tells a search which first actions are
promising."""
MATCHED_PARTICLES = 11
"""Number of particles that `MatchingCost` compares; SoftGym chooses 10."""


def distance_cost(
    episode: Episode, state: State, action: Actions | None = None
) -> Float[Array, ""]:
    """Mean distance of the particles to their goals, metres."""
    return distance(state.position - jnp.asarray(episode.goal)).mean()


@dataclass(frozen=True)
class MatchingCost:
    """SoftGym's bipartite matching distance between 11 evenly spaced particles and their goals.

    The mean distance in the best assignment, metres.

    Attributes:
        num_particles: number of particles of the body, `N`.

    Raises:
        ValueError: if it is no whole number above zero.
    """

    num_particles: int

    def __post_init__(self) -> None:
        require_count("num_particles", self.num_particles, 1)

    def __call__(
        self, episode: Episode, state: State, action: Actions | None = None
    ) -> Float[Array, ""]:
        """The cost of a state, metres."""
        chosen = self.chosen
        return matching_distance(state.position[chosen], jnp.asarray(episode.goal)[chosen])

    @property
    def chosen(self) -> Int[np.ndarray, " M"]:
        """Ids of the compared particles."""
        evenly = np.linspace(0, self.num_particles - 1, MATCHED_PARTICLES)
        return np.unique(np.round(evenly).astype(int))


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
    apart = squared != 0  # NaN stays NaN
    return jnp.where(apart, jnp.sqrt(jnp.where(apart, squared, 1.0)), 0.0)
