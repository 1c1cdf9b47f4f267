"""Common parts of the figures: rollouts, cloths hanging at rest, and distances of shapes."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxsimp.bodies import Body
from jaxsimp.dynamics import at_rest, largest_time_step, make_simulation, rollout
from jaxsimp.dynamics.adjoint import plain_steps
from jaxsimp.dynamics.step import Motion, pack, unpack

GRAVITY = 9.81
Positions = Float[np.ndarray, "N 3"]

run = jax.jit(rollout, static_argnames=("observe", "adjoint"))


def hang(body: Body, start: Positions, held: Sequence[int], seconds: float) -> Positions:
    """Positions of a body after hanging from some of its particles, metres.

    Args:
        body: body to hang, without self-contact.
        start: positions at the start, at rest, off the table, metres.
        held: ids of particles that stay in place.
        seconds: duration, seconds.
    """
    time_step = min(2e-3, 0.9 * largest_time_step(body))
    simulation = make_simulation(body, time_step, GRAVITY)
    motion = Motion(jnp.asarray(np.isin(np.arange(len(start)), held)), jnp.zeros((3, len(start))))
    shares = jnp.zeros(round(seconds / time_step))
    final, _ = _steps(simulation, (pack(simulation, at_rest(start)), None), motion, shares)
    return np.asarray(unpack(simulation, final).position, dtype=float)


_steps = jax.jit(plain_steps)


def upright(body: Body, height: float = 1.0) -> Positions:
    """A cloth at rest in a plane across the table, its last row the upper edge, metres."""
    x, y = body.rest.T[:2]
    return np.stack([0 * x, y, height + x], axis=1)


def rms(difference: Float[np.ndarray, "*T N 3"]) -> float:
    """Root-mean-square length of differences, in the unit of the differences."""
    return float(np.sqrt((difference**2).sum(axis=-1).mean()))
