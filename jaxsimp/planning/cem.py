"""The cross-entropy method: draw plans, keep the best, fit the distribution to them.

Rubinstein, "The cross-entropy method for combinatorial and continuous optimization",
Methodology and Computing in Applied Probability, 1999.
"""

from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from jaxsimp.checks import keep, require_choice, require_count, require_flag, require_number
from jaxsimp.planning.algorithm import MOST_PLANS, Defaults, Told, Wants
from jaxsimp.planning.archive import Archive
from jaxsimp.planning.encodings import Categorical, Encoding
from jaxsimp.planning.space import ActionSpace, Plans


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["distribution", "asked", "elites", "costs", "filled", "count"],
    meta_fields=[],
)
@dataclass(frozen=True)
class CEMState:
    """State of a search by the cross-entropy method.

    Attributes:
        distribution: distribution of the samples.
        asked: samples of the last question, leading axis `B`.
        elites: best samples of this round so far, best first, leading axis `E`.
        costs: costs of the elites, shape (E,).
        filled: True in rows that hold an elite, shape (E,).
        count: number of populations drawn so far.
    """

    distribution: PyTree[Any]
    asked: PyTree[Any]
    elites: PyTree[Any]
    costs: Float[Array, " E"]
    filled: Bool[Array, " E"]
    count: Int[Array, ""]


@dataclass(frozen=True)
class CEM(Defaults):
    """The cross-entropy method.

    Attributes:
        num_iterations: number of rounds of sampling and fitting.
        population: number of plans drawn in each round.
        initial_populations: number of populations drawn in the first round: later rounds seldom
            find folds that are absent from the first elites.
        elite_fraction: fraction of the population that are elites.
        smoothing: fraction of the old distribution kept in each update.
        initial_spread: standard deviation of the first displacements, in units of the limits.
        keep_best: whether the best plan so far joins the elites of each round.
        returns: "best", the best plan drawn, or "mean", the mean of the last distribution.
        encoding: encoding of plans as samples of a distribution.
        wants: "cost", or "screened" for costs in two fidelities.

    Raises:
        ValueError: if a number is out of its range.
    """

    num_iterations: int = 15
    population: int = 128
    initial_populations: int = 4
    elite_fraction: float = 0.1
    smoothing: float = 0.1
    initial_spread: float = 0.7
    keep_best: bool = True
    returns: Literal["best", "mean"] = "best"
    encoding: Encoding = field(default_factory=Categorical)
    wants: Wants = "cost"

    def __post_init__(self) -> None:
        for name in ("num_iterations", "population", "initial_populations"):
            require_count(name, getattr(self, name), 1, MOST_PLANS)
        keep(
            self,
            elite_fraction=require_number("elite_fraction", self.elite_fraction, 1e-6, 1.0),
            smoothing=require_number("smoothing", self.smoothing, 0.0, 0.999),
            initial_spread=require_number(
                "initial_spread", self.initial_spread, 1e-6, 1e3, "limits"
            ),
        )
        require_flag("keep_best", self.keep_best)
        require_choice("returns", self.returns, ("best", "mean"))
        require_choice("wants", self.wants, ("cost", "screened"))
        if isinstance(self.encoding, type) or not isinstance(self.encoding, Encoding):
            raise ValueError(
                f"encoding is {self.encoding!r}; give Categorical(), Joint() or GaussianIndex()"
            )

    @property
    def num_asks(self) -> int:
        """Number of populations drawn in all rounds."""
        return self.num_iterations + self.initial_populations - 1

    @property
    def num_plans(self) -> int:
        """Number of plans in a population."""
        return self.population

    @property
    def num_elites(self) -> int:
        """Number of elites, at least 2 unless the population is smaller."""
        return min(self.population, max(2, round(self.elite_fraction * self.population)))

    def init(self, space: ActionSpace, archive: Archive) -> CEMState:
        """The first distribution; the best archived plan is the first elite."""
        distribution = self.encoding.init(space, self.initial_spread)
        samples = self.encoding.encode(space, archive.plans)

        def room(leaf: Array, size: int) -> Array:
            return jnp.broadcast_to(leaf[:1], (size, *leaf.shape[1:]))

        first = jnp.arange(self.num_elites) == 0
        return CEMState(
            distribution=distribution,
            asked=jax.tree.map(partial(room, size=self.population), samples),
            elites=jax.tree.map(partial(room, size=self.num_elites), samples),
            costs=jnp.where(first, archive.costs[:1], jnp.inf),
            filled=first & archive.filled[:1] & self.keep_best,
            count=jnp.zeros((), jnp.int32),
        )

    def ask(self, space: ActionSpace, state: CEMState, key: PRNGKeyArray) -> tuple[CEMState, Plans]:
        """Draw a population."""
        samples = self.encoding.sample(space, state.distribution, key, self.population)
        state = CEMState(**{**vars(state), "asked": samples})
        return state, self.encoding.decode(space, samples)

    def tell(self, space: ActionSpace, state: CEMState, plans: Plans, told: Told) -> CEMState:
        """Choose the elites; fit the distribution to them at the end of a round."""
        begins = state.count >= self.initial_populations  # the elites are from an earlier round
        kept = jnp.arange(self.num_elites) < (1 if self.keep_best else 0)
        filled = state.filled & (kept | ~begins)
        elites, costs, filled = _best(
            self.num_elites,
            (state.elites, state.costs, filled),
            (state.asked, jnp.asarray(told.costs), jnp.ones(self.population, bool)),
        )
        count = state.count + 1
        distribution = jax.lax.cond(
            count >= self.initial_populations,
            partial(self.encoding.update, space, smoothing=self.smoothing),
            lambda distribution, _: distribution,
            state.distribution,
            elites,
        )
        return CEMState(distribution, state.asked, elites, costs, filled, count)

    def answer(self, space: ActionSpace, state: CEMState) -> Plans | None:
        """The mean of the last distribution if `returns` is "mean", else None."""
        if self.returns == "best":
            return None
        return self.encoding.decode(space, self.encoding.mean(space, state.distribution))

    def trace(self, state: CEMState) -> dict[str, Array]:
        """Costs of the elites."""
        return {"elite_costs": state.costs}


Ranked = tuple[PyTree[Any], Float[Array, " _"], Bool[Array, " _"]]
"""Samples, their costs, and whether each row holds a sample."""


def _best(count: int, *pools: Ranked) -> Ranked:
    """The `count` best of all pools, best first; the earlier win ties."""
    samples, costs, filled = jax.tree.map(lambda *parts: jnp.concatenate(parts), *pools)
    index = jnp.lexsort((costs, ~filled))[:count]
    return jax.tree.map(lambda leaf: leaf[index], (samples, costs, filled))
