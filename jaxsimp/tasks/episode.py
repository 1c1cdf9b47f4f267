"""Episodes, and the types of a task's functions of an episode."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import jax
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from jaxsimp.dynamics import Actions, State


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


EpisodeFn = Callable[[int], Episode]
"""The episode of a seed."""
DrawFn = Callable[[PRNGKeyArray], Episode]
"""A random episode from a key; pure JAX."""
RunningCost = Callable[[Episode, State, Actions], Float[Array, ""]]
"""Cost of the state at the end of an action, and of that action, shapes (G,) and (G, 3)."""
TerminalCost = Callable[[Episode, State], Float[Array, ""]]
"""Cost of the settled state."""
