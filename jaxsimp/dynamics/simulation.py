"""Simulations: the physics of a body as arrays, with a time step proven stable."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsimp.bodies import Body
from jaxsimp.checks import as_reals, require_flag, require_number
from jaxsimp.dynamics.arrays import as_array, require_known, require_positions
from jaxsimp.dynamics.contact.obstacles import Obstacle, Table, has_table, make_obstacles
from jaxsimp.dynamics.contact.settings import (
    LEAST_SPEED,
    MOST_SPEED,
    TOP_SPEED,
    SelfContact,
    make_self_contact,
)
from jaxsimp.dynamics.springs import Springs, make_springs

PHYSICS = ("mass", "radius", "drag", "friction", "gravity", "time_step", "obstacles")
"""Fields of `Simulation`, besides springs, with a cotangent: velocities depend on them."""
LEAST_TIME_STEP = 1e-12
"""Shortest time step, seconds: float32 holds its square."""
MOST_GRAVITY = 1e3
"""Largest gravity, up or down, metres per second squared."""


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["position", "velocity", "missed"],
    meta_fields=[],
)
@dataclass(frozen=True)
class State:
    """A body in motion.

    Here and below `...` stands for the axes that `jax.vmap` and `jax.lax.map` add.

    Attributes:
        position: positions, shape (N, 3), metres.
        velocity: velocities, shape (N, 3), metres per second.
        missed: number of tunnelled contacts so far, see `Contacts`; 0 without self-contact. A
            float, so that states can be differentiated.
    """

    position: Float[Array, "... N 3"]
    velocity: Float[Array, "... N 3"]
    missed: Float[Array, "..."] = field(default_factory=lambda: jnp.zeros(()))


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["springs", "rest", *PHYSICS, "self_contact"],
    meta_fields=[],
)
@dataclass(frozen=True)
class Simulation:
    """A body's physics as arrays: every leaf can be differentiated or batched.

    Attributes:
        springs: stiffness, damping and rest lengths.
        rest: rest coordinates, shape (N, 3), metres.
        mass: masses, shape (N,), kilograms.
        radius: distance of a particle from an obstacle that it rests on, metres.
        drag: air drag, per second.
        friction: Coulomb coefficient with the obstacles.
        gravity: downward acceleration, metres per second squared.
        time_step: time step, seconds.
        obstacles: rigid bodies at rest, in the order in which they act.
        self_contact: contacts of the body with itself; None for a body that passes through itself.
    """

    springs: Springs
    rest: Float[Array, "... N 3"]
    mass: Float[Array, "... N"]
    radius: Float[Array, "..."]
    drag: Float[Array, "..."]
    friction: Float[Array, "..."]
    gravity: Float[Array, "..."]
    time_step: Float[Array, "..."]
    obstacles: tuple[Obstacle, ...] = (Table(),)
    self_contact: SelfContact | None = None

    @property
    def floor(self) -> Float[Array, "..."]:
        """Lowest height of a particle above the table, metres; minus infinity without a table."""
        return self.radius if has_table(self.obstacles) else jnp.full_like(self.radius, -jnp.inf)


def make_simulation(
    body: Body,
    time_step: float = 2e-3,
    gravity: float = 9.81,
    *,
    obstacles: Sequence[Obstacle] = (Table(),),
    self_contact: bool = False,
    top_speed: float = TOP_SPEED,
) -> Simulation:
    """The simulation of a body.

    Args:
        body: body to simulate.
        time_step: time step, seconds, at most `largest_time_step(body)`.
        gravity: downward acceleration, metres per second squared.
        obstacles: rigid bodies at rest, in the order in which they act; the table by default.
        self_contact: whether layers rest on each other and rub, see `make_self_contact`; the
            body passes through itself otherwise.
        top_speed: largest speed of a picker, metres per second; for self-contact only.

    Raises:
        ValueError: if the time step is below `LEAST_TIME_STEP`, or is unstable for the body's
            stiffness, damping, drag and mass; if another number, or one of an obstacle, is out of
            its range; if an obstacle is too small for the body's spacing; or if the body has no
            thickness, or pickers are too fast, for self-contact.
    """
    largest = largest_time_step(body)
    given = as_reals(time_step)
    if given is None or given.ndim:
        require_number("time_step", time_step, 0.0, largest, "s")
    if not LEAST_TIME_STEP <= time_step <= largest:
        # Round down, so that the time step in the message is stable.
        raise ValueError(
            f"time_step is {time_step:.4g} s; this {body.name} is stable from "
            f"{LEAST_TIME_STEP:g} to {largest * (1 - 5e-4):.4g} s. Take a smaller time step, a "
            f"lower stiffness or damping, or a larger mass"
        )
    require_number("gravity", gravity, -MOST_GRAVITY, MOST_GRAVITY, "m/s^2, downward")
    require_flag("self_contact", self_contact)
    require_number("top_speed", top_speed, LEAST_SPEED, MOST_SPEED, "m/s")

    def array(value: float | np.ndarray) -> Array:
        return jnp.asarray(value, dtype=float)

    return Simulation(
        springs=make_springs(body),
        rest=array(body.rest),
        mass=array(body.mass),
        radius=array(body.radius),
        drag=array(body.material.drag),
        friction=array(body.material.friction),
        gravity=array(gravity),
        time_step=array(time_step),
        obstacles=make_obstacles(obstacles, body),
        self_contact=(
            make_self_contact(body, time_step, top_speed=top_speed) if self_contact else None
        ),
    )


def at_rest(position: Float[Array | np.ndarray, "N 3"]) -> State:
    """The state with these positions, metres, and no velocity; for a batch `jax.vmap` it.

    Raises:
        ValueError: if they are no numbers, or have another shape.
    """
    array = jnp.asarray(require_positions("position", position), dtype=float)
    return State(array, jnp.zeros_like(array))


def require_state(state: Any, num_particles: int) -> State:
    """A state of a body as arrays, checked; under `jit` and `vmap` its shapes and types alone.

    Raises:
        ValueError: if it is no `State`, or its positions or velocities are not those of
            `num_particles` particles, or not finite.
    """
    if not isinstance(state, State):
        raise ValueError(
            f"the state is a {type(state).__name__}; give at_rest(position), or "
            f"State(position, velocity)"
        )
    arrays = {}
    for name, unit in (("position", "m"), ("velocity", "m/s")):
        told = f"the {name} of the state"
        arrays[name] = require_positions(told, getattr(state, name), num_particles)
        require_known(f"state.{name}", arrays[name], unit)
    missed = as_array("the number missed of the state", state.missed)
    return dataclasses.replace(state, missed=missed, **arrays)


def largest_time_step(body: Body) -> float:
    """The largest stable time step, seconds, whatever the body's configuration.

    Semi-implicit Euler on `x'' = -K x - C x'` is stable while `4 - 2 c dt - k dt^2 >= 0` and
    `c dt <= 2` for every Rayleigh quotient `k` of K and `c` of C. In any configuration the
    stiffness of a spring is at most `k I`, so K is bounded by the graph Laplacian of the
    springs, weighted by stiffness and scaled by mass, and C by that weighted by damping, plus
    drag. A body along a line whose damping is in proportion to its stiffness attains the bound.

    The bound holds for each fixed configuration. A body with almost no damping (a spring under
    3 % of critical) also gains energy, slowly, as its configuration changes between steps; half
    the time step is safe for it.
    """
    k = _largest_eigenvalue(body, body.stiffness)
    c = _largest_eigenvalue(body, body.damping) + body.material.drag
    # The positive root of k dt^2 + 2 c dt - 4 = 0, in a form that allows k = 0; it is
    # never beyond 2 / c.
    denominator = c + np.sqrt(c**2 + 4 * k)
    with np.errstate(over="ignore", divide="ignore"):
        return float(np.divide(4.0, denominator))  # infinite where nothing acts


def _largest_eigenvalue(body: Body, weight: np.ndarray) -> float:
    """Largest eigenvalue of the mass-scaled graph Laplacian of the springs, per unit of mass."""
    from scipy import sparse

    if not weight.any():
        return 0.0
    count, scale = body.num_particles, 1 / np.sqrt(body.mass)
    first, second = body.springs.T
    rows = np.concatenate([first, second, first, second])
    columns = np.concatenate([first, second, second, first])
    values = np.concatenate([weight, weight, -weight, -weight]) * scale[rows] * scale[columns]
    laplacian = sparse.csr_array((values, (rows, columns)), shape=(count, count))
    if count < 64:
        return float(np.linalg.eigvalsh(laplacian.toarray())[-1])
    # A fixed start vector makes the result the same at every call.
    start = np.random.default_rng(0).standard_normal(count)
    tolerance = 1e-4
    found = sparse.linalg.eigsh(
        laplacian, k=1, which="LA", v0=start, tol=tolerance, return_eigenvectors=False
    )
    return float(found[0]) * (1 + tolerance)
