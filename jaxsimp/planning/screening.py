"""Screening: the costs of plans in two fidelities, a cheap one for all and a dear one for the best.

Costs without self-contact say which plans may be good, and cost a fourth; those with it say which
are. After Forrester et al., "Multi-fidelity optimization via surrogate modelling", Proc. R. Soc. A,
2007, here for the ranks of plans alone.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from jaxsimp.dynamics import Actions
from jaxsimp.planning.algorithm import Told

FRACTION = 4
"""One plan in this number is looked at again."""


def num_again(population: int) -> int:
    """Number of plans in a population that are looked at again."""
    return -(-population // FRACTION)


def screened(
    cheap: Callable[[Actions], Told], dear: Callable[[Actions], Told], actions: Actions
) -> Told:
    """Costs of plans, those of the best ones in the dear fidelity.

    The others rank behind these: the highest dear cost is added to their own.

    Args:
        cheap: costs of any number of plans.
        dear: costs of `num_again` plans in the other fidelity.
        actions: the plans, leading axis `B`.
    """
    costs = jnp.asarray(cheap(actions).costs)
    best = jnp.argsort(jnp.where(jnp.isfinite(costs), costs, jnp.inf))[: num_again(len(costs))]
    again = jnp.asarray(dear(jax.tree.map(lambda leaf: leaf[best], actions)).costs)
    highest = jnp.max(jnp.where(jnp.isfinite(again), again, 0.0))
    return Told((costs + highest).at[best].set(again))
