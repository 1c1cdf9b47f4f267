"""The default search: what to grasp by CEM, where to move it by gradients, which plan by score."""

from math import ceil

from jaxsimp.planning.algorithm import Algorithm, Sequence
from jaxsimp.planning.cem import CEM
from jaxsimp.planning.descent import Descent
from jaxsimp.planning.encodings import Joint
from jaxsimp.planning.reranking import Reranking
from jaxsimp.tasks import Task

DESCENTS_OF_ROPE = 4
"""Number of plans of a rope that descend: the best of CEM is often not the best after descent."""

ROUNDS, FEW_ACTIONS = 10, 4
"""Number of rounds of CEM for each of so many actions: longer plans have more to choose."""


def default_algorithm(task: Task, *, reranks: bool = True) -> Sequence:
    """The default search for plans of a task.

    CEM draws what all pickers grasp at once, for 10 rounds, or more for plans of more than four
    actions; the best of its plans descend along the
    gradient; of the 8 best distinct plans that have been seen, the one of the highest settled score
    in the evaluator's physics is returned. The price is that of 1,906 rollouts, 2,536 for ropes.

    Chosen on ropes of 31 and cloths of 17 by 17 particles, with seeds from 200.

    Args:
        task: the task.
        reranks: whether the last part is done, which needs an evaluator in JAX.
    """
    num_iterations = ROUNDS * ceil(task.num_actions / FEW_ACTIONS)
    num_starts = 1 if len(task.body.faces) else DESCENTS_OF_ROPE
    parts: tuple[Algorithm, ...] = (
        CEM(num_iterations=num_iterations, encoding=Joint()),
        Descent(num_starts=num_starts),
    )
    return Sequence((*parts, Reranking()) if reranks else parts)
