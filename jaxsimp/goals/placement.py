"""The body at rest, laid where a goal lies: the start of a plan if none is given."""

import numpy as np

from jaxsimp.bodies import Body
from jaxsimp.goals.check import as_goal
from jaxsimp.goals.shapes import Positions, flat
from jaxsimp.goals.unfolding import unfolded


def flat_at(body: Body, goal: Positions) -> Positions:
    """The body flat on the table, or a rope as at rest, where a goal lies, shape (N, 3), metres.

    A folded goal is unfolded: what its folds do not move lies where it lies in the goal. For any
    other goal the body is turned and shifted in the plane so that the sum of the squared distances
    of its particles to their goals, seen from above, is least.

    Args:
        body: a body that is flat at rest.
        goal: goal positions, shape (N, 3), metres.

    Raises:
        ValueError: if the body is not flat at rest, or the goal is none of the body's (see
            `as_goal`).
    """
    goal = as_goal(body, goal)
    lying = flat(body)
    if len(body.faces):
        try:
            return unfolded(body, goal)
        except ValueError:
            pass  # a goal without folds, as over an obstacle
    own, wanted = (points[:, 0] + 1j * points[:, 1] for points in (lying, goal))
    # B. Horn, "Closed-form solution of absolute orientation", 1987, in two dimensions.
    product = np.vdot(own - own.mean(), wanted - wanted.mean())
    turn = product / abs(product) if product else 1.0
    placed = turn * (own - own.mean()) + wanted.mean()
    return np.stack([placed.real, placed.imag, lying[:, 2]], axis=1)
