"""Meshing anew: flat sheets keep their outline, all others their shape, holes and boundaries."""

import sys

import igl
import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from jaxsimp.bodies import cloth, from_mesh, load_mesh, mesh_outline, remesh, t_shirt
from jaxsimp.bodies.meshes import face_areas, relative_stiffness
from jaxsimp.bodies.topology import boundary_edges, boundary_loops
from jaxsimp.dynamics import largest_time_step

ELL = np.array([[0.0, 0.0], [0.4, 0.0], [0.4, 0.2], [0.2, 0.2], [0.2, 0.3], [0.0, 0.3]])


def shoelace(corners):
    x, y = corners.T
    return abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) / 2


# --- flat sheets of one outline ------------------------------------------------------------------


@given(seed=st.integers(0, 10**6), wanted=st.integers(100, 400))
def test_a_flat_mesh_is_meshed_anew_in_any_plane(seed, wanted):
    rng = np.random.default_rng(seed)
    points, faces = mesh_outline(ELL, 150)
    turn, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    found, found_faces = remesh(points @ turn + rng.uniform(-0.5, 0.5, 3), faces, wanted)
    assert abs(len(found) - wanted) <= 0.1 * wanted
    np.testing.assert_allclose(face_areas(found, found_faces).sum(), shoelace(ELL), rtol=1e-9)
    # The corners, as far from each other as they were (the sheet may lie on its other side).
    distances = np.linalg.norm(found[:6, None] - found[None, :6], axis=2)
    wanted_distances = np.linalg.norm(ELL[:, None] - ELL[None], axis=2)
    np.testing.assert_allclose(
        np.sort(distances.ravel()), np.sort(wanted_distances.ravel()), atol=1e-9
    )


def test_a_horizontal_mesh_stays_in_place():
    body = cloth((9, 7), (0.4, 0.3))
    points, _ = remesh(body.rest, body.faces, 200)
    corners = {tuple(row) for row in points[:4, :2].round(9).tolist()}
    assert corners == {(a * 0.2, b * 0.15) for a in (-1, 1) for b in (-1, 1)}


def test_a_round_outline_is_followed():
    angle = np.linspace(0, 2 * np.pi, 200, endpoint=False)
    disc = 0.3 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points, faces = remesh(*mesh_outline(disc, 1200), 500)
    boundary = np.unique(boundary_edges(faces)[0])
    # A thousandth of the extent of 0.6 m lies between the outline and its polygon.
    assert len(boundary) < 120
    assert face_areas(points, faces).sum() > np.pi * (0.3 - 0.0006) ** 2
    assert abs(len(points) - 500) <= 50


# --- any other surface ---------------------------------------------------------------------------


def worst_quality(points, faces):
    """The least of 4 sqrt(3) times area over the sum of squared sides: 1 is equilateral."""
    a, b, c = points[faces].transpose(1, 0, 2)
    sides = sum(((p - q) ** 2).sum(axis=1) for p, q in ((a, b), (b, c), (c, a)))
    return (4 * 3**0.5 * face_areas(points, faces) / sides).min()


def sphere():
    ball = trimesh.creation.icosphere(3, 0.1)
    return np.array(ball.vertices), np.array(ball.faces)


def tube():
    body = cloth((20, 20), (0.3, 0.3))
    angle = 2 * np.pi * body.rest[:, 0] / 0.3 * (19 / 20)
    around = np.stack([np.cos(angle), np.sin(angle)], axis=1) * 0.05
    seam = np.arange(20)
    close = np.concatenate(
        [
            np.stack([seam[:-1] + 380, seam[:-1], seam[:-1] + 381], axis=1),
            np.stack([seam[:-1] + 381, seam[:-1], seam[1:]], axis=1),
        ]
    )
    points = np.concatenate([around, body.rest[:, 1:2]], axis=1)
    return points, np.concatenate([body.faces, close])


def annulus():
    body = cloth((13, 13))
    middle = np.abs(body.rest[body.faces].mean(axis=1)[:, :2]).max(axis=1) < 0.05
    return body.rest, body.faces[~middle]


def bent():
    body = cloth((9, 9))
    return body.rest + np.stack([0 * body.rest[:, 0]] * 2 + [body.rest[:, 0] ** 2], 1), body.faces


def two_sheets():
    body = t_shirt(num_particles=500, sheets=2).body
    return body.rest * [1, 1, 20], body.faces  # 40 mm thick: a triangle is 25 mm large


@pytest.mark.parametrize("make", [sphere, tube, annulus, bent, two_sheets])
@pytest.mark.parametrize("wanted", [300, 700])
def test_a_surface_keeps_its_shape_and_boundaries(make, wanted):
    points, faces = make()
    found, found_faces = remesh(points, faces, wanted)
    assert abs(len(found) - wanted) <= 0.1 * wanted
    assert len(boundary_loops(found_faces)) == len(boundary_loops(faces))
    area = face_areas(points, faces).sum()
    np.testing.assert_allclose(face_areas(found, found_faces).sum(), area, rtol=0.05)
    squared, _, _ = igl.point_mesh_squared_distance(found, points, faces)
    assert np.sqrt(squared.max()) < np.sqrt(area / wanted)  # the size of a triangle
    assert worst_quality(found, found_faces) > 0.2


def test_corners_of_holes_stay():
    points, faces = annulus()
    found, _ = remesh(points, faces, 400)
    for corner in np.array([[0.15, 0.15, 0.0], [0.05, 0.05, 0.0], [-0.05, 0.05, 0.0]]):
        assert np.linalg.norm(found - corner, axis=1).min() < 1e-9


def slivers():
    """A bent cloth with a row of triangles a thousand times too narrow."""
    points, faces = bent()
    columns = np.unique(points[:, 0])
    points[points[:, 0] == columns[4], 0] = columns[3] + (columns[4] - columns[3]) / 1000
    points[:, 2] = points[:, 0] ** 2
    return points, faces


def test_narrow_triangles_are_told_and_cured(tmp_path):
    points, faces = slivers()
    path = tmp_path / "slivers.ply"
    trimesh.Trimesh(points, faces, process=False).export(path)
    with pytest.warns(UserWarning, match="narrow triangles, .* shorter: replace them by jaxsimp"):
        points, faces = load_mesh(path)
    before, after = (
        largest_time_step(from_mesh(*mesh)) for mesh in ((points, faces), remesh(points, faces, 81))
    )
    usual = largest_time_step(from_mesh(*bent()))
    assert before < usual / 10
    assert after > usual / 2
    # The warning's two bounds on the time step hold.
    stiffer = relative_stiffness(points, faces) / relative_stiffness(*bent())
    assert usual / stiffer < 2 * before
    assert before < 2 * usual / stiffer**0.5


def test_without_the_library_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "mmgpy", None)
    with pytest.raises(ImportError, match=r"pip install 'jaxsimp\[remesh\]'"):
        remesh(*bent(), 100)
    assert len(remesh(*mesh_outline(ELL, 100), 80)[0]) > 70  # a flat one needs no library


@pytest.mark.parametrize("count", [2, 2.5, 10**9])
@pytest.mark.usefixtures("unchecked_shapes")
def test_a_number_of_points_that_is_none_is_refused(count):
    with pytest.raises(ValueError, match=r"num_points is .*; give a whole number from 3 to 250000"):
        remesh(*bent(), count)


def test_a_surface_that_has_more_corners_is_refused():
    points, faces = annulus()
    with pytest.raises(ValueError, match="5 points are asked for; this surface is met with"):
        remesh(points, faces, 5)
