"""Gradient descent on displacements, from the best plans of a search; choices do not change.

Kingma and Ba, "Adam: a method for stochastic optimization", ICLR 2015, with a learning rate that
falls to zero as a cosine.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray, PyTree

from jaxsimp.checks import keep, require_count, require_number
from jaxsimp.planning.algorithm import MOST_PLANS, Defaults, Told, Wants
from jaxsimp.planning.archive import Archive
from jaxsimp.planning.space import ActionSpace, Plans

INSIDE = 1 - 1e-4
"""Largest displacement, in units of the limits: at a limit, half of the gradient is lost."""


@partial(jax.tree_util.register_dataclass, data_fields=["plans", "moments"], meta_fields=[])
@dataclass(frozen=True)
class DescentState:
    """State of the descent.

    Attributes:
        plans: current plans, leading axis `num_starts`.
        moments: moments of the optimiser.
    """

    plans: Plans
    moments: PyTree[Any]


@dataclass(frozen=True)
class Descent(Defaults):
    """Adam on the displacements of the best archived plans.

    Attributes:
        num_asks: number of steps.
        num_starts: number of plans, optimised side by side.
        learning_rate: learning rate of the first step, in units of the limits.

    Raises:
        ValueError: if a number is out of its range.
    """

    num_asks: int = 35
    num_starts: int = 1
    learning_rate: float = 0.03
    wants: Wants = "gradient"

    def __post_init__(self) -> None:
        for name in ("num_asks", "num_starts"):
            require_count(name, getattr(self, name), 1, MOST_PLANS)
        rate = require_number("learning_rate", self.learning_rate, 1e-6, 10.0, "limits")
        keep(self, learning_rate=rate)

    @property
    def num_plans(self) -> int:
        """Number of plans, optimised side by side."""
        return self.num_starts

    def init(self, space: ActionSpace, archive: Archive) -> DescentState:
        """The best archived plans, padded with copies of the best if there are fewer."""
        plans = archive.best(self.num_starts)
        return DescentState(plans, self._optimizer.init(plans.direction))

    def ask(
        self, space: ActionSpace, state: DescentState, key: PRNGKeyArray
    ) -> tuple[DescentState, Plans]:
        """The current plans."""
        return state, state.plans

    def tell(
        self, space: ActionSpace, state: DescentState, plans: Plans, told: Told
    ) -> DescentState:
        """A step against the gradient."""
        updates, moments = self._optimizer.update(told.gradients, state.moments)
        direction = jnp.clip(plans.direction + updates, -INSIDE, INSIDE)
        return DescentState(Plans(plans.choice, direction), moments)

    @property
    def _optimizer(self) -> Any:
        import optax

        return optax.adam(optax.cosine_decay_schedule(self.learning_rate, self.num_asks))
