"""Local search: displacements at random around the best plan so far; choices do not change.

For few evaluations that are dear: no gradients, and no distribution to fit.
"""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from jaxsimp.checks import keep, require_choice, require_count, require_number
from jaxsimp.planning.algorithm import MOST_PLANS, Defaults, Told, Wants
from jaxsimp.planning.archive import Archive
from jaxsimp.planning.descent import INSIDE
from jaxsimp.planning.space import ActionSpace, Plans


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["starts", "filled", "best", "cost", "count"],
    meta_fields=[],
)
@dataclass(frozen=True)
class LocalSearchState:
    """State of a local search.

    Attributes:
        starts: archived plans to start from, leading axis `num_starts`.
        filled: True in rows of `starts` that are no copies of the first, shape (num_starts,).
        best: best plan so far, without a leading axis.
        cost: its cost; infinite before the first answer.
        count: number of rounds so far.
    """

    starts: Plans
    filled: Bool[Array, " S"]
    best: Plans
    cost: Float[Array, ""]
    count: Int[Array, ""]


@dataclass(frozen=True)
class LocalSearch(Defaults):
    """Rounds of plans around the best so far, whose displacements have normal noise.

    The first round has the archived plans themselves and, for the rest, plans around them in turn:
    the plan that is returned is never worse than its start. Noise beyond a limit is cut off.

    Attributes:
        deviations: standard deviation of the noise in each round, in units of the limits.
        num_plans: number of plans in a round.
        num_starts: number of archived plans in the first round.
        wants: "settled", or "cost".

    Raises:
        ValueError: if a number is out of its range.
    """

    deviations: tuple[float, ...] = (0.08, 0.05, 0.03)
    num_plans: int = 8
    num_starts: int = 1
    wants: Wants = "settled"

    def __post_init__(self) -> None:
        if not isinstance(self.deviations, (tuple, list)) or not self.deviations:
            raise ValueError(f"deviations is {self.deviations!r}; give one number for each round")
        deviations = (
            require_number(f"deviations[{index}]", each, 0.0, 10.0, "limits")
            for index, each in enumerate(self.deviations)
        )
        keep(self, deviations=tuple(deviations))
        require_count("num_plans", self.num_plans, 1, MOST_PLANS)
        require_count("num_starts", self.num_starts, 1, self.num_plans)
        require_choice("wants", self.wants, ("settled", "cost"))

    @property
    def num_asks(self) -> int:
        """Number of rounds."""
        return len(self.deviations)

    def init(self, space: ActionSpace, archive: Archive) -> LocalSearchState:
        """The best archived plans."""
        starts = archive.best(self.num_starts)
        return LocalSearchState(
            starts=starts,
            # The first row is a start in any case.
            filled=archive.filled[: self.num_starts].at[0].set(True),
            best=jax.tree.map(lambda leaf: leaf[0], starts),
            cost=jnp.asarray(jnp.inf, float),
            count=jnp.zeros((), jnp.int32),
        )

    def ask(
        self, space: ActionSpace, state: LocalSearchState, key: PRNGKeyArray
    ) -> tuple[LocalSearchState, Plans]:
        """The starts and plans around them; later, plans around the best so far."""
        row = jnp.arange(self.num_plans)
        turn = row % self.num_starts
        is_first = state.count == 0
        centres = jax.tree.map(
            lambda start, best: jnp.where(is_first, start[turn], best[None]),
            state.starts,
            state.best,
        )
        deviation = jnp.asarray(self.deviations, float)[state.count]
        noise = deviation * jax.random.normal(key, centres.direction.shape, float)
        drawn = jnp.clip(centres.direction + noise, -INSIDE, INSIDE)
        is_start = is_first & (row < self.num_starts) & state.filled[turn]
        direction = jnp.where(is_start[:, None, None, None], centres.direction, drawn)
        return state, Plans(centres.choice, direction)

    def tell(
        self, space: ActionSpace, state: LocalSearchState, plans: Plans, told: Told
    ) -> LocalSearchState:
        """The best plan so far; the older wins ties."""
        costs = jnp.asarray(told.costs)
        index = jnp.argmin(costs)
        is_better = costs[index] < state.cost
        best, cost = jax.tree.map(
            lambda new, old: jnp.where(is_better, new[index], old),
            (plans, costs),
            (state.best, state.cost),
        )
        return LocalSearchState(state.starts, state.filled, best, cost, state.count + 1)

    def answer(self, space: ActionSpace, state: LocalSearchState) -> Plans:
        """The best plan; the start if no cost is finite."""
        return state.best
