import sys

import numpy as np
import pytest

from jaxsimp import bodies, goals
from jaxsimp.simplification import simplify
from jaxsimp.simplification.key_points import FitStatus
from jaxsimp.simplification.surfaces import meshlab
from jaxsimp.simplification.surfaces.hausdorff import Surface, hausdorff_distance
from jaxsimp.simplification.surfaces.meshlab import decimate, simplify_meshlab


def sheet_and_fold(count, direction):
    sheet = bodies.cloth((count, count))
    fold = goals.fold(sheet, goals.flat(sheet), np.zeros(2), np.array(direction, dtype=float))
    return sheet, fold


@pytest.mark.parametrize(("direction", "size"), [((1, 0), 6), ((1, -1), 4)])
def test_folds_of_the_paper_have_as_many_key_points(direction, size):
    pytest.importorskip("pymeshlab")
    sheet, goal = sheet_and_fold(25, direction)
    points = simplify(sheet, goal, method="meshlab")
    assert len(points) == size
    assert points.status == FitStatus.FITS
    assert points.method == "MeshLab"
    corners = sheet.rest[[0, 24, 600, 624]]
    away = np.linalg.norm(sheet.rest[points.particles] - corners[:, None], axis=2).min(axis=1)
    assert away.max() <= 1.001 * sheet.spacing  # MeshLab may take the neighbour along the crease


def test_ids_survive_a_decimation():
    pymeshlab = pytest.importorskip("pymeshlab")
    # Every vertex somewhere else: the mesh that MeshLab made is found again by its coordinates.
    points = np.random.default_rng(0).normal(size=(49, 3))
    faces = bodies.cloth((7, 7)).faces
    triangles = decimate(pymeshlab, points, faces, 20)
    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh(points, faces))
    meshes.meshing_decimation_quadric_edge_collapse(targetfacenum=20, **meshlab.PARAMETERS)
    mesh = meshes.current_mesh()
    expected = mesh.vertex_matrix()[mesh.face_matrix()]
    assert len(triangles) == len(expected) < len(faces)
    assert np.array_equal(points[triangles], expected)


def test_every_parameter_of_meshlab_is_passed():
    pymeshlab = pytest.importorskip("pymeshlab")
    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh(np.eye(3), np.array([[0, 1, 2]])))
    names = meshes.filter_parameter_values("meshing_decimation_quadric_edge_collapse")
    assert set(names) == {"targetfacenum", *meshlab.PARAMETERS}


def test_key_points_are_particles_and_the_error_is_the_hausdorff_distance():
    pytest.importorskip("pymeshlab")
    sheet, goal = sheet_and_fold(13, (0, 1))
    [points] = simplify_meshlab(sheet, goal[None])
    assert np.array_equal(points.positions, goal[points.particles])
    measured = hausdorff_distance(
        Surface(goal, sheet.faces),
        Surface(points.positions, points.elements),
        max(points.tolerance / 10, sheet.spacing / 8),
    )
    # From the same samples, written with other vertex ids.
    assert points.error == pytest.approx(measured, abs=1e-9)
    assert points.error < points.tolerance <= min(points.errors[: points.sizes.index(len(points))])


def test_no_fit_is_the_best_mesh_tried():
    pytest.importorskip("pymeshlab")
    sheet, goal = sheet_and_fold(9, (0, 1))
    wavy = goal + 0.01 * np.random.default_rng(0).normal(size=goal.shape)
    for points in simplify_meshlab(sheet, np.stack([wavy, wavy[::-1]]), 1e-6, 8):
        assert points.status == FitStatus.NO_FIT
        assert len(points) == points.sizes[int(np.argmin(points.errors))] <= 8


def test_without_the_extra_the_remedy_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "pymeshlab", None)  # an import of None fails
    sheet, goal = sheet_and_fold(5, (0, 1))
    with pytest.raises(ImportError, match=r"pip install 'jaxsimp\[meshlab\]'"):
        simplify(sheet, goal, method="meshlab")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ((-1.0, None), r"tolerance is -1.0; give"),
        ((None, 3), "max_size is 3; give a whole number of at least 4"),
    ],
)
def test_bad_options_are_refused(options, message):
    sheet, goal = sheet_and_fold(5, (0, 1))
    with pytest.raises(ValueError, match=message):
        simplify_meshlab(sheet, goal[None], *options)


def test_a_rope_is_refused():
    rope = bodies.rope()
    with pytest.raises(ValueError, match="the rope has 0 triangles"):
        simplify_meshlab(rope, goals.straight(rope)[None])
