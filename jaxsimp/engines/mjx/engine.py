"""MJX, MuJoCo in JAX, as a reference for our dynamics and as an engine of the planner.

`tendon_spec` gives the model of a body. MJX computes accelerations and takes the Euler steps; to
carry out plans, our obstacles and our pickers correct the velocities of each step, as in our own
dynamics: MJX has contacts of its own, but each costs rows of a constraint solver, and their
friction is not Coulomb's. So MJX checks springs, gravity, drag and integration, but not contact.
Gradients are not supported.
"""

import contextlib
import io
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from jaxsimp.bodies import Body
from jaxsimp.checks import require_count
from jaxsimp.dynamics import (
    Actions,
    Obstacle,
    Pickers,
    Simulation,
    State,
    Table,
    make_simulation,
)
from jaxsimp.dynamics.contact.rigid import contact
from jaxsimp.dynamics.pickers import grasp, require_actions, speed_profile
from jaxsimp.dynamics.simulation import require_state
from jaxsimp.engines.engine import Executor, Observe
from jaxsimp.engines.mjx.tendons import tendon_spec
from jaxsimp.engines.rollouts import RolloutExecutor
from jaxsimp.engines.springs import CHUNK_SIZE
from jaxsimp.tasks import Task

MOST_PARTICLES = 100
"""Largest number of particles: the cost of a step is in proportion to springs times particles. In
plans on a CPU a step takes about 50 times as long as ours for a rope of 11 particles, 1000 times
for a 9 x 9 cloth."""


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["model", "data", "ours"],
    meta_fields=[],
)
@dataclass(frozen=True)
class MJXSimulation:
    """A body's physics in MJX, and in our dynamics for obstacles and pickers.

    Attributes:
        model: a `mujoco.mjx.Model`.
        data: a `mujoco.mjx.Data` that receives states.
        ours: the body's simulation in our dynamics, for our obstacles and pickers.
    """

    model: Any
    data: Any
    ours: Simulation

    @property
    def time_step(self) -> Float[Array, "..."]:
        """Time step, seconds."""
        return self.model.opt.timestep


def make_mjx_simulation(
    body: Body,
    time_step: float = 2e-3,
    gravity: float = 9.81,
    *,
    obstacles: Sequence[Obstacle] = (Table(),),
) -> MJXSimulation:
    """The simulation of a body in MJX.

    Args:
        body: body to simulate.
        time_step: time step, seconds, at most `jaxsimp.dynamics.largest_time_step(body)`.
        gravity: downward acceleration, metres per second squared.
        obstacles: rigid bodies at rest, in the order in which they act; our contact.

    Raises:
        ValueError: if the body has more than `MOST_PARTICLES` particles, or
            `jaxsimp.dynamics.make_simulation` raises.
    """
    if body.num_particles > MOST_PARTICLES:
        raise ValueError(
            f"the {body.name} has {body.num_particles} particles; MJX takes at most "
            f"{MOST_PARTICLES}, as its steps are slow. Take fewer particles, or our own "
            f"dynamics"
        )
    ours = make_simulation(body, time_step, gravity, obstacles=obstacles)
    model = to_mjx(tendon_spec(body, time_step, gravity).compile())
    return MJXSimulation(model, _mjx().make_data(model, impl="jax"), ours)


def to_mjx(model: Any) -> Any:
    """A `mujoco.MjModel` as a `mujoco.mjx.Model`.

    Raises:
        ValueError: if the model has a flex: MJX has none.
    """
    if model.nflex:
        raise ValueError(
            f"the model has {model.nflex} flex; MJX has none. Make the body of tendons "
            f"(tendon_spec), or simulate it in MuJoCo itself"
        )
    return _mjx().put_model(model, impl="jax")


def mjx_accelerations(simulation: MJXSimulation, state: State) -> Float[Array, "N 3"]:
    """Accelerations without obstacles and pickers, metres per second squared."""
    data = _mjx().forward(simulation.model, _loaded(simulation, state))
    return data.qacc.reshape(state.position.shape)


def mjx_trajectory(
    simulation: MJXSimulation, state: State, num_steps: int
) -> tuple[State, Float[Array, "T N 3"]]:
    """Motion by MJX alone, without obstacles and pickers.

    Returns:
        States after each of `num_steps` steps, and the accelerations in those steps, stacked along
        a first axis.

    Raises:
        ValueError: if `num_steps` is no whole number.
    """
    num_steps = require_count("num_steps", num_steps, 0)

    def one(state: State, _: None) -> tuple[State, tuple[State, Float[Array, "N 3"]]]:
        state, acceleration = _free_step(simulation, state)
        return state, (state, acceleration)

    return jax.lax.scan(one, state, length=num_steps)[1]


def mjx_rollout(
    simulation: MJXSimulation,
    pickers: Pickers,
    state: State,
    actions: Actions,
    observe: Observe = lambda state, action: state.position,
) -> tuple[State, PyTree[Any]]:
    """Carry out a plan in MJX; arguments and result are those of `SearchEngine.rollout`.

    Raises:
        ValueError: if `jaxsimp.dynamics.pickers.require_actions` refuses the plan, or
            `jaxsimp.dynamics.simulation.require_state` the state.
    """
    state = require_state(state, len(simulation.ours.mass))
    actions = require_actions(actions, len(simulation.ours.mass))

    def act(state: State, action: Actions) -> tuple[State, PyTree[Any]]:
        ours = simulation.ours
        around = ours.rest, ours.obstacles, ours.radius
        held, displacement = grasp(pickers, *around, state.position, action)
        drive = displacement / simulation.time_step

        def one(state: State, share: Float[Array, ""]) -> tuple[State, None]:
            return _step(simulation, state, held, drive * share), None

        state, _ = jax.lax.scan(one, state, speed_profile(pickers.steps))
        return state, observe(state, action)

    return jax.lax.scan(act, state, actions)


def _step(
    simulation: MJXSimulation,
    state: State,
    held: Bool[Array, " N"],
    carried: Float[Array, "N 3"],
) -> State:
    """A step of MJX, with velocities after contact; held particles have the velocity `carried`."""
    free = _free_step(simulation, state)[0].velocity
    touched = contact(simulation.ours, list(state.position.T), list(free.T))
    velocity = jnp.where(held[:, None], carried, jnp.stack(touched, axis=1))
    return State(state.position + simulation.time_step * velocity, velocity)


def _free_step(simulation: MJXSimulation, state: State) -> tuple[State, Float[Array, "N 3"]]:
    """A step of MJX alone, and the accelerations in it."""
    data = _mjx().step(simulation.model, _loaded(simulation, state))
    position, velocity, acceleration = (
        array.reshape(state.position.shape) for array in (data.qpos, data.qvel, data.qacc)
    )
    return State(position, velocity), acceleration


def _loaded(simulation: MJXSimulation, state: State) -> Any:
    """The data of MJX with this state."""
    return simulation.data.replace(qpos=state.position.ravel(), qvel=state.velocity.ravel())


@cache
def _mjx() -> Any:
    """The module `mujoco.mjx`."""
    # The import prints MJX's unavailable parts; keep them off the caller's standard output.
    with contextlib.redirect_stdout(io.StringIO()):
        from mujoco import mjx
    return mjx


@dataclass(frozen=True)
class MJX:
    """MJX as the engine of a planner: `Planner(task, engine=MJX())`.

    For ropes and small cloths, of at most `MOST_PARTICLES` particles, and slow. Bodies pass through
    themselves: MJX has no flexible bodies.
    """

    def physics(self, task: Task) -> tuple[MJXSimulation, Pickers]:
        """The task's simulation in MJX, and its pickers.

        Raises:
            ValueError: if the body has too many particles.
        """
        simulation = make_mjx_simulation(task.body, task.time_step, obstacles=task.obstacles)
        return simulation, task.pickers()

    def rollout(
        self,
        physics: tuple[MJXSimulation, Pickers],
        state: State,
        actions: Actions,
        observe: Observe,
    ) -> tuple[State, PyTree[Any]]:
        """See `mjx_rollout`."""
        return mjx_rollout(*physics, state, actions, observe)

    def risk(self, costs: Float[Array, ""]) -> Float[Array, ""]:
        """The cost itself."""
        return costs

    def chunk_size(self, physics: tuple[MJXSimulation, Pickers]) -> int:
        """The chunk size of our mass-springs; not measured for MJX."""
        return CHUNK_SIZE

    def executor(self, task: Task) -> Executor:
        """See `Engine.executor`."""
        return RolloutExecutor(task, self, self.physics(task))
