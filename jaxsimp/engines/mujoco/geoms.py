"""Obstacles as geoms of MuJoCo.

A rounded box is the union of three boxes, each shorter by the rounding along two axes, and of a
capsule along each of its twelve edges: exactly the same surface.
"""

from collections.abc import Iterator, Sequence
from itertools import product
from typing import Any

import numpy as np

from jaxsimp.dynamics import Box, Capsule, Obstacle, Plane, Sphere, Table

Geom = dict[str, Any]
"""Arguments of `mujoco.MjSpec.worldbody.add_geom`."""


def obstacle_geoms(obstacles: Sequence[Obstacle], grown: float) -> dict[str, Geom]:
    """Geoms by name: `table`, `sphere_1` and so on, by the place of the obstacle.

    Args:
        obstacles: obstacles with arrays for numbers.
        grown: distance by which every surface is moved out, metres.

    Raises:
        ValueError: if an obstacle is of a kind that MuJoCo has no geom for.
    """
    found = {}
    for place, obstacle in enumerate(obstacles):
        kind = type(obstacle).__name__.lower()
        name = kind if isinstance(obstacle, Table) else f"{kind}_{place}"
        for part, geom in enumerate(_geoms(obstacle, grown)):
            found[f"{name}_{part}" if part else name] = geom
    return found


def _geoms(obstacle: Obstacle, grown: float) -> Iterator[Geom]:
    import mujoco

    kinds, wide = mujoco.mjtGeom, [2.0, 2.0, 0.1]
    match obstacle:
        case Table():
            yield {"type": kinds.mjGEOM_PLANE, "size": wide, "pos": [0.0, 0.0, grown]}
        case Plane(point, normal):
            unit = _array(normal) / np.linalg.norm(normal)
            place = _array(point) + grown * unit
            yield {"type": kinds.mjGEOM_PLANE, "size": wide, "pos": place, "zaxis": unit}
        case Sphere(center, radius):
            size = [float(radius) + grown, 0.0, 0.0]
            yield {"type": kinds.mjGEOM_SPHERE, "size": size, "pos": _array(center)}
        case Capsule(start, end, radius):
            yield _capsule(_array(start), _array(end), float(radius) + grown)
        case Box():
            yield from _rounded_box(obstacle, grown)
        case _:
            raise ValueError(
                f"{type(obstacle).__name__} has no geom of MuJoCo; add a case to _geoms in "
                f"engines/mujoco/geoms.py"
            )


def _capsule(start: np.ndarray, end: np.ndarray, radius: float) -> Geom:
    import mujoco

    ends = [*start, *end]
    return {
        "type": mujoco.mjtGeom.mjGEOM_CAPSULE,
        "fromto": ends,
        "size": [radius, 0.0, 0.0],
    }


def _rounded_box(box: Box, grown: float) -> Iterator[Geom]:
    """Three boxes and twelve capsules; one box for sharp edges."""
    import mujoco

    center, rounding = _array(box.center), float(box.rounding) + grown
    core = _array(box.half_sizes) - float(box.rounding)
    half, cos, sin = float(box.turn) / 2, np.cos(float(box.turn)), np.sin(float(box.turn))
    turned = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    for axis in range(3 if rounding > 0 else 1):
        size = core + rounding * np.eye(3)[axis]
        yield {
            "type": mujoco.mjtGeom.mjGEOM_BOX,
            "size": size,
            "pos": center,
            "quat": [np.cos(half), 0.0, 0.0, np.sin(half)],
        }
    for axis, sides in product(range(3), product((-1.0, 1.0), repeat=2)):
        if rounding > 0 and core[axis] > 0:
            corner = core * np.insert(sides, axis, 1.0)
            other = core * np.insert(sides, axis, -1.0)
            yield _capsule(center + turned @ other, center + turned @ corner, rounding)


def _array(values: Any) -> np.ndarray:
    return np.asarray(values, dtype=float)
