"""Small meshes, and whether a mesh is one sheet of metres."""

from functools import cache
from typing import Any

import numpy as np
from hypothesis import strategies as st

from tests.fuzz.valid import as_floats, both, is_array, is_size


@cache
def grid(side: int, size: float = 0.3) -> tuple[np.ndarray, np.ndarray]:
    """A flat square of `side` x `side` points."""
    x, y = np.meshgrid(*(np.linspace(-size / 2, size / 2, side),) * 2, indexing="ij")
    points = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    ids = np.arange(side * side).reshape(side, side)
    corner, right, up = ids[:-1, :-1].ravel(), ids[1:, :-1].ravel(), ids[:-1, 1:].ravel()
    across = ids[1:, 1:].ravel()
    faces = np.concatenate(
        [np.stack([corner, right, up], axis=1), np.stack([right, across, up], axis=1)]
    )
    points.flags.writeable = faces.flags.writeable = False
    return points, faces


def disc() -> tuple[np.ndarray, np.ndarray]:
    """A flat mesh with an uneven outline."""
    points, faces = grid(6)
    return points * np.array([1.0, 0.7, 0.0]) + np.array([0.1, 0.0, 0.0]), faces


def _wavy(seed: int) -> np.ndarray:
    points = grid(4)[0].copy()
    points += np.random.default_rng(seed).normal(scale=5e-3, size=points.shape)
    return points


mesh_points = st.sampled_from([grid(4)[0]]) | st.integers(0, 10**6).map(_wavy)
"""Points for the triangles of `grid(4)`."""


def is_sheet(points: Any, faces: Any, scale: float) -> bool | None:
    """Whether points and triangles are a sheet in metres; None where faults may be repaired."""
    shape, ids = is_array(points, (None, 3)), is_array(faces, (None, 3), "iu")
    if as_floats(points) is not None and ids is not False and np.ndim(points) == 2:
        shape = _of_used(points, faces, shape)
    if shape is False or ids is False or not len(np.asarray(faces)):
        return False
    triangles = np.asarray(faces)
    if triangles.dtype.kind == "f":
        return False
    if triangles.min() < 0 or triangles.max() >= len(points):
        return False
    used = scale * as_floats(points)[np.unique(triangles)]
    if not np.isfinite(used).all():
        return False
    size = is_size(float(np.ptp(used, axis=0).max()))
    own, other = grid(4)
    known = np.array_equal(np.sort(triangles, axis=0), np.sort(other, axis=0))
    near = known and len(points) == len(own) and np.abs(as_floats(points) - own).max() < 0.04
    return both(shape, ids, size, True if near else None)


def _of_used(points: Any, faces: Any, shape: bool | None) -> bool | None:
    """Points of no triangle may be anything: clean meshes do without them."""
    if np.shape(points)[1:] != (3,):
        return False
    triangles = np.asarray(faces)
    if not triangles.size or triangles.dtype.kind not in "iu":
        return False
    if triangles.min() < 0 or triangles.max() >= len(points):
        return False
    fine = np.isfinite(as_floats(points)[np.unique(triangles)]).all()
    return (None if shape is False else shape) if fine else False
