"""Surfaces: quadric edge collapse in MeshLab, the paper's tool.

An optional extra, since pymeshlab is under the GPL; the import happens at the call. Every call
passes every parameter: MeshLab takes missing ones from the previous call.
"""

from collections.abc import Iterator
from types import ModuleType

import numpy as np
from jaxtyping import Float, Int

from jaxsimp.bodies import Body
from jaxsimp.goals import Positions
from jaxsimp.simplification.key_points import KeyPoints
from jaxsimp.simplification.surfaces.common import DEFAULT_MAX_SIZE, check_surfaces, fewest_vertices

MIN_TRIANGLES = 2  # where the paper starts
MIN_SIZE = 4  # vertices of two triangles
# Subset placement: a vertex of the model is a particle. The rest are MeshLab's defaults.
PARAMETERS = {
    "targetperc": 0.0,
    "qualitythr": 0.3,
    "preserveboundary": False,
    "boundaryweight": 1.0,
    "preservenormal": False,
    "preservetopology": False,
    "optimalplacement": False,
    "planarquadric": False,
    "planarweight": 0.001,
    "qualityweight": False,
    "autoclean": True,
    "selected": False,
}


def simplify_meshlab(
    body: Body,
    goals: Float[np.ndarray, "B N 3"],
    tolerance: float | None = None,
    max_size: int | None = None,
) -> list[KeyPoints]:
    """Key points of goals of a surface: the vertices of the smallest mesh that covers each.

    MeshLab decimates the goal to two triangles, three and so on, as in section III-A.2 of the
    paper, until the Hausdorff distance is below the tolerance (see `fewest_vertices`). It may
    leave more triangles than requested.

    Arguments and result are those of `simplify_quadric`.

    Raises:
        ValueError: as `simplify_quadric` does.
        ImportError: if pymeshlab is not installed.
    """
    tolerance = 0.1 * body.size if tolerance is None else tolerance
    max_size = DEFAULT_MAX_SIZE if max_size is None else max_size
    goals = check_surfaces(body, goals, tolerance, max_size, MIN_SIZE)
    pymeshlab = _pymeshlab()
    found = []
    for goal in goals:
        meshes: dict[int, np.ndarray] = {}
        sizes = _decimations(pymeshlab, goal, body.faces, max_size, meshes)
        found.append(fewest_vertices(body, goal, meshes, sizes, tolerance, "MeshLab"))
    return found


def decimate(
    pymeshlab: ModuleType, points: Positions, faces: Int[np.ndarray, "F 3"], num_triangles: int
) -> Int[np.ndarray, "_ 3"]:
    """MeshLab's mesh of about `num_triangles` triangles, in the vertex ids of `faces`.

    Args:
        pymeshlab: the library.
        points: vertex positions, shape (V, 3), metres.
        faces: vertex ids of the triangles, shape (F, 3).
        num_triangles: number of triangles requested.
    """
    meshes = pymeshlab.MeshSet(verbose=False)
    # Ids are stored as a scalar at each vertex; a float64 holds each of them exactly.
    ids = np.arange(len(points), dtype=float)
    meshes.add_mesh(pymeshlab.Mesh(points, faces, v_scalar_array=ids))
    meshes.meshing_decimation_quadric_edge_collapse(targetfacenum=num_triangles, **PARAMETERS)
    model = meshes.current_mesh()
    particles = model.vertex_scalar_array().astype(int)
    return particles[model.face_matrix()].reshape(-1, 3)


def _decimations(
    pymeshlab: ModuleType,
    goal: np.ndarray,
    faces: np.ndarray,
    max_size: int,
    meshes: dict[int, np.ndarray],
) -> Iterator[int]:
    """Increasing numbers of vertices, each once; stores the mesh of each in `meshes`."""
    for num_triangles in range(MIN_TRIANGLES, len(faces) + 1):
        triangles = decimate(pymeshlab, goal, faces, num_triangles)
        size = len(np.unique(triangles))
        if size > max_size:
            return
        # Sizes must ascend: a mesh with no more vertices than an earlier one is skipped.
        if size > max(meshes, default=0):
            meshes[size] = triangles
            yield size


def _pymeshlab() -> ModuleType:
    try:
        import pymeshlab
    except ImportError as error:
        raise ImportError(
            "method 'meshlab' needs pymeshlab, which is not installed; "
            "pip install 'jaxsimp[meshlab]'"
        ) from error
    return pymeshlab
