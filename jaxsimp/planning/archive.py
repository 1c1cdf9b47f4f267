"""The archive of the best distinct plans so far, from which the next algorithm starts."""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxsimp.planning.space import ActionSpace, Plans

DISTINCT = 0.05
"""Largest difference of displacements, in units of the limits, at which two plans with the same
choices count as one plan: about 10 mm in a task of cloth."""


@partial(jax.tree_util.register_dataclass, data_fields=["plans", "costs", "filled"], meta_fields=[])
@dataclass(frozen=True)
class Archive:
    """The best distinct plans so far, best first.

    Attributes:
        plans: the plans, shapes (M, T, G) and (M, T, G, 3).
        costs: costs of the plans, infinite for rollouts that were not finite, shape (M,).
        filled: True in rows that hold a plan, shape (M,).
    """

    plans: Plans
    costs: Float[Array, "*E M"]
    filled: Bool[Array, "*E M"]

    def best(self, count: int) -> Plans:
        """The best plans, padded with copies of the best if there are fewer."""
        index = jnp.where(self.filled, jnp.arange(len(self.filled)), 0)[:count]
        return jax.tree.map(lambda leaf: leaf[index], self.plans)


def empty_archive(space: ActionSpace, size: int) -> Archive:
    """An archive with room for `size` plans."""
    shape = (size, space.num_actions, space.num_pickers)
    plans = Plans(jnp.zeros(shape, int), jnp.zeros((*shape, 3), float))
    return Archive(plans, jnp.full(size, jnp.inf, float), jnp.zeros(size, bool))


def archived(
    archive: Archive, space: ActionSpace, plans: Plans, costs: Float[Array | np.ndarray, " B"]
) -> Archive:
    """The archive of the best distinct plans of its own and of new ones; the older win ties."""
    plans = jax.tree.map(lambda *parts: jnp.concatenate(parts), archive.plans, plans)
    costs = jnp.concatenate([archive.costs, costs.astype(archive.costs.dtype)])
    free = jnp.concatenate([archive.filled, jnp.ones(len(costs) - len(archive.costs), bool)])
    # A failed plan still ranks before an empty row.
    worst = jnp.finfo(costs.dtype).max
    chosen, filled = [], []
    for _ in range(len(archive.costs)):
        best = jnp.argmin(jnp.where(free, jnp.minimum(costs, worst), jnp.inf))
        chosen.append(best)
        filled.append(free[best])
        free = free & ~_alike(space, plans, best)
    index = jnp.stack(chosen)
    return Archive(jax.tree.map(lambda leaf: leaf[index], plans), costs[index], jnp.stack(filled))


def _alike(space: ActionSpace, plans: Plans, one: Array) -> Bool[Array, " B"]:
    """Whether each plan counts as the same as plan `one`."""
    same = (plans.choice == plans.choice[one][None]).all(axis=(1, 2))
    moves = jnp.abs(plans.direction - plans.direction[one][None]).max(axis=-1)
    grasped = plans.choice < len(space.candidates)
    return same & (jnp.where(grasped, moves, 0.0) <= DISTINCT).all(axis=(1, 2))
