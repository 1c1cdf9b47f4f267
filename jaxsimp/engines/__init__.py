"""Physics engines that we did not write. MuJoCo is imported when one is first asked for."""

from jaxsimp.engines.mjx import (
    MJX,
    MJXSimulation,
    make_mjx_simulation,
    mjx_accelerations,
    mjx_rollout,
    mjx_trajectory,
)
from jaxsimp.engines.oracle import Disagreement, compare_with_mjx
from jaxsimp.engines.tendons import tendon_spec

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
