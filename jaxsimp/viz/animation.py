"""Moving pages: one HTML file that opens in any browser, without Python and without a network."""

import base64
import json
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt16

from jaxsimp.checks import require_path
from jaxsimp.dynamics import Obstacle, Table
from jaxsimp.records import write_text
from jaxsimp.viz.scene import Scene
from jaxsimp.viz.shapes import CELLS, obstacle_mesh, outline, shown_faces, shown_radius

MOST_PANELS = 12
"""Most scenes in one page or video."""
MOST_COORDINATES = 50_000_000
"""Most coordinates in one page, 133 MB of text: a browser still opens it."""
LEVELS = 2**16 - 1
"""Largest whole number of a quantised coordinate."""


def animate(path: str | Path, scenes: Scene | Sequence[Scene]) -> None:
    """Write scenes beside one another as a page that moves.

    The page is one file of HTML, with WebGL code of its own. Play and stop it, draw the time, turn
    and zoom with the mouse. `PAGE.html#t=1.5` opens at 1.5 s and stands still.

    Args:
        path: path of the file.
        scenes: what to show; see `make_scene`, `scene_of_plan` and `scene_of_goal`.

    Raises:
        ValueError: if there are no scenes, or more than a page holds.
        OSError: if the file cannot be written.
    """
    path, shown = Path(path), require_scenes(scenes)
    require_path(path, "give the path of a file that can be written")
    count = sum(scene.trajectory.positions.size for scene in shown)
    if count > MOST_COORDINATES:
        raise ValueError(
            f"the scenes have {count:,} coordinates in all their frames, and a page holds "
            f"{MOST_COORDINATES:,}; give fewer scenes, or fewer frames per second"
        )
    page = resources.files("jaxsimp.viz").joinpath("page.html").read_text(encoding="utf-8")
    # No text of a scene ends the script: JSON may write any character by its number.
    panels = json.dumps([_panel(scene) for scene in shown]).replace("<", "\\u003c")
    write_text(path, page.replace("/*PANELS*/[]", panels))


def require_scenes(scenes: Any) -> list[Scene]:
    """Scenes as a list.

    Raises:
        ValueError: if there are none, more than `MOST_PANELS`, or something else.
    """
    shown = [scenes] if isinstance(scenes, Scene) else scenes
    if not isinstance(shown, Sequence) or not all(isinstance(each, Scene) for each in shown):
        raise ValueError(f"scenes is {scenes!r}; give a Scene or a list of them, see make_scene")
    require_count_of_scenes(len(shown))
    return list(shown)


def require_count_of_scenes(count: int) -> None:
    """Raise a `ValueError` for no scenes, or more than `MOST_PANELS`."""
    if not 1 <= count <= MOST_PANELS:
        raise ValueError(
            f"{count} scenes are given; give 1 to {MOST_PANELS}, to be seen beside one another"
        )


def quantised(
    positions: Float[np.ndarray, "... 3"], low: Float[np.ndarray, "3"], step: float
) -> UInt16[np.ndarray, "... 3"]:
    """Coordinates as whole multiples of a step, from the lowest corner."""
    return np.rint((positions - low) / step).clip(0, LEVELS).astype(np.uint16)


def quantum(limits: Float[np.ndarray, "2 3"]) -> float:
    """The step of coordinates within limits, metres: 0.03 mm for an extent of 2 m."""
    return float(max(np.ptp(limits, axis=0).max(), 1e-6)) / LEVELS


def _panel(scene: Scene) -> dict[str, Any]:
    """What the page needs to draw a scene."""
    body, motion, limits = scene.body, scene.trajectory, scene.limits
    low, step = limits[0], quantum(limits)
    return {
        "title": scene.title,
        "caption": scene.caption,
        "low": low.tolist(),
        "high": limits[1].tolist(),
        "step": step,
        "times": motion.times.tolist(),
        "positions": _text(quantised(motion.positions, low, step)),
        "goal": _text(quantised(scene.goal, low, step)),
        "held": motion.held.tolist(),
        "keyPoints": scene.key_points.tolist(),
        "faces": _text(shown_faces(body).astype("<u4")),
        "outline": _text(outline(body).astype("<u4")),
        "weave": _text(body.rest[:, :2].astype("<f4")) if len(body.faces) else "",
        "cell": body.size / CELLS if len(body.faces) else 0.0,
        "radius": shown_radius(body),
        "table": any(isinstance(each, Table) for each in scene.obstacles),
        "obstacles": [
            _obstacle(each, limits) for each in scene.obstacles if not isinstance(each, Table)
        ],
        "costs": scene.costs.tolist(),
    }


def _obstacle(obstacle: Obstacle, limits: Float[np.ndarray, "2 3"]) -> dict[str, str]:
    mesh = obstacle_mesh(obstacle, limits)
    return {
        "points": _text(mesh.points.astype("<f4")),
        "normals": _text(mesh.normals.astype("<f4")),
        "faces": _text(mesh.faces.astype("<u4")),
    }


def _text(array: np.ndarray) -> str:
    """The bytes of an array in base64, little-endian as all browsers are."""
    little = array.astype(array.dtype.newbyteorder("<"))
    return base64.b64encode(np.ascontiguousarray(little).tobytes()).decode("ascii")
