"""Pictures."""

from typing import Any

import numpy as np
from hypothesis import strategies as st

import jaxsimp as js
from jaxsimp import viz
from tests.fuzz.core import Door, Parameter
from tests.fuzz.doors.goals import CLOTH, GOALS, ROPE
from tests.fuzz.valid import both, is_array
from tests.fuzz.values import array

POINTS = js.simplify(ROPE, GOALS[id(ROPE)][1])
RUNS = np.array([[3.0, 2.0, 1.0], [3.5, 2.5, 0.5]])
SCORES = np.array([[0.9, 0.8], [0.5, np.nan]])
FOLDED = GOALS[id(CLOTH)][1]
FRAMES = np.stack([GOALS[id(CLOTH)][0]] * 3)


def _drawn(function: Any, *arguments: Any) -> Any:
    """A figure, drawn without a display."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    try:
        figure = function(*arguments)
        figure.canvas.draw()
        return figure
    finally:
        plt.close("all")


def _costs(runs: Any, name: Any = "task") -> Any:
    return _drawn(viz.plot_costs, {name: {"method": runs}})


def _scores(pairs: Any, success: Any = 0.8) -> Any:
    return _drawn(viz.plot_scores, {"task": {"method": pairs}}, "x", "y", success)


def _model(goal: Any, name: Any = "goal") -> Any:
    return _drawn(viz.plot_simplifications, {name: (ROPE, goal, POINTS)})


def _executions(frames: Any, score: Any = 0.5, goal: Any = FOLDED) -> Any:
    return _drawn(viz.plot_executions, CLOTH, goal, {"method": (frames, score)}, "title")


NAMES = Parameter(
    st.sampled_from(("task", "a_b")), st.sampled_from(("$x", "", "{", "x" * 300, "\\", "é", "\0"))
)

DOORS = (
    Door(
        "viz.plot_costs",
        _costs,
        {"runs": array(st.just(RUNS)), "name": NAMES},
        lambda runs, name="task": both(is_array(runs, (None, None)) is not False or None, None),
        weight=2,
    ),
    Door(
        "viz.plot_scores",
        _scores,
        {"pairs": array(st.just(SCORES))},
        lambda pairs: None,
        weight=2,
    ),
    Door(
        "viz.plot_simplifications",
        _model,
        {"goal": array(st.just(GOALS[id(ROPE)][1])), "name": NAMES},
        lambda goal, name="goal": None,
        weight=2,
    ),
    Door(
        "viz.plot_executions",
        _executions,
        {"frames": array(st.just(FRAMES)), "goal": array(st.just(FRAMES[0]), optional=True)},
        lambda frames, goal=None: None,
        weight=1,
    ),
)
