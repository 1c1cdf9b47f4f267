"""Random shooting: draw plans uniformly, keep the best. The simplest search."""

from dataclasses import dataclass

import jax
from jaxtyping import PRNGKeyArray

from jaxsimp.checks import require_count
from jaxsimp.planning.algorithm import MOST_PLANS, Defaults, Told
from jaxsimp.planning.archive import Archive
from jaxsimp.planning.space import ActionSpace, Plans


@dataclass(frozen=True)
class RandomShooting(Defaults):
    """Search over plans with uniformly drawn choices and displacements.

    Attributes:
        num_asks: number of populations.
        num_plans: number of plans in a population.

    Raises:
        ValueError: if a number is below 1.
    """

    num_asks: int = 27
    num_plans: int = 128

    def __post_init__(self) -> None:
        for name in ("num_asks", "num_plans"):
            require_count(name, getattr(self, name), 1, MOST_PLANS)

    def init(self, space: ActionSpace, archive: Archive) -> tuple[()]:
        """The empty state."""
        return ()

    def ask(
        self, space: ActionSpace, state: tuple[()], key: PRNGKeyArray
    ) -> tuple[tuple[()], Plans]:
        """Draw a population."""
        key_choice, key_move = jax.random.split(key)
        shape = (self.num_plans, space.num_actions, space.num_pickers)
        choice = jax.random.randint(key_choice, shape, 0, len(space.candidates) + 1)
        move = jax.random.uniform(key_move, (*shape, 3), float, minval=-1.0, maxval=1.0)
        return state, Plans(choice, move)

    def tell(self, space: ActionSpace, state: tuple[()], plans: Plans, told: Told) -> tuple[()]:
        """The empty state: the archive keeps the best plans."""
        return state
