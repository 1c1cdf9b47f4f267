"""Folds of a cloth that lies folded already: the reflective and the underneath fold.

A cloth has four strips of equal width, a, b, c and d, along x. Folded in half, a lies on d and b on
c. The *reflective* fold turns a back onto b. From there the *underneath* fold turns a and b over to
the other side: a then lies on the table, under b.

After S. Yin et al., "Goal-conditioned action space reduction for deformable object manipulation",
ICRA 2023, and the author's code.
"""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxsimp import goals
from jaxsimp.bodies import Body, cloth
from jaxsimp.dynamics import Actions, State
from jaxsimp.tasks.cloth import STILL_WEIGHT, turned_task
from jaxsimp.tasks.costs import distance
from jaxsimp.tasks.episode import Episode
from jaxsimp.tasks.registry import register
from jaxsimp.tasks.task import Task

ALONG_Y = np.array([0.0, 1.0])


@dataclass(frozen=True, eq=False)
class StripsCost:
    """Mean distances of strips that should lie on each other, and 1.2 times those of others.

    The author's costs: `mean |a_i - b_i| + mean |b_i - c_i|` or `mean |a_i - b_i|`; plus 1.2 times
    the mean distance of still particles to their start, and of a strip to its goal, metres.

    Attributes:
        pairs: ids of particles that should meet, two rows each, shape (2, M).
        still: ids of particles that should not move, shape (S,).
        placed: ids of particles that have a place, shape (P,).
    """

    pairs: tuple[Int[np.ndarray, "2 _"], ...]
    still: Int[np.ndarray, " S"]
    placed: Int[np.ndarray, " P"]

    def __call__(
        self, episode: Episode, state: State, action: Actions | None = None
    ) -> Float[Array, ""]:
        """The cost of a state, metres."""
        position = state.position
        total = sum(distance(position[one] - position[other]).mean() for one, other in self.pairs)
        for ids, places in ((self.still, episode.start), (self.placed, episode.goal)):
            if len(ids):
                off = distance(position[ids] - jnp.asarray(places)[ids]).mean()
                total = total + STILL_WEIGHT * off
        return jnp.asarray(total)


@dataclass(frozen=True, eq=False)
class _Strips:
    """A cloth, ids of the strips, each particle beside its mirror images, and what is still."""

    body: Body
    a: Int[np.ndarray, " M"]
    b: Int[np.ndarray, " M"]
    c: Int[np.ndarray, " M"]
    still: Int[np.ndarray, " S"]


@register(full=25, quick=9, group="folded")
def cloth_reflective_folding(resolution: int) -> Task:
    """Turn the outer half of the upper layer back, of a cloth that lies folded in half."""
    strips = _strips(resolution)
    half, back = _states(strips)
    pairs = np.stack([strips.a, strips.b]), np.stack([strips.b, strips.c])
    cost = StripsCost(pairs, strips.still, np.zeros(0, int))
    return turned_task(strips.body, back, cost, num_actions=2, start=half)


@register(full=25, quick=9, group="folded")
def cloth_underneath_folding(resolution: int) -> Task:
    """Turn the two upper layers of a cloth in three over, so that one lies underneath."""
    strips = _strips(resolution)
    _, back = _states(strips)
    upper = np.ones(strips.body.num_particles, bool)
    upper[strips.still] = False
    under = goals.fold(strips.body, back, np.zeros(2), -ALONG_Y, part=upper)
    pairs = (np.stack([strips.a, strips.b]),)
    cost = StripsCost(pairs, strips.still, strips.a)
    return turned_task(strips.body, under, cost, num_actions=2, start=back)


def _strips(resolution: int) -> _Strips:
    ids = np.arange(resolution**2).reshape(resolution, resolution)
    last = resolution - 1
    rows = np.arange(last // 4 + 1)
    mirrored = last // 2 - rows
    return _Strips(
        body=cloth((resolution, resolution)),
        a=ids[rows].ravel(),
        b=ids[mirrored].ravel(),
        c=ids[last - mirrored].ravel(),
        still=ids[-(-last // 2) :].ravel(),
    )


def _states(strips: _Strips) -> tuple[goals.Positions, goals.Positions]:
    """The cloth folded in half, and with the outer half of the upper layer turned back."""
    body = strips.body
    half = goals.fold(body, goals.flat(body), np.zeros(2), ALONG_Y)
    outer = np.zeros(body.num_particles, bool)
    outer[strips.a] = True
    quarter = np.array([body.size / 4, 0.0])
    return half, goals.fold(body, half, quarter, -ALONG_Y, part=outer)
