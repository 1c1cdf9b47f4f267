"""Algorithms: the protocol of search methods. One file each.

An algorithm asks for the costs of plans and is told them. It knows the space of plans and their
costs, and nothing of bodies, tasks or physics. Two drivers run it: `optimize`, a pure loop, and
`Planner`, a loop on the host.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, Protocol, runtime_checkable

import jax
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from jaxsimp.checks import keep
from jaxsimp.planning.archive import Archive
from jaxsimp.planning.space import ActionSpace, Plans

Wants = Literal["cost", "gradient", "settled", "screened"]
"""Kind of evaluation that an algorithm asks for:

- cost: the cost of a plan, in the engine's physics;
- gradient: that, and its gradient;
- settled: 1 minus the score of the settled state, in the evaluator's physics;
- screened: the cost in two fidelities, see `jaxsimp.planning.screening`."""

MOST_PLANS = 1_000_000
"""Most plans in a question, and most questions."""
PRICES: dict[Wants, int] = {"cost": 1, "gradient": 6, "settled": 4, "screened": 2}
"""Price of one evaluation by its kind, in rollouts. Measured without self-contact on a CPU: a
gradient takes the time of 4.7 to 6 rollouts, a rollout with self-contact that of about 4, and a
quarter of the plans that are screened are carried out with it."""


@partial(jax.tree_util.register_dataclass, data_fields=["costs", "gradients"], meta_fields=[])
@dataclass(frozen=True)
class Told:
    """Evaluations of the plans that an algorithm asked for.

    Attributes:
        costs: costs of the plans, infinite if a rollout was not finite, shape (B,).
        gradients: gradients of the costs by `Plans.direction`, zero if one is not finite, shape
            (B, T, G, 3); None unless the algorithm wants them.
    """

    costs: Float[Array | np.ndarray, "*B"]
    gradients: Float[Array | np.ndarray, "*B T G 3"] | None = None


@runtime_checkable
class Algorithm(Protocol):
    """A method of search: a frozen dataclass of settings with pure functions.

    States are pytrees of arrays of fixed shapes. All functions are pure JAX.
    """

    def __hash__(self) -> int:
        """Hash of the settings, the key of compiled functions that are kept."""
        ...

    @property
    def num_asks(self) -> int:
        """Number of questions, each about `num_plans` plans."""
        ...

    @property
    def num_plans(self) -> int:
        """Number of plans in a question, `B`."""
        ...

    @property
    def num_starts(self) -> int:
        """Largest number of archived plans that it starts from; 0 for none."""
        ...

    @property
    def wants(self) -> Wants:
        """Kind of evaluation that it asks for."""
        ...

    def init(self, space: ActionSpace, archive: Archive) -> PyTree[Any]:
        """The state before the first question, warmed by the archive."""
        ...

    def ask(
        self, space: ActionSpace, state: PyTree[Any], key: PRNGKeyArray
    ) -> tuple[PyTree[Any], Plans]:
        """The state, and `num_plans` plans."""
        ...

    def tell(self, space: ActionSpace, state: PyTree[Any], plans: Plans, told: Told) -> PyTree[Any]:
        """The state after the answer to the last question."""
        ...

    def answer(self, space: ActionSpace, state: PyTree[Any]) -> Plans | None:
        """The plan to return, without a leading axis; None for the best of the archive."""
        ...

    def trace(self, state: PyTree[Any]) -> dict[str, Array]:
        """Quantities to record after each answer, by name."""
        ...


class Defaults:
    """Defaults of most algorithms: they want costs, and return the best plan."""

    num_starts: int = 0
    wants: Wants = "cost"

    def answer(self, space: ActionSpace, state: PyTree[Any]) -> Plans | None:
        """None, for the best plan of the archive."""
        return None

    def trace(self, state: PyTree[Any]) -> dict[str, Array]:
        """Nothing."""
        return {}


@dataclass(frozen=True)
class Sequence:
    """Algorithms that follow one another: each starts from the best plans of those before.

    Attributes:
        algorithms: the algorithms in order, at least one.

    Raises:
        ValueError: if there is no algorithm, or one is none.
    """

    algorithms: tuple[Algorithm, ...]

    def __post_init__(self) -> None:
        if isinstance(self.algorithms, list):  # algorithms are keys of what is compiled
            keep(self, algorithms=tuple(self.algorithms))
        if not isinstance(self.algorithms, tuple) or not self.algorithms:
            raise ValueError(f"algorithms is {self.algorithms!r}; give a tuple of at least one")
        for each in self.algorithms:
            _require_algorithm(each)


def stages(algorithm: Algorithm | Sequence) -> tuple[Algorithm, ...]:
    """The algorithms of a sequence, or the single algorithm given.

    Raises:
        ValueError: if it is none.
    """
    if isinstance(algorithm, Sequence):
        return algorithm.algorithms
    _require_algorithm(algorithm)
    return (algorithm,)


def _require_algorithm(algorithm: Any) -> None:
    if isinstance(algorithm, type) or not isinstance(algorithm, Algorithm):
        raise ValueError(
            f"{algorithm!r} is no algorithm; give CEM() or another, or a Sequence of them"
        )


def price(algorithm: Algorithm | Sequence) -> int:
    """Price of a search in rollouts, see `PRICES`."""
    return sum(each.num_asks * each.num_plans * PRICES[each.wants] for each in stages(algorithm))
