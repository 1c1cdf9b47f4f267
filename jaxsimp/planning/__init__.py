"""Planning: a task and the particles that may be grasped become a plan."""

from jaxsimp.planning.cem import CEMConfig, Search, search
from jaxsimp.planning.encodings import (
    ENCODINGS,
    ActionSpace,
    Categorical,
    Encoding,
    GaussianIndex,
    Joint,
)
from jaxsimp.planning.evaluate import Layout, PopulationMap, default_layout
from jaxsimp.planning.plan import Execution, Plan, Planner, load_plan, save_plan

__all__ = [
    "ENCODINGS",
    "ActionSpace",
    "CEMConfig",
    "Categorical",
    "Encoding",
    "Execution",
    "GaussianIndex",
    "Joint",
    "Layout",
    "Plan",
    "Planner",
    "PopulationMap",
    "Search",
    "default_layout",
    "load_plan",
    "save_plan",
    "search",
]
