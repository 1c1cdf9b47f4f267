"""MJX, MuJoCo in JAX: a reference for our springs; a slow engine for ropes and small cloths."""

from jaxsimp.engines.mjx.comparison import Disagreement, compare_with_mjx
from jaxsimp.engines.mjx.engine import (
    MJX,
    MJXSimulation,
    make_mjx_simulation,
    mjx_accelerations,
    mjx_rollout,
    mjx_trajectory,
)
from jaxsimp.engines.mjx.tendons import tendon_spec

__all__ = [
    "MJX",
    "Disagreement",
    "MJXSimulation",
    "compare_with_mjx",
    "make_mjx_simulation",
    "mjx_accelerations",
    "mjx_rollout",
    "mjx_trajectory",
    "tendon_spec",
]
