"""Reranking: choose the plan with the best settled state among the best distinct plans."""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from jaxsimp.checks import require_count
from jaxsimp.planning.algorithm import MOST_PLANS, Defaults, Told, Wants
from jaxsimp.planning.archive import Archive
from jaxsimp.planning.space import ActionSpace, Plans


@partial(jax.tree_util.register_dataclass, data_fields=["plans", "costs"], meta_fields=[])
@dataclass(frozen=True)
class Ranking:
    """Plans and the costs of their settled states, leading axis `num_plans`."""

    plans: Plans
    costs: Float[Array | np.ndarray, " B"]


@dataclass(frozen=True)
class Reranking(Defaults):
    """Carry out the best distinct plans in the evaluator's physics; return the best of them.

    Attributes:
        num_starts: number of plans to carry out.

    Raises:
        ValueError: if `num_starts` is below 1.
    """

    num_starts: int = 8
    wants: Wants = "settled"

    def __post_init__(self) -> None:
        require_count("num_starts", self.num_starts, 1, MOST_PLANS)

    @property
    def num_asks(self) -> int:
        """One question."""
        return 1

    @property
    def num_plans(self) -> int:
        """Number of plans to carry out."""
        return self.num_starts

    def init(self, space: ActionSpace, archive: Archive) -> Ranking:
        """The best archived plans, padded with copies of the best if there are fewer."""
        return Ranking(archive.best(self.num_starts), archive.costs[: self.num_starts])

    def ask(self, space: ActionSpace, state: Ranking, key: PRNGKeyArray) -> tuple[Ranking, Plans]:
        """All plans at once."""
        return state, state.plans

    def tell(self, space: ActionSpace, state: Ranking, plans: Plans, told: Told) -> Ranking:
        """The plans with the costs of their settled states."""
        return Ranking(plans, told.costs)

    def answer(self, space: ActionSpace, state: Ranking) -> Plans:
        """The plan with the best settled state; the best by cost if no settled cost is finite."""
        best = jnp.argmin(state.costs)
        return jax.tree.map(lambda leaf: leaf[best], state.plans)
