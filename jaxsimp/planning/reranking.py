"""Reranking: of the best distinct plans of a search, the one that settles best."""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from jaxsimp.planning.algorithm import Defaults, Told, Wants
from jaxsimp.planning.archive import Archive
from jaxsimp.planning.space import ActionSpace, Plans


@partial(jax.tree_util.register_dataclass, data_fields=["plans", "costs"], meta_fields=[])
@dataclass(frozen=True)
class Ranking:
    """Plans and what they cost when they have settled, leading axis `num_plans`."""

    plans: Plans
    costs: Float[Array | np.ndarray, " B"]


@dataclass(frozen=True)
class Reranking(Defaults):
    """Carry out the best distinct plans in the physics that scores; return the best of them.

    Attributes:
        num_starts: plans that are carried out.

    Raises:
        ValueError: if it is below 1.
    """

    num_starts: int = 8
    wants: Wants = "settled"

    def __post_init__(self) -> None:
        if self.num_starts < 1:
            raise ValueError(f"num_starts is {self.num_starts}; at least 1 is needed")

    @property
    def num_asks(self) -> int:
        """It asks once."""
        return 1

    @property
    def num_plans(self) -> int:
        """Plans that are carried out."""
        return self.num_starts

    def init(self, space: ActionSpace, archive: Archive) -> Ranking:
        """The best archived plans, copies of the best where there are fewer."""
        return Ranking(archive.best(self.num_starts), archive.costs[: self.num_starts])

    def ask(self, space: ActionSpace, state: Ranking, key: PRNGKeyArray) -> tuple[Ranking, Plans]:
        """All plans at once."""
        return state, state.plans

    def tell(self, space: ActionSpace, state: Ranking, plans: Plans, told: Told) -> Ranking:
        """What they cost when they have settled."""
        return Ranking(plans, told.costs)

    def answer(self, space: ActionSpace, state: Ranking) -> Plans:
        """The plan that settles best; the best by cost where none is finite."""
        best = jnp.argmin(state.costs)
        return jax.tree.map(lambda leaf: leaf[best], state.plans)
