"""jaxsimp: plan how to grasp and move rope and cloth, on a laptop's CPU.

A goal (where every particle should end) is reduced to a few key points; they mask the action
tensor; a planner searches actions by rolling a population through differentiable dynamics.

    import jaxsimp as js

`js` offers the names below and the rooms they are from (`js.goals`, `js.viz`, ...). A name is
loaded when it is first used, so that `import jaxsimp` itself imports no other library.

Words and axes, everywhere: `N` particles, `K` key points, `T` actions in a plan, `G` pickers,
`B` population, `S` springs, `F` triangles; the last axis of length 3 is x, y, z with z up.
Units are SI. `key` is a JAX PRNG key, `num_*` a count, `*_fn` a callable.
"""

from typing import TYPE_CHECKING

# A name of the face stands in three places: here for people and type checkers, in `__all__`, and
# in the table of rooms at the end. tests/test_face.py compares them.
if TYPE_CHECKING:
    from jaxsimp import (
        bodies,
        calibration,
        dynamics,
        engines,
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
        Pickers,
        Simulation,
        State,
        at_rest,
        largest_time_step,
        make_pickers,
        make_simulation,
        rollout,
        settle,
    )
    from jaxsimp.engines import Engine, Ensemble, MassSprings, Spread, make_ensemble
    from jaxsimp.engines.mjx import MJX, compare_with_mjx
    from jaxsimp.engines.mujoco import Replay, ReplayStatus, make_model, replay, save_mjcf
    from jaxsimp.planning import (
        ENCODINGS,
        ActionSpace,
        Categorical,
        CEMConfig,
        Encoding,
        Execution,
        GaussianIndex,
        Joint,
        Layout,
        Plan,
        Planner,
        PopulationMap,
        Search,
        default_layout,
        load_plan,
        save_plan,
        search,
    )
    from jaxsimp.simplification import (
        METHODS,
        FitStatus,
        KeyPoints,
        Workspace,
        simplify,
        simplify_batch,
    )
    from jaxsimp.tasks import (
        Episode,
        Task,
        make_task,
        register,
        score,
        task_names,
    )

    __version__: str

__all__ = [
    "ENCODINGS",
    "METHODS",
    "MJX",
    "NONE",
    "ActionSpace",
    "Actions",
    "Body",
    "CEMConfig",
    "Calibration",
    "CalibrationConfig",
    "Categorical",
    "Encoding",
    "Engine",
    "Ensemble",
    "Episode",
    "Execution",
    "FitStatus",
    "Garment",
    "GaussianIndex",
    "Joint",
    "KeyPoints",
    "Layout",
    "MassSprings",
    "Pickers",
    "Plan",
    "Planner",
    "PopulationMap",
    "Recording",
    "Replay",
    "ReplayStatus",
    "Search",
    "Simulation",
    "Spread",
    "State",
    "Task",
    "Workspace",
    "__version__",
    "at_rest",
    "bodies",
    "calibrate",
    "calibration",
    "cloth",
    "compare_with_mjx",
    "default_layout",
    "dynamics",
    "engines",
    "from_mesh",
    "goals",
    "largest_time_step",
    "load_mesh",
    "load_plan",
    "make_ensemble",
    "make_model",
    "make_pickers",
    "make_simulation",
    "make_task",
    "planning",
    "recording_error",
    "records",
    "register",
    "replay",
    "rollout",
    "rope",
    "rope_along",
    "save_mjcf",
    "save_plan",
    "score",
    "search",
    "settle",
    "simplification",
    "simplify",
    "simplify_batch",
    "simulate_recordings",
    "skirt",
    "t_shirt",
    "task_names",
    "tasks",
    "towel",
    "trousers",
    "viz",
]

_ROOMS = {
    "bodies": "Body Garment cloth from_mesh load_mesh rope rope_along skirt t_shirt towel trousers",
    "calibration": "Calibration CalibrationConfig Recording calibrate recording_error "
    "simulate_recordings",
    "dynamics": "NONE Actions Pickers Simulation State at_rest largest_time_step make_pickers "
    "make_simulation rollout settle",
    "engines": "Engine Ensemble MassSprings Spread make_ensemble",
    "engines.mjx": "MJX compare_with_mjx",
    "engines.mujoco": "Replay ReplayStatus make_model replay save_mjcf",
    "goals": "",
    "planning": "ENCODINGS ActionSpace CEMConfig Categorical Encoding Execution GaussianIndex "
    "Joint Layout Plan Planner PopulationMap Search default_layout load_plan save_plan search",
    "records": "",
    "simplification": "METHODS FitStatus KeyPoints Workspace simplify simplify_batch",
    "tasks": "Episode Task make_task register score task_names",
    "viz": "",
}
"""What the face offers: of each room the names that users need without naming the room."""

if not TYPE_CHECKING:  # a type checker that saw this function would accept every name
    _ROOM_OF = {name: room for room, names in _ROOMS.items() for name in names.split()}

    def __getattr__(name: str) -> object:
        """Load a name of the face when it is first used (PEP 562)."""
        from importlib import import_module

        if name in _ROOM_OF:
            value = getattr(import_module(f"{__name__}.{_ROOM_OF[name]}"), name)
        elif name in _ROOMS:
            value = import_module(f"{__name__}.{name}")
        elif name == "__version__":
            value = _version()
        else:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        globals()[name] = value  # the next use does not come here
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
