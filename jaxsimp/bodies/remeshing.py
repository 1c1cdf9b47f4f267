"""Remeshing: any surface meshed again, with nearly equilateral triangles of one size.

Flat sheets of one outline are filled by `jaxsimp.bodies.outlines`, which keeps their corners. All
others, as garments in three dimensions, closed or open, are meshed by Mmg (C. Dapogny, C.
Dobrzynski and P. Frey, "Three-dimensional adaptive domain remeshing", 2014), by way of mmgpy: an
optional extra, since Mmg is under the LGPL.
"""

from types import ModuleType

import numpy as np

from jaxsimp.bodies.meshes import NARROW, Mesh, Points, clean_mesh, face_areas, relative_stiffness
from jaxsimp.bodies.outlines import COUNT_TOLERANCE, refill
from jaxsimp.bodies.size import MOST_PARTICLES
from jaxsimp.bodies.topology import Faces, rim
from jaxsimp.checks import require_count

ATTEMPTS = 10
"""Sizes that are tried: how many points a size gives follows from the surface."""
FINER = 0.6
CORNER = np.deg2rad(50.0)
"""Turn of a boundary above which a point stays: those of a fine, wavy hem must not."""


def remesh(points: Points, faces: Faces, num_points: int) -> Mesh:
    """A surface meshed again, with a given number of points and nearly equilateral triangles.

    A flat mesh of one outline becomes horizontal and faces up, and its outline keeps its corners,
    where it turns by more than 20 degrees. Any other mesh stays in place, open or closed, with its
    holes and corners of more than 50 degrees; the new surface follows it within the size of a
    triangle, so that finer wrinkles are smoothed.

    Args:
        points: shape (V, 3), metres.
        faces: point ids of the triangles, shape (F, 3).
        num_points: number of points, met within `COUNT_TOLERANCE`.

    Raises:
        ValueError: if `clean_mesh` refuses the mesh, or it cannot be met with so many points.
        ImportError: if the mesh is not flat, or has holes, and mmgpy is not installed.
    """
    num_points = require_count("num_points", num_points, 3, MOST_PARTICLES)
    points, faces = clean_mesh(points, faces)
    filled = refill(points, faces, num_points)
    return _mesh_by_mmg(points, faces, num_points) if filled is None else filled


def _mesh_by_mmg(points: np.ndarray, faces: np.ndarray, num_points: int) -> Mesh:
    """A mesh of about so many points."""
    mmgpy = _mmgpy()
    area = face_areas(points, faces).sum()
    size = float(np.sqrt(2 / np.sqrt(3) * area / num_points))  # of a hexagonal lattice
    # From a finer mesh: a regular pattern of the given one might stay whatever the size.
    points, faces = _mesh_of_size(mmgpy, points, faces, FINER * size)
    counts, made = [], []
    for _ in range(ATTEMPTS):
        found = _mesh_of_size(mmgpy, points, faces, size)
        counts.append(len(found[0]))
        if abs(counts[-1] - num_points) <= COUNT_TOLERANCE * num_points and _is_clean(*found):
            made.append(clean_mesh(*found))
            if relative_stiffness(*made[-1]) <= NARROW:
                break
        # A mesh of the right size that is not good: one that is slightly finer.
        size *= (counts[-1] / num_points) ** 0.5 * (0.98 if made else 1.0)
    if not made:
        near = min(counts, key=lambda count: abs(count - num_points))
        if abs(near - num_points) <= COUNT_TOLERANCE * num_points:
            raise ValueError(
                f"meshed with {num_points} points, parts of the surface grow together, or a "
                f"triangle is empty: ask for many more"
            )
        raise ValueError(
            f"{num_points} points are asked for; this surface is met with {near}: ask for that, "
            f"or for many more"
        )
    return min(made, key=lambda mesh: relative_stiffness(*mesh))


def _is_clean(points: np.ndarray, faces: np.ndarray) -> bool:
    """Whether a mesh is one orientable surface: of a coarse one parts may have grown together."""
    try:
        return len(clean_mesh(points, faces)[0]) == len(points)
    except ValueError:
        return False


def _mesh_of_size(mmgpy: ModuleType, points: np.ndarray, faces: np.ndarray, size: float) -> Mesh:
    """A mesh with edges of about a length, metres."""
    mesh = mmgpy.MmgMeshS(points, faces.astype(np.int32))
    mesh.set_corners(_corners(points, faces))
    # No ridges: a wrinkle is no edge of the shape. A coarse tolerance keeps triangles of one size.
    mesh.remesh(hsiz=size, hausd=size, angle=0, verbose=-1)
    return np.array(mesh.get_vertices()), np.array(mesh.get_triangles(), np.int64)


def _corners(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Ids of the points where the boundary turns, as int32."""
    around = rim(faces, len(points))
    (on_rim,) = np.nonzero(around[:, 0] >= 0)
    before, after = points[around[on_rim]].transpose(1, 0, 2) - points[on_rim]
    lengths = np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
    straight = -(before * after).sum(axis=1) / lengths
    return on_rim[straight < np.cos(CORNER)].astype(np.int32)


def _mmgpy() -> ModuleType:
    try:
        import mmgpy
    except ImportError as error:
        raise ImportError(
            "a mesh that is not flat, or has holes, is meshed anew by mmgpy, which is not "
            "installed; pip install 'jaxsimp[remesh]'"
        ) from error
    return mmgpy
