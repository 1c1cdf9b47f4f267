"""jaxsimp itself: its rollout, run by its PopulationMap."""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from experiments.benchmark.peers.workload import GRAVITY, Workload
from jaxsimp.dynamics import (
    Actions,
    Pickers,
    Simulation,
    at_rest,
    make_pickers,
    make_simulation,
    rollout,
)
from jaxsimp.engines import Layout, PopulationMap, default_layout, spring_chunk_size

Physics = tuple[Simulation, Pickers, Array]
"""A simulation, its pickers, and the positions at the start."""


def prepare(workload: Workload, layout: Layout | None = None) -> Callable[[], np.ndarray]:
    """A function giving the final positions, shape (B, N, 3), metres.

    Args:
        workload: workload to compute.
        layout: layout of the population; jaxsimp's own choice by default.
    """
    shared, actions = physics(workload), plans(workload)
    layout = layout or default_layout(workload.population, spring_chunk_size(shared[0]))
    mapped = PopulationMap(final_position, shared, actions, layout)
    return lambda: mapped(shared, actions)


def final_position(physics: Physics, actions: Actions) -> Array:
    """Positions at the end of one plan, shape (N, 3), metres."""
    simulation, pickers, start = physics
    return rollout(simulation, pickers, at_rest(start), actions)[0].position


def physics(workload: Workload) -> Physics:
    """The workload's physics, with pickers whose limits do not bind."""
    pickers = make_pickers((1.0, 1.0, 1.0), max_stretch=1e6, steps=workload.action_steps)
    simulation = make_simulation(workload.body, workload.time_step, GRAVITY)
    return simulation, pickers, jnp.asarray(workload.start, dtype=float)


def plans(workload: Workload) -> Actions:
    """The workload's plans, leading axis `B`."""
    return Actions(jnp.asarray(workload.pick), jnp.asarray(workload.displacement, dtype=float))
