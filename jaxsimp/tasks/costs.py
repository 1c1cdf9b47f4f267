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


def shape_cost(episode: Episode, state: State, action: Actions | None = None) -> Float[Array, ""]:
    """Mean distance to the goals, metres, wherever the goal lies: up to turns and shifts.

    The state is turned about the vertical and shifted along x and y so that the sum of the squared
    distances, seen from above, is least (B. Horn, "Closed-form solution of absolute orientation",
    1987, in two dimensions).
    """
    level = jnp.array([1.0, 1.0, 0.0])
    own, wanted = (
        points - (level * points.mean(axis=0))[None]
        for points in (state.position, jnp.asarray(episode.goal))
    )
    along = jnp.sum(own[:, :2] * wanted[:, :2])
    across = jnp.sum(own[:, 0] * wanted[:, 1] - own[:, 1] * wanted[:, 0])
    squared = along**2 + across**2
    known = squared > 0  # else no turn is better than another
    length = jnp.sqrt(jnp.where(known, squared, 1.0))
    cos, sin = jnp.where(known, along / length, 1.0), jnp.where(known, across / length, 0.0)
    x, y, z = own.T
    turned = jnp.stack([x * cos - y * sin, x * sin + y * cos, z], axis=1)
    return distance(turned - wanted).mean()


def either_end_cost(
    episode: Episode, state: State, action: Actions | None = None
) -> Float[Array, ""]:
    """Mean distance to the goals of a rope whose ends are alike, metres: from the better end."""
    goal = jnp.asarray(episode.goal)
    ways = jnp.stack([goal, goal[::-1]])
    return distance(state.position[None] - ways).mean(axis=1).min()


def chamfer_cost(episode: Episode, state: State, action: Actions | None = None) -> Float[Array, ""]:
    """Chamfer distance, metres: from each particle to the nearest goal position, and back.

    The mean of both means. It ignores which particle lies where; layers of a fold may lie in any
    order, and so may corners.
    """
    apart = distance(state.position[:, None] - jnp.asarray(episode.goal)[None])
    return (apart.min(axis=0).mean() + apart.min(axis=1).mean()) / 2


def daxbench_cost(
    episode: Episode, state: State, action: Actions | None = None
) -> Float[Array, ""]:
    """1 minus DaXBench's reward, `exp(-10 chamfer)`, with the chamfer distance in metres.

    S. Chen et al., "DaXBench: benchmarking deformable object manipulation with differentiable
    physics", ICLR 2023.
    """
    return -jnp.expm1(-10.0 * chamfer_cost(episode, state))


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


COSTS = {
    "particles": distance_cost,
    "shape": shape_cost,
    "either_end": either_end_cost,
    "chamfer": chamfer_cost,
    "daxbench": daxbench_cost,
}
"""Costs of a state by name, for `reach`: 0 at the goal. SoftGym's normalised performance is the
score of the first, `(c_0 - c) / c_0`, see `score`."""
