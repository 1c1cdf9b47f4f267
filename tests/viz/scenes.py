"""Scenes for tests of views."""

import numpy as np

from jaxsimp import goals
from jaxsimp.bodies import Body, cloth
from jaxsimp.engines import Trajectory
from jaxsimp.viz import Scene


def lifted(body: Body, goal: np.ndarray, title: str = "a lift", **options: object) -> Scene:
    """A scene: the body rises by 0.2 m in a second, one particle held; then it falls."""
    times = np.linspace(0.0, 1.5, 16)
    height = 0.2 * np.minimum(times, np.maximum(3 - 2 * times, 0.0))
    positions = goals.flat(body) + height[:, None, None] * np.array([0.0, 0.0, 1.0])
    held = np.where(np.arange(15) < 10, 0, -1)[:, None]
    return Scene(title, body, goal, Trajectory(times, positions, held), **options)


def folded_cloth() -> Scene:
    """A small cloth with all that a scene may have."""
    body = cloth((9, 9))
    goal = goals.fold_sequence(body, goals.rectangle_folds(body, "diagonal"))
    return lifted(body, goal, key_points=[0, 8, 72, 80], score=0.9, costs=[0.3, 0.2, 0.1])
