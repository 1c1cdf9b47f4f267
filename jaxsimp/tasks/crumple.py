"""Random starts: SoftGym's crumpled states."""

from collections.abc import Callable
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsimp import goals
from jaxsimp.body import Body
from jaxsimp.dynamics import (
    Actions,
    State,
    at_rest,
    largest_time_step,
    make_pickers,
    make_simulation,
    rollout,
    settle,
)


def crumple(body: Body, seed: int) -> Float[np.ndarray, "N 3"]:
    """A random settled state of a body, shape (N, 3): SoftGym's four random picks.

    Each pick carries a random particle up to 0.3 m sideways and 0.6 m up, and drops it.

    Args:
        body: starts straight or flat on the table.
        seed: of the random picks.
    """
    key_pick, key_move = jax.random.split(jax.random.key(seed))
    pick = jax.random.randint(key_pick, (4, 1), 0, body.num_particles)
    farthest = jnp.array([[[0.3, 0.3, 0.6]]])
    nearest = jnp.array([[[-0.3, -0.3, 0.0]]])
    move = jax.random.uniform(key_move, (4, 1, 3), minval=nearest, maxval=farthest)
    actions = Actions(pick, move)
    return np.asarray(_drop(body)(actions))


@cache
def _drop(body: Body) -> Callable[[Actions], Float[Array, "N 3"]]:
    """Carry out one action after another on a flat body, letting it settle after each."""
    time_step = min(1e-3, 0.9 * largest_time_step(body))
    simulation = make_simulation(body, time_step)
    pickers = make_pickers((0.3, 0.3, 0.6), steps=round(0.5 / time_step))
    settle_steps = round(1.0 / time_step)

    @jax.jit
    def drop(actions: Actions) -> Float[Array, "N 3"]:
        def one(state: State, action: Actions) -> tuple[State, None]:
            single = jax.tree.map(lambda array: array[None], action)
            state, _ = rollout(simulation, pickers, state, single)
            return settle(simulation, state, settle_steps), None

        return jax.lax.scan(one, at_rest(goals.flat(body)), actions)[0].position

    return drop
