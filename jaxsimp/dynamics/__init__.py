"""Differentiable mass-spring dynamics: a body and actions become motion."""

from jaxsimp.dynamics.contact.obstacles import (
    Box,
    Capsule,
    Obstacle,
    Plane,
    Sphere,
    Table,
    least_radius,
    table_with_edge,
)
from jaxsimp.dynamics.pickers import NONE, Actions, Pickers, Pinch, make_pickers
from jaxsimp.dynamics.rollouts import rollout, rollout_in_frames, rollout_observing, settle
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
    "Box",
    "Capsule",
    "Obstacle",
    "Pickers",
    "Pinch",
    "Plane",
    "Simulation",
    "Sphere",
    "State",
    "Table",
    "at_rest",
    "largest_time_step",
    "least_radius",
    "make_pickers",
    "make_simulation",
    "rollout",
    "rollout_in_frames",
    "rollout_observing",
    "settle",
    "table_with_edge",
]
