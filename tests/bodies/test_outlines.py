"""Outlines: filled evenly, with as many points as wanted, to the very boundary."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxsimp.bodies.meshes import clean_mesh, face_areas
from jaxsimp.bodies.outlines import check_outline, mesh_outline, mesh_symmetric_outline
from jaxsimp.bodies.topology import boundary_edges

SQUARE = np.array([[0.0, 0.0], [0.3, 0.0], [0.3, 0.3], [0.0, 0.3]])
ELL = np.array([[0.0, 0.0], [0.4, 0.0], [0.4, 0.15], [0.15, 0.15], [0.15, 0.5], [0.0, 0.5]])
TRIANGLE = np.array([[0.0, 0.0], [0.5, 0.0], [0.25, 0.3]])
# Least angle of a triangle in the shapes below, degrees: of 20 to 30 none is slender.
LEAST_ANGLE = 20.0


def shoelace(corners: np.ndarray) -> float:
    x, y = corners.T
    return abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1))) / 2


def least_angle(points: np.ndarray, faces: np.ndarray) -> float:
    """By the law of cosines, degrees."""
    sides = np.linalg.norm(points[faces] - points[np.roll(faces, 1, axis=1)], axis=2)
    a, b, c = np.sort(sides, axis=1).T
    return float(np.rad2deg(np.arccos((b**2 + c**2 - a**2) / (2 * b * c))).min())


@st.composite
def stars(draw) -> np.ndarray:
    """Outlines around a centre, not convex, with no side much shorter than the others."""
    count = draw(st.integers(4, 9))
    radii = draw(st.lists(st.floats(0.15, 0.3), min_size=count, max_size=count))
    angle = draw(st.floats(0, 7)) + 2 * np.pi * np.arange(count) / count
    outline = np.array(radii)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return outline if draw(st.booleans()) else outline[::-1]


def check_mesh(corners, points, faces, wanted):
    assert abs(len(points) - wanted) <= 0.1 * wanted
    np.testing.assert_array_equal(points[: len(corners), :2], corners)
    np.testing.assert_array_equal(points[:, 2], 0.0)
    # Areas that add up to that of the outline, and one boundary as long as it: no holes, no
    # overlaps, nothing outside.
    np.testing.assert_allclose(face_areas(points, faces).sum(), shoelace(corners), rtol=1e-9)
    edges = boundary_edges(faces)[0]
    around = np.linalg.norm(points[edges[:, 1]] - points[edges[:, 0]], axis=1)
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1)
    np.testing.assert_allclose(around.sum(), sides.sum(), rtol=1e-9)
    a, b, c = points[faces].transpose(1, 0, 2)
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()
    found, found_faces = clean_mesh(points, faces)  # which refuses pieces and crowded edges
    np.testing.assert_array_equal(found, points)
    np.testing.assert_array_equal(found_faces, faces)


@pytest.mark.parametrize("corners", [SQUARE, ELL, ELL[::-1], TRIANGLE], ids="SLJT")
@pytest.mark.parametrize("wanted", [50, 200, 625, 1500])
def test_an_outline_is_filled_evenly(corners, wanted):
    points, faces = mesh_outline(corners, wanted)
    check_mesh(corners, points, faces, wanted)
    assert least_angle(points, faces) > LEAST_ANGLE
    # Nearly equilateral: edges within a factor of 3 of each other.
    edges = np.linalg.norm(points[faces] - points[np.roll(faces, 1, axis=1)], axis=2)
    assert edges.max() < 3 * edges.min()


@given(corners=stars(), wanted=st.integers(100, 400))
def test_any_outline_is_filled(corners, wanted):
    points, faces = mesh_outline(corners, wanted)
    check_mesh(corners, points, faces, wanted)


def test_points_are_spread_evenly_on_the_sides():
    points, faces = mesh_outline(ELL, 300)
    boundary = points[np.unique(boundary_edges(faces)[0]), :2]
    side = np.sort(boundary[boundary[:, 0] == 0, 1])
    np.testing.assert_allclose(np.diff(side), side[-1] / (len(side) - 1), rtol=1e-9)
    assert side[-1] == 0.5


def test_the_same_outline_gives_the_same_mesh():
    for first, second in zip(mesh_outline(ELL, 300), mesh_outline(ELL, 300), strict=True):
        np.testing.assert_array_equal(first, second)


@given(
    y=st.lists(st.floats(0.05, 0.2), min_size=3, max_size=6),
    wide=st.floats(0.1, 0.3),
    wanted=st.integers(150, 400),
)
def test_a_symmetric_outline_has_a_mesh_that_is_its_mirror_image(y, wide, wanted):
    height = np.cumsum(y)
    x = wide * (1 + 0.3 * np.cos(np.arange(len(y))))
    half = np.stack([[0, *x, 0], [0, *height - height[0], height[-1]]], axis=1)
    half[1, 1] = 0.02  # no side along the middle line but the line itself
    half[-1, 1] = height[-1] - height[0] + 0.02
    points, faces, mirror = mesh_symmetric_outline(half, wanted)
    assert abs(len(points) - wanted) <= 0.1 * wanted
    np.testing.assert_array_equal(points[mirror], points * [-1, 1, 1])
    np.testing.assert_array_equal(points[: len(half), :2], half)
    # The mirror image of each triangle, which runs the other way, is a triangle.
    kept, images = (
        {tuple(np.roll(face, -int(np.argmin(face)))) for face in some.tolist()}
        for some in (faces, mirror[faces][:, ::-1])
    )
    assert kept == images
    np.testing.assert_allclose(face_areas(points, faces).sum(), 2 * shoelace(half), rtol=1e-9)
    clean_mesh(points, faces)


@pytest.mark.parametrize(
    ("half", "message"),
    [
        ([[0.1, 0], [0.2, 0], [0.2, 0.2], [0, 0.2]], "let it begin and end at x = 0"),
        ([[0, 0], [0.2, 0], [0, 0.1], [0.2, 0.2], [0, 0.2]], "with x above zero between"),
        ([[0, 0], [-0.2, 0], [-0.2, 0.2], [0, 0.2]], r"has x from -0\.2 m"),
    ],
)
def test_a_half_that_is_none_is_refused(half, message):
    with pytest.raises(ValueError, match=message):
        mesh_symmetric_outline(np.array(half, dtype=float), 100)


# --- refusals ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("corners", "message"),
    [
        ([[0, 0], [1, 1], [1, 0], [0, 1]], "crosses or touches itself at the side from"),
        ([[0, 0], [1, 0], [1, 1], [0.5, 0], [0, 1]], "crosses or touches itself"),
        ([[0, 0], [1, 0], [0.5, 0], [0.5, 1]], "crosses or touches itself"),
        ([[0, 0], [2, 0], [2, 1], [0, 0], [-1, 1]], "crosses or touches itself"),
        ([[0, 0], [1, 0], [1, 0], [0, 1]], "corner 1 is there twice in a row"),
        ([[0, 0], [1, 0], [2, 0]], "crosses or touches itself"),
        ([[0, 0], [0, 0], [0, 0]], "corner 0 is there twice in a row"),
        ([[0, 0], [1, 0], [0.5, 4e-10]], "crosses or touches itself|encloses nothing"),
        (
            [[0, 0], [1, 0], [np.nan, 1]],
            r"corners\[2\] is \[nan, 1.0\] .*give finite numbers",
        ),
        (1000 * SQUARE, r"outline is \d+ m; a body is 0.01 to 5 m large.*millimetres\?"),
        ([[0, 0], [1, 0]], "an outline of 2 corners is given; give at least 3"),
    ],
)
def test_an_outline_is_refused(corners, message):
    with pytest.raises(ValueError, match=message):
        check_outline(np.array(corners, dtype=float))


def test_too_few_points_and_too_narrow_parts_are_refused():
    with pytest.raises(ValueError, match="num_points is 2; give a whole number from 3 to 250000"):
        mesh_outline(SQUARE, 2)
    angle = np.linspace(0, 2 * np.pi, 100, endpoint=False)
    disc = 0.3 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    with pytest.raises(ValueError, match=r"40 points are asked for; this outline is met with 10\d"):
        mesh_outline(disc, 40)
    # A spike, so acute that points on its sides are nearer to each other than along the sides.
    spike = np.array([[0.39, 0.388], [0.156, 0.187], [0.344, 0.3], [0.324, 0.218]])
    with pytest.raises(ValueError, match=r"too narrow for .* points; ask for more points"):
        mesh_outline(spike, 12)
    points, faces = mesh_outline(spike, 100)
    np.testing.assert_allclose(face_areas(points, faces).sum(), shoelace(spike), rtol=1e-9)
