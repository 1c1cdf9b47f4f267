"""Starts and goals of episodes: always the same, turned at random, or crumpled."""

from dataclasses import dataclass

import numpy as np

from jaxsimp import goals
from jaxsimp.bodies import Body
from jaxsimp.tasks.crumple import crumple
from jaxsimp.tasks.episode import Episode

LARGEST_ANGLE = np.pi / 4
"""Largest angle, radians, by which `TurnedStart` turns a body either way, as in SoftGym."""


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


@dataclass(frozen=True, eq=False)
class TurnedStart:
    """A flat body and its goal, both turned by the same random angle within 45 degrees.

    Attributes:
        body: the body.
        goal: goal of the body that is not turned, shape (N, 3), metres.
    """

    body: Body
    goal: goals.Positions

    def __call__(self, seed: int) -> Episode:
        """The episode of a seed."""
        angle = np.random.default_rng(seed).uniform(-LARGEST_ANGLE, LARGEST_ANGLE)
        return Episode(goals.flat(self.body, angle), goals.turn(self.goal, angle))


@dataclass(frozen=True, eq=False)
class CrumpledStart:
    """A body after four random picks (see `crumple`), and one goal.

    Attributes:
        body: starts straight or flat on the table.
        goal: shape (N, 3), metres.
    """

    body: Body
    goal: goals.Positions

    def __call__(self, seed: int) -> Episode:
        """The episode of a seed; it takes a simulation."""
        return Episode(crumple(self.body, seed), self.goal)
