"""Planning: a task and the particles that may be grasped become a plan."""

from jaxsimp.planning.actions import ENCODINGS, ActionSpace, Categorical, Encoding, GaussianIndex
from jaxsimp.planning.cem import CEMConfig, Search, search
from jaxsimp.planning.engine import Engine, MassSprings
from jaxsimp.planning.ensemble import Ensemble, Spread, make_ensemble
from jaxsimp.planning.plan import Execution, Plan, Planner, load_plan, save_plan
from jaxsimp.planning.population import Layout, PopulationMap, default_layout

__all__ = [
    "ENCODINGS",
    "ActionSpace",
    "CEMConfig",
    "Categorical",
    "Encoding",
    "Engine",
    "Ensemble",
    "Execution",
    "GaussianIndex",
    "Layout",
    "MassSprings",
    "Plan",
    "Planner",
    "PopulationMap",
    "Search",
    "Spread",
    "default_layout",
    "load_plan",
    "make_ensemble",
    "save_plan",
    "search",
]
