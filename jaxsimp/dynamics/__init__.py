"""Differentiable mass-spring dynamics: a body and actions become motion."""

from jaxsimp.dynamics.pickers import NONE, Actions, Pickers, make_pickers
from jaxsimp.dynamics.rollouts import rollout, rollout_observing, settle
from jaxsimp.dynamics.simulation import (
    Simulation,
    State,
    at_rest,
    largest_time_step,
    make_simulation,
)

__all__ = [
    "NONE",
    "Actions",
    "Pickers",
    "Simulation",
    "State",
    "at_rest",
    "largest_time_step",
    "make_pickers",
    "make_simulation",
    "rollout",
    "rollout_observing",
    "settle",
]
