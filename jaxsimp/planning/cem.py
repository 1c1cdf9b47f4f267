"""The cross-entropy method: draw plans, keep the best, fit the distribution to them.

Rubinstein, "The cross-entropy method for combinatorial and continuous optimization",
Methodology and Computing in Applied Probability, 1999.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray, PyTree

from jaxsimp.dynamics import Actions
from jaxsimp.planning.encodings import ActionSpace, Encoding


@dataclass(frozen=True)
class CEMConfig:
    """Settings of the cross-entropy method.

    Attributes:
        num_iterations: rounds of sampling and fitting.
        population: plans drawn in each round.
        initial_populations: as many times `population` plans are drawn in the first round: what
            the first elites miss, later rounds seldom find again.
        elite_fraction: share of the population that the distribution is fitted to.
        smoothing: share of the old distribution that is kept in each update.
        initial_spread: deviation of the first displacements, in units of the limits.
        keep_best: put the best plan so far among the elites of each round.
        returns: the "best" plan that was drawn, or the "mean" of the last distribution.

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

    def __post_init__(self) -> None:
        for name in ("num_iterations", "population", "initial_populations"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}; at least 1 is needed")
        if not 0 < self.elite_fraction <= 1:
            raise ValueError(f"elite_fraction is {self.elite_fraction}; give above 0, at most 1")
        if not 0 <= self.smoothing < 1:
            raise ValueError(f"smoothing is {self.smoothing}; give at least 0 and less than 1")
        if not 0 < self.initial_spread < np.inf:
            raise ValueError(f"initial_spread is {self.initial_spread}; give a number above 0")
        if self.returns not in ("best", "mean"):
            raise ValueError(f'returns is {self.returns}; give "best" or "mean"')

    @property
    def num_populations(self) -> int:
        """Populations drawn in all rounds."""
        return self.num_iterations + self.initial_populations - 1

    @property
    def num_elites(self) -> int:
        """Plans that the distribution is fitted to, at least 2 where there are as many."""
        return min(self.population, max(2, round(self.elite_fraction * self.population)))


@dataclass(frozen=True)
class Search:
    """What a search found.

    Attributes:
        actions: the plan, shapes (T, G) and (T, G, 3).
        cost: of that plan; infinite if no rollout was finite.
        best_costs: lowest cost so far after each iteration.
        elite_costs: mean cost of the elites of each iteration.
        num_rollouts: plans evaluated.
        non_finite: how many of them had a cost that is not finite.
    """

    actions: Actions
    cost: float
    best_costs: tuple[float, ...]
    elite_costs: tuple[float, ...]
    num_rollouts: int
    non_finite: int


EvaluateFn = Callable[[Actions], Float[np.ndarray, " B"]]
"""Costs of a batch of plans, leading axis `B`."""


def search(
    space: ActionSpace,
    encoding: Encoding,
    config: CEMConfig,
    key: PRNGKeyArray,
    evaluate_fn: EvaluateFn,
    on_population: Callable[[], None] = lambda: None,
) -> Search:
    """Search for a plan of low cost.

    A rollout whose cost is not finite ranks last and is counted.

    Args:
        space: the plans that may be searched.
        encoding: of plans as samples of a distribution.
        config: settings.
        key: of the random draws.
        evaluate_fn: costs of `population` plans at a time, or of one.
        on_population: called after each population.
    """
    distribution = encoding.init(space, config.initial_spread)
    best: _Pool | None = None
    best_costs, elite_costs, non_finite = [], [], 0
    keys = iter(jax.random.split(key, config.num_populations))
    for iteration in range(config.num_iterations):
        pools = []
        for _ in range(1 if iteration else config.initial_populations):
            samples, actions = _ask(encoding, config.population, space, distribution, next(keys))
            costs, failed = _rank_last(evaluate_fn(actions))
            non_finite += failed
            pools.append(_Pool(samples, actions, costs))
            on_population()
        pool = pools[0].joined_by(*pools[1:])
        if config.keep_best and best is not None:
            pool = best.joined_by(pool)
        elites = pool.take(np.argsort(pool.costs, kind="stable")[: config.num_elites])
        if best is None or elites.costs[0] < best.costs[0]:
            best = elites.take(slice(0, 1))
        distribution = _tell(encoding, space, distribution, elites.samples, config.smoothing)
        best_costs.append(float(best.costs[0]))
        elite_costs.append(float(elites.costs.mean()))
    assert best is not None  # there is at least one iteration
    num_rollouts = config.num_populations * config.population
    if config.returns == "mean":
        actions = encoding.decode(space, encoding.mean(space, distribution))
        actions = jax.tree.map(lambda array: array[None], actions)
        costs, failed = _rank_last(evaluate_fn(actions))
        best = _Pool((), actions, costs)
        non_finite += failed
        num_rollouts += 1
    return Search(
        jax.tree.map(lambda array: array[0], best.actions),
        float(best.costs[0]),
        tuple(best_costs),
        tuple(elite_costs),
        num_rollouts,
        non_finite,
    )


@dataclass(frozen=True)
class _Pool:
    """Samples, the plans that they mean and their costs, leading axis `B`."""

    samples: PyTree[Any]
    actions: Actions
    costs: Float[np.ndarray, " B"]

    def take(self, index: np.ndarray | slice) -> "_Pool":
        return self._map(lambda array: np.asarray(array)[index])

    def joined_by(self, *others: "_Pool") -> "_Pool":
        return self._map(lambda *arrays: np.concatenate(arrays), *others)

    def _map(self, fn: Callable[..., np.ndarray], *others: "_Pool") -> "_Pool":
        pools = (self, *others)
        plans = [(pool.samples, pool.actions) for pool in pools]
        samples, actions = jax.tree.map(lambda *arrays: jnp.asarray(fn(*arrays)), *plans)
        return _Pool(samples, actions, fn(*(pool.costs for pool in pools)))


# Random bits compile five times as fast unoptimised, and a round draws them once.
@partial(jax.jit, static_argnums=(0, 1), compiler_options={"xla_backend_optimization_level": 0})
def _ask(
    encoding: Encoding,
    population: int,
    space: ActionSpace,
    distribution: PyTree[Any],
    key: PRNGKeyArray,
) -> tuple[PyTree[Any], Actions]:
    samples = encoding.sample(space, distribution, key, population)
    return samples, encoding.decode(space, samples)


@partial(jax.jit, static_argnums=(0, 4))
def _tell(
    encoding: Encoding,
    space: ActionSpace,
    distribution: PyTree[Any],
    elites: PyTree[Any],
    smoothing: float,
) -> PyTree[Any]:
    return encoding.update(space, distribution, elites, smoothing)


def _rank_last(costs: Float[np.ndarray, " B"]) -> tuple[Float[np.ndarray, " B"], int]:
    """Costs with infinity for those that are not finite, and how many those are."""
    finite = np.isfinite(costs)
    return np.where(finite, costs, np.inf), int(np.sum(~finite))
