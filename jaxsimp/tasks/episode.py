"""Episodes, and the types of a task's functions of an episode."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from jaxsimp.dynamics import Actions, State
from jaxsimp.dynamics.arrays import require_known, require_positions


@partial(jax.tree_util.register_dataclass, data_fields=["start", "goal"], meta_fields=[])
@dataclass(frozen=True)
class Episode:
    """Start and goal of one run.

    Attributes:
        start: positions at the start, shape (N, 3), metres; a batch has leading axes.
        goal: goal positions, of the same shape, metres.
    """

    start: Float[Array | np.ndarray, "... N 3"]
    goal: Float[Array | np.ndarray, "... N 3"]


def require_episode(episode: Any, num_particles: int) -> Episode:
    """An episode of a body as arrays, checked; under `jit` and `vmap` its shapes and types alone.

    Raises:
        ValueError: if it is no `Episode`, or its start or goal are not finite positions of
            `num_particles` particles.
    """
    if not isinstance(episode, Episode):
        raise ValueError(
            f"the episode is a {type(episode).__name__}; give Episode(start, goal), as a task's "
            f"episode_fn(seed) returns"
        )
    arrays = {}
    for name in ("start", "goal"):
        told = f"the {name} of the episode"
        arrays[name] = require_positions(told, getattr(episode, name), num_particles)
        require_known(f"episode.{name}", arrays[name])
    return Episode(**arrays)


EpisodeFn = Callable[[int], Episode]
"""The episode of a seed."""
DrawFn = Callable[[PRNGKeyArray], Episode]
"""A random episode from a key; pure JAX."""
RunningCost = Callable[[Episode, State, Actions], Float[Array, ""]]
"""Cost of the state at the end of an action, and of that action, shapes (G,) and (G, 3)."""
TerminalCost = Callable[[Episode, State], Float[Array, ""]]
"""Cost of the settled state."""
