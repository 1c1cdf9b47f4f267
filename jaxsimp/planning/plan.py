"""A plan with the record of its search."""

from collections.abc import Sequence as Seq
from dataclasses import dataclass

from jaxsimp.dynamics import Actions
from jaxsimp.planning.loop import Optimum


@dataclass(frozen=True, eq=False)
class Plan:
    """A plan and the record of its search.

    Attributes:
        actions: the plan, shapes (T, G) and (T, G, 3).
        optimum: costs by question, the best distinct plans, and failures.
        num_rollouts: number of plans evaluated.
        price: price of the search, in rollouts: a gradient counts as several, see `PRICES`.
        seconds: search time without compilation, seconds.
        compile_seconds: compilation time, seconds; near 0 if an earlier plan had the same number
            of candidates and the same algorithm.
        parts: the plans of several searches that it was made from; empty for one search.
    """

    actions: Actions
    optimum: Optimum
    num_rollouts: int
    price: int
    seconds: float
    compile_seconds: float
    parts: tuple["Plan", ...] = ()

    @property
    def searches(self) -> tuple["Plan", ...]:
        """The single searches that it was made from, in order; itself if it is one."""
        return tuple(one for part in self.parts for one in part.searches) or (self,)


def combined(
    actions: Actions, parts: Seq[Plan], optimum: Optimum, num_rollouts: int = 0, price: int = 0
) -> Plan:
    """A plan made from those of several searches, with sums of their numbers.

    Args:
        actions: the plan.
        parts: the plans of the searches.
        optimum: costs by question, as of one of the parts.
        num_rollouts: number of plans evaluated between the searches.
        price: price of these, in rollouts.
    """
    return Plan(
        actions=actions,
        optimum=optimum,
        num_rollouts=num_rollouts + sum(part.num_rollouts for part in parts),
        price=price + sum(part.price for part in parts),
        seconds=sum(part.seconds for part in parts),
        compile_seconds=sum(part.compile_seconds for part in parts),
        parts=tuple(parts),
    )
