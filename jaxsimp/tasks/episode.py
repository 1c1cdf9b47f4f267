"""An episode, and the functions of one that a task is made of."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import jax
import numpy as np
from jaxtyping import Array, Float

from jaxsimp.dynamics import Actions, State


@partial(jax.tree_util.register_dataclass, data_fields=["start", "goal"], meta_fields=[])
@dataclass(frozen=True)
class Episode:
    """Where one run starts and where it should end: positions, shape (N, 3), metres.

    `jax.vmap` may add axes before those.
    """

    start: Float[Array | np.ndarray, "*E N 3"]
    goal: Float[Array | np.ndarray, "*E N 3"]


EpisodeFn = Callable[[int], Episode]
"""The episode of a seed."""
RunningCost = Callable[[Episode, State, Actions], Float[Array, ""]]
"""Cost of the state at the end of an action, and of that action, shapes (G,) and (G, 3)."""
TerminalCost = Callable[[Episode, State], Float[Array, ""]]
"""Cost of the settled state."""
