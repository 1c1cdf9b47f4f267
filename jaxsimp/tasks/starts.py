"""Starts and goals of episodes: always the same, turned at random, or crumpled.

A start is a function from a seed to an episode in NumPy. Its method `draw` is a function from a key
to an episode, in pure JAX.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from jaxsimp import goals
from jaxsimp.bodies import Body
from jaxsimp.checks import require_seed
from jaxsimp.tasks.crumpling import crumple, draw_crumpled
from jaxsimp.tasks.episode import Episode

LARGEST_ANGLE = np.pi / 4
"""Largest angle of `TurnedStart` either way, radians, as in SoftGym."""


@dataclass(frozen=True, eq=False)
class FixedStart:
    """The same episode for every seed.

    Attributes:
        episode: start and goal.
    """

    episode: Episode

    def __call__(self, seed: int) -> Episode:
        """The episode."""
        return self.episode

    def draw(self, key: PRNGKeyArray) -> Episode:
        """The episode as arrays of JAX, the same for every key."""
        return jax.tree.map(_as_float, self.episode)


@dataclass(frozen=True, eq=False)
class TurnedStart:
    """A start and its goal, both turned by the same random angle within 45 degrees.

    Attributes:
        body: the body.
        goal: goal before the turn, shape (N, 3), metres.
        start: start before the turn, shape (N, 3), metres; the flat body by default.
    """

    body: Body
    goal: goals.Positions
    start: goals.Positions | None = None

    def __call__(self, seed: int) -> Episode:
        """The episode of a seed."""
        angle = np.random.default_rng(require_seed(seed)).uniform(-LARGEST_ANGLE, LARGEST_ANGLE)
        return Episode(goals.turn(self._start, angle), goals.turn(self.goal, angle))

    def draw(self, key: PRNGKeyArray) -> Episode:
        """The episode of a key; keys and seeds give different angles."""
        angle = jax.random.uniform(key, minval=-LARGEST_ANGLE, maxval=LARGEST_ANGLE)
        start, goal = map(_as_float, (self._start, self.goal))
        return Episode(_turn(start, angle), _turn(goal, angle))

    @property
    def _start(self) -> goals.Positions:
        return goals.flat(self.body) if self.start is None else self.start


@dataclass(frozen=True, eq=False)
class CrumpledStart:
    """A body after four random picks (see `crumple`), and one goal.

    Attributes:
        body: the body; it starts straight or flat on the table.
        goal: goal positions, shape (N, 3), metres.
        place: x and y of the table that the picks begin around, metres.
    """

    body: Body
    goal: goals.Positions
    place: tuple[float, float] = (0.0, 0.0)

    def __call__(self, seed: int) -> Episode:
        """The episode of a seed; this runs a simulation."""
        return Episode(crumple(self.body, seed) + np.array([*self.place, 0.0]), self.goal)

    def draw(self, key: PRNGKeyArray) -> Episode:
        """The episode of a key, by a simulation; `jax.random.key(seed)` gives that of the seed."""
        return Episode(draw_crumpled(self.body, key), _as_float(self.goal))


def _turn(positions: Float[Array, "N 3"], angle: Float[Array, ""]) -> Float[Array, "N 3"]:
    """`goals.turn` in JAX, without the matrix product that some devices round coarsely."""
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    x, y, z = positions.T
    return jnp.stack([x * cos - y * sin, x * sin + y * cos, z], axis=1)


def _as_float(positions: goals.Positions) -> Float[Array, "N 3"]:
    return jnp.asarray(positions, dtype=float)
