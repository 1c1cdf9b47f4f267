"""jaxsimp: plan how to grasp and move rope and cloth, on a laptop's CPU.

A goal (the final position of every particle) is reduced to a few key points; they mask the action
tensor; a planner searches actions with rollouts of a population in differentiable dynamics.

    import jaxsimp as js

`js` has the names below and their rooms, the subpackages (`js.goals`, `js.viz`, ...). Each name
is loaded at first use, so that `import jaxsimp` itself imports no other library.

Words and axes, everywhere: `N` particles, `K` key points, `T` actions in a plan, `G` pickers,
`B` population, `S` springs, `F` triangles; the last axis of length 3 is x, y, z with z up.
Units are SI. `key` is a JAX PRNG key, `num_*` a count, `*_fn` a callable.
"""

from typing import TYPE_CHECKING

# The face lists each name in three places: here for readers and type checkers, in `__all__`, and
# in the table of rooms at the end. tests/test_face.py compares them.
if TYPE_CHECKING:
    from jaxsimp import (
        bodies,
        calibration,
        dynamics,
        engines,
        envs,
        goal_plan,
        goals,
        planning,
        records,
        simplification,
        tasks,
        viz,
    )
    from jaxsimp.bodies import (
        Body,
        Garment,
        Material,
        cloth,
        from_mesh,
        load_mesh,
        rope,
        rope_along,
        skirt,
        t_shirt,
        towel,
        trousers,
    )
    from jaxsimp.calibration import (
        Calibration,
        CalibrationConfig,
        Recording,
        calibrate,
        recording_error,
        simulate_recordings,
    )
    from jaxsimp.dynamics import (
        NONE,
        Actions,
        Box,
        Capsule,
        Obstacle,
        Pickers,
        Pinch,
        Plane,
        Simulation,
        Sphere,
        State,
        Table,
        at_rest,
        largest_time_step,
        least_radius,
        make_pickers,
        make_simulation,
        rollout,
        settle,
        table_with_edge,
    )
    from jaxsimp.engines import (
        MJX,
        Engine,
        Ensemble,
        Execution,
        ExecutionStatus,
        GoalScores,
        Layout,
        MassSprings,
        MuJoCo,
        SearchEngine,
        Spread,
        compare_with_mjx,
        goal_scores,
        make_ensemble,
        replay,
    )
    from jaxsimp.engines.mujoco import make_model, save_mjcf
    from jaxsimp.envs import Env, make_env
    from jaxsimp.goal_plan import GoalPlan, GoalPlanner, goal_planner, plan, plan_batch
    from jaxsimp.goals import Subgoal, find_folds, same_folds, subgoals
    from jaxsimp.planning import (
        CEM,
        ENCODINGS,
        ActionSpace,
        Algorithm,
        Categorical,
        CoarseToFinePlanner,
        Descent,
        Encoding,
        GaussianIndex,
        Joint,
        LocalSearch,
        Optimum,
        Plan,
        Planner,
        Plans,
        RandomShooting,
        Reranking,
        Sequence,
        StagedPlanner,
        carry_over,
        default_algorithm,
        make_problem,
        optimize,
        search_on_host,
    )
    from jaxsimp.records import SavedPlan, load_plan, save_plan
    from jaxsimp.simplification import (
        METHODS,
        FitStatus,
        KeyPoints,
        Workspace,
        simplify,
        simplify_batch,
    )
    from jaxsimp.tasks import Episode, Task, make_task, reach, register, score, task_names

    __version__: str

__all__ = [
    "CEM",
    "ENCODINGS",
    "METHODS",
    "MJX",
    "NONE",
    "ActionSpace",
    "Actions",
    "Algorithm",
    "Body",
    "Box",
    "Calibration",
    "CalibrationConfig",
    "Capsule",
    "Categorical",
    "CoarseToFinePlanner",
    "Descent",
    "Encoding",
    "Engine",
    "Ensemble",
    "Env",
    "Episode",
    "Execution",
    "ExecutionStatus",
    "FitStatus",
    "Garment",
    "GaussianIndex",
    "GoalPlan",
    "GoalPlanner",
    "GoalScores",
    "Joint",
    "KeyPoints",
    "Layout",
    "LocalSearch",
    "MassSprings",
    "Material",
    "MuJoCo",
    "Obstacle",
    "Optimum",
    "Pickers",
    "Pinch",
    "Plan",
    "Plane",
    "Planner",
    "Plans",
    "RandomShooting",
    "Recording",
    "Reranking",
    "SavedPlan",
    "SearchEngine",
    "Sequence",
    "Simulation",
    "Sphere",
    "Spread",
    "StagedPlanner",
    "State",
    "Subgoal",
    "Table",
    "Task",
    "Workspace",
    "__version__",
    "at_rest",
    "bodies",
    "calibrate",
    "calibration",
    "carry_over",
    "cloth",
    "compare_with_mjx",
    "default_algorithm",
    "dynamics",
    "engines",
    "envs",
    "find_folds",
    "from_mesh",
    "goal_plan",
    "goal_planner",
    "goal_scores",
    "goals",
    "largest_time_step",
    "least_radius",
    "load_mesh",
    "load_plan",
    "make_ensemble",
    "make_env",
    "make_model",
    "make_pickers",
    "make_problem",
    "make_simulation",
    "make_task",
    "optimize",
    "plan",
    "plan_batch",
    "planning",
    "reach",
    "recording_error",
    "records",
    "register",
    "replay",
    "rollout",
    "rope",
    "rope_along",
    "same_folds",
    "save_mjcf",
    "save_plan",
    "score",
    "search_on_host",
    "settle",
    "simplification",
    "simplify",
    "simplify_batch",
    "simulate_recordings",
    "skirt",
    "subgoals",
    "t_shirt",
    "table_with_edge",
    "task_names",
    "tasks",
    "towel",
    "trousers",
    "viz",
]

_ROOMS = {
    "bodies": "Body Garment Material cloth from_mesh load_mesh rope rope_along skirt t_shirt "
    "towel trousers",
    "calibration": "Calibration CalibrationConfig Recording calibrate recording_error "
    "simulate_recordings",
    "dynamics": "NONE Actions Box Capsule Obstacle Pickers Pinch Plane Simulation Sphere State "
    "Table at_rest largest_time_step least_radius make_pickers make_simulation rollout settle "
    "table_with_edge",
    "engines": "Engine Ensemble Execution ExecutionStatus GoalScores Layout MassSprings MJX MuJoCo "
    "SearchEngine Spread compare_with_mjx goal_scores make_ensemble replay",
    "engines.mujoco": "make_model save_mjcf",
    "envs": "Env make_env",
    "goal_plan": "GoalPlan GoalPlanner goal_planner plan plan_batch",
    "goals": "Subgoal find_folds same_folds subgoals",
    "planning": "CEM ENCODINGS ActionSpace Algorithm Categorical CoarseToFinePlanner Descent "
    "Encoding GaussianIndex Joint LocalSearch Optimum Plan Planner Plans RandomShooting "
    "Reranking Sequence StagedPlanner carry_over default_algorithm make_problem optimize "
    "search_on_host",
    "records": "SavedPlan load_plan save_plan",
    "simplification": "METHODS FitStatus KeyPoints Workspace simplify simplify_batch",
    "tasks": "Episode Task make_task reach register score task_names",
    "viz": "",
}
"""Names of the face: for each room the names that `jaxsimp` exports directly."""

if not TYPE_CHECKING:  # a type checker that saw this function would accept every name
    _ROOM_OF = {name: room for room, names in _ROOMS.items() for name in names.split()}

    def __getattr__(name: str) -> object:
        """Load a name of the face at its first use (PEP 562)."""
        from importlib import import_module

        if name in _ROOM_OF:
            value = getattr(import_module(f"{__name__}.{_ROOM_OF[name]}"), name)
        elif name in _ROOMS:
            value = import_module(f"{__name__}.{name}")
        elif name == "__version__":
            value = _version()
        else:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        globals()[name] = value  # later uses do not call this function
        return value


def __dir__() -> list[str]:
    return sorted(__all__)


def _version() -> str:
    """The version in the package's metadata; "0+unknown" for files that are not installed."""
    from importlib import metadata

    try:
        return metadata.version("jaxsimp")
    except metadata.PackageNotFoundError:
        return "0+unknown"
