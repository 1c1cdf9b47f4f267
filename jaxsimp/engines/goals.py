"""What the goal of a task scores, which bounds what plans can."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxsimp.dynamics import NONE, Actions, at_rest
from jaxsimp.engines.engine import SearchEngine
from jaxsimp.engines.rollouts import as_float
from jaxsimp.engines.springs import MassSprings
from jaxsimp.tasks import Episode, Task, score
from jaxsimp.tasks.episode import require_episode


@dataclass(frozen=True)
class GoalScores:
    """Scores of a goal.

    Attributes:
        laid: score of the goal's positions, at rest.
        settled: score of the body let go there and settled; NaN if the simulation became unstable.
    """

    laid: float
    settled: float


def goal_scores(task: Task, episode: Episode, engine: SearchEngine | None = None) -> GoalScores:
    """Scores of the goal of an episode: as it is, and let go and settled.

    A score of 1 is a cost of 0, which a goal need not have: the cost of a fold counts the thickness
    between its layers, and a body that is let go moves.

    Args:
        task: the task.
        episode: start and goal.
        engine: engine in which the body settles, for the time of a task's `settle_actions`, one
            physics; by default our own dynamics, with self-contact.

    Raises:
        ValueError: if the episode is not of the task's body.
    """
    episode = require_episode(episode, task.body.num_particles)
    settling = engine or MassSprings(self_contact=True)
    shape = (task.settle_actions, task.num_pickers)
    idle = Actions(jnp.full(shape, NONE), jnp.zeros((*shape, 3)))

    @jax.jit
    def both(physics: PyTree[Any], episode: Episode) -> tuple[Float[Array, ""], Float[Array, ""]]:
        laid = at_rest(episode.goal)
        final, _ = settling.rollout(physics, laid, idle, lambda *_: ())
        return score(task, episode, laid), score(task, episode, final.position)

    laid, settled = both(settling.physics(task), as_float(episode))
    return GoalScores(float(laid), float(settled))
