"""Engines carry out plans: our mass-springs, ensembles of them, MJX, and MuJoCo."""

from jaxsimp.engines.engine import (
    Engine,
    Execution,
    ExecutionStatus,
    Executor,
    Observe,
    SearchEngine,
    then_idle,
)
from jaxsimp.engines.ensemble import Ensemble, Spread, make_ensemble
from jaxsimp.engines.goals import GoalScores, goal_scores
from jaxsimp.engines.grippers import Waypoint, least_distance, waypoints
from jaxsimp.engines.mjx import MJX, compare_with_mjx
from jaxsimp.engines.mujoco import MuJoCo, replay
from jaxsimp.engines.population import Layout, PopulationMap, default_layout
from jaxsimp.engines.rollouts import RolloutExecutor, plan_cost, settled_cost
from jaxsimp.engines.springs import MassSprings, spring_chunk_size
from jaxsimp.engines.trajectory import FRAMES_PER_SECOND, Recorder, Trajectory, grasps

__all__ = [
    "FRAMES_PER_SECOND",
    "MJX",
    "Engine",
    "Ensemble",
    "Execution",
    "ExecutionStatus",
    "Executor",
    "GoalScores",
    "Layout",
    "MassSprings",
    "MuJoCo",
    "Observe",
    "PopulationMap",
    "Recorder",
    "RolloutExecutor",
    "SearchEngine",
    "Spread",
    "Trajectory",
    "Waypoint",
    "compare_with_mjx",
    "default_layout",
    "goal_scores",
    "grasps",
    "least_distance",
    "make_ensemble",
    "plan_cost",
    "replay",
    "settled_cost",
    "spring_chunk_size",
    "then_idle",
    "waypoints",
]
