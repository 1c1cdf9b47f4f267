"""Differences between our dynamics and MJX, an independent implementation of the same springs."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsimp.bodies import Body
from jaxsimp.checks import require_count
from jaxsimp.dynamics import (
    NONE,
    Actions,
    Simulation,
    State,
    make_pickers,
    make_simulation,
    rollout,
)
from jaxsimp.dynamics.simulation import require_state
from jaxsimp.dynamics.springs import pull, spring_tensions
from jaxsimp.dynamics.step import pack
from jaxsimp.engines.mjx.engine import MJXSimulation, make_mjx_simulation, mjx_trajectory


@dataclass(frozen=True)
class Disagreement:
    """Largest differences between two engines, each relative to the largest value.

    Attributes:
        acceleration: relative difference of accelerations, in all states of MJX's motion.
        position: difference of positions after equally many steps, over the largest distance from
            the start.
        velocity: relative difference of velocities after equally many steps.
    """

    acceleration: float
    position: float
    velocity: float


def compare_with_mjx(
    body: Body,
    state: State,
    num_steps: int,
    time_step: float = 2e-3,
    gravity: float = 9.81,
) -> Disagreement:
    """Move a body freely in our dynamics and in MJX, and compare.

    Stiff springs amplify the rounding of float32; `jax.enable_x64(True)` shows its part.

    Args:
        body: body to simulate.
        state: state at the start, high enough to stay off the table.
        num_steps: number of time steps.
        time_step: time step, seconds, at most `jaxsimp.dynamics.largest_time_step(body)`.
        gravity: downward acceleration, metres per second squared.

    Raises:
        ValueError: if the state is not of the body, the body reaches the table, `num_steps` is no
            whole number above zero, or `make_mjx_simulation` raises.
    """
    num_steps = require_count("num_steps", num_steps, 1)
    state = require_state(state, body.num_particles)
    ours = make_simulation(body, time_step, gravity)
    theirs = make_mjx_simulation(body, time_step, gravity)
    lowest, found = jax.jit(_compare, static_argnames="num_steps")(ours, theirs, state, num_steps)
    if lowest < body.radius:
        raise ValueError(
            f"the body falls to {lowest:.4g} m, below the table, where it rests at "
            f"{body.radius:.4g} m; start higher, or take fewer steps than {num_steps}: contact is "
            f"not compared"
        )
    return Disagreement(*map(float, found))


def _compare(
    ours: Simulation, theirs: MJXSimulation, state: State, num_steps: int
) -> tuple[Float[Array, ""], list[Float[Array, ""]]]:
    """The lowest height in MJX's motion, and the fields of a `Disagreement`."""
    moved = _trajectory(ours, state, num_steps)
    other, accelerations = mjx_trajectory(theirs, state, num_steps)
    passed = jax.tree.map(
        lambda first, later: jnp.concatenate([first[None], later[:-1]]), state, other
    )
    expected = jax.vmap(_accelerations, (None, 0))(ours, passed)
    return other.position[..., 2].min(), [
        _ratio(accelerations - expected, expected),
        _ratio(other.position - moved.position, moved.position - state.position[None]),
        _ratio(other.velocity - moved.velocity, moved.velocity),
    ]


def _accelerations(simulation: Simulation, state: State) -> Float[Array, "N 3"]:
    """Our accelerations, without obstacles and pickers."""
    position, velocity = pack(simulation, state)
    tensions = spring_tensions(simulation.springs, position, velocity)
    forces = jnp.stack(pull(simulation.springs, tensions, position), axis=1)
    falling = forces / simulation.mass[:, None] - simulation.drag * state.velocity
    return falling.at[:, 2].add(-simulation.gravity)


def _trajectory(simulation: Simulation, state: State, num_steps: int) -> State:
    """Our states after each step with nothing held."""
    idle = Actions(jnp.full((num_steps, 1), NONE), jnp.zeros((num_steps, 1, 3)))
    return rollout(simulation, make_pickers(steps=1), state, idle, lambda state: state)[1]


def _ratio(difference: Float[Array, "T N 3"], value: Float[Array, "T N 3"]) -> Float[Array, ""]:
    """Largest length of a difference over the largest length of a value."""
    longest = [jnp.linalg.norm(array, axis=-1).max() for array in (difference, value)]
    return longest[0] / longest[1]
