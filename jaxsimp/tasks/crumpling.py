"""Random starts: SoftGym's crumpled states."""

from collections.abc import Callable
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from jaxsimp import goals
from jaxsimp.bodies import Body
from jaxsimp.checks import require_seed
from jaxsimp.dynamics import (
    Actions,
    at_rest,
    largest_time_step,
    make_pickers,
    make_simulation,
    rollout,
    settle,
)

FARTHEST = (0.3, 0.3, 0.6)
"""Largest displacement of a pick along x and y, either way, and up, metres."""
SECONDS = 0.5
"""Duration of a pick, seconds."""
TOP_SPEED = 1.5 * float(np.linalg.norm(FARTHEST)) / SECONDS
"""Speed of a pick at the middle of the longest displacement, metres per second."""


def crumple(body: Body, seed: int) -> Float[np.ndarray, "N 3"]:
    """A random settled state of a body, shape (N, 3): SoftGym's four random picks.

    Each pick carries a random particle up to 0.3 m sideways and 0.6 m up, and drops it. The body
    has self-contact: parts lie on each other, and a plan can pull them apart without tunnelling.

    Args:
        body: the body; it starts straight or flat on the table.
        seed: seed of the random picks.

    Raises:
        ValueError: if the seed is none.
    """
    return np.asarray(_compiled(body)(jax.random.key(require_seed(seed))))


@cache
def _compiled(body: Body) -> Callable[[PRNGKeyArray], Float[Array, "N 3"]]:
    return jax.jit(partial(draw_crumpled, body))


def draw_crumpled(body: Body, key: PRNGKeyArray) -> Float[Array, "N 3"]:
    """`crumple` with the random picks of a key, in pure JAX."""
    key_pick, key_move = jax.random.split(key)
    pick = jax.random.randint(key_pick, (4, 1), 0, body.num_particles)
    farthest = jnp.array([[FARTHEST]])
    nearest = farthest * jnp.array([[[-1.0, -1.0, 0.0]]])
    move = jax.random.uniform(key_move, (4, 1, 3), minval=nearest, maxval=farthest)
    return _drop(body, Actions(pick, move))


def _drop(body: Body, actions: Actions) -> Float[Array, "N 3"]:
    """The positions after actions on a flat body, which settles after each."""
    time_step = min(1e-3, 0.9 * largest_time_step(body))
    simulation = make_simulation(body, time_step, self_contact=True, top_speed=TOP_SPEED)
    pickers = make_pickers(FARTHEST, steps=round(SECONDS / time_step))
    settle_steps = round(1.0 / time_step)

    def one(position: Float[Array, "N 3"], action: Actions) -> tuple[Array, None]:
        single = jax.tree.map(lambda array: array[None], action)
        state, _ = rollout(simulation, pickers, at_rest(position), single)
        return settle(simulation, state, settle_steps).position, None

    return jax.lax.scan(one, at_rest(goals.flat(body)).position, actions)[0]
