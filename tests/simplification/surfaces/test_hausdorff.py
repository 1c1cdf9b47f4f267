import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jaxsimp.simplification.surfaces.hausdorff import (
    Surface,
    _farthest,
    hausdorff_distance,
    sample_surface,
)

SQUARE = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
SQUARE_FACES = np.array([[0, 1, 2], [0, 2, 3]])
ROUNDING = 1e-9  # of float64 on coordinates of about 1, with room for a square root

seeds = st.integers(0, 2**32 - 1)


def square(shift=(0.0, 0.0, 0.0)):
    return Surface(SQUARE + np.array(shift), SQUARE_FACES)


def random_surface(rng, num_faces=4):
    return Surface(rng.normal(size=(3 * num_faces, 3)), np.arange(3 * num_faces).reshape(-1, 3))


def nearest_by_trimesh(points, surface):
    """Distance of each point from the surface: the least over its triangles, one by one."""
    distances = []
    for triangle in surface.points[surface.faces]:
        repeated = np.broadcast_to(triangle, (len(points), 3, 3))
        closest = trimesh.triangles.closest_point(repeated, points)
        distances.append(np.linalg.norm(points - closest, axis=1))
    return np.min(distances, axis=0)


def distance_to_segment(points, start, end):
    along = end - start
    fraction = np.clip((points - start) @ along / (along @ along), 0.0, 1.0)
    return np.linalg.norm(points - start - fraction[:, None] * along, axis=1)


@pytest.mark.parametrize(
    ("shift", "distance"),
    [((0, 0, 0.3), 0.3), ((0.4, 0, 0), 0.4), ((0.3, 0.4, 0), 0.5), ((5, 0, 0), 5.0)],
)
def test_shifted_square_is_as_far_as_its_shift(shift, distance):
    assert hausdorff_distance(square(), square(shift), 0.1) == pytest.approx(distance, abs=ROUNDING)


def test_distance_is_measured_in_both_directions():
    half = Surface(SQUARE, SQUARE_FACES[:1])
    # The corner (0, 1) is missing: the diagonal is 1 / sqrt(2) away from it.
    assert hausdorff_distance(half, square(), 0.1) == pytest.approx(np.sqrt(0.5), abs=ROUNDING)
    assert hausdorff_distance(square(), half, 0.1) == pytest.approx(np.sqrt(0.5), abs=ROUNDING)


def test_farthest_point_within_a_face_is_found_within_the_bound():
    # A triangle and its three sides: the incentre, no vertex of either, is farthest.
    corners = np.array([[0.0, 0, 0], [3, 0, 0], [0, 4, 0]])
    rims = Surface(corners, np.array([[0, 1, 1], [1, 2, 2], [2, 0, 0]]))
    full = Surface(corners, np.array([[0, 1, 2]]))
    inradius, spacing = 1.0, 0.05
    measured = hausdorff_distance(full, rims, spacing)
    assert inradius - spacing / np.sqrt(3) <= measured <= inradius + ROUNDING


@given(seeds)
def test_directed_distances_match_trimesh(seed):
    rng = np.random.default_rng(seed)
    first, second = random_surface(rng), random_surface(rng)
    expected = max(
        nearest_by_trimesh(sample_surface(first, 0.5), second).max(),
        nearest_by_trimesh(sample_surface(second, 0.5), first).max(),
    )
    # trimesh works with tolerances of 1e-8 of its own.
    assert hausdorff_distance(first, second, 0.5) == pytest.approx(expected, abs=1e-6)


@given(seeds)
def test_distance_is_symmetric_zero_to_itself_and_the_same_after_a_motion(seed):
    rng = np.random.default_rng(seed)
    first, second = random_surface(rng), random_surface(rng)
    distance = hausdorff_distance(first, second, 0.5)
    turn = Rotation.random(rng=rng).as_matrix()
    shift = rng.normal(size=3)
    moved = [Surface(s.points @ turn.T + shift, s.faces) for s in (first, second)]
    assert hausdorff_distance(second, first, 0.5) == distance
    assert hausdorff_distance(first, first, 0.5) == pytest.approx(0.0, abs=1e-7)  # sqrt of 1e-14
    # A motion may change the number of samples on an edge by rounding: the bound holds twice.
    assert abs(hausdorff_distance(*moved, 0.5) - distance) <= 2 * 0.5 / np.sqrt(3)
    assert distance > 0


@given(seeds, st.floats(0.05, 1.0))
def test_no_point_is_farther_from_a_sample_than_the_bound(seed, spacing):
    rng = np.random.default_rng(seed)
    surface = random_surface(rng, num_faces=1)
    points = rng.dirichlet(np.ones(3), size=200) @ surface.points
    samples = sample_surface(surface, spacing)
    nearest = np.linalg.norm(points[:, None] - samples, axis=2).min(axis=1)
    assert nearest.max() <= spacing / np.sqrt(3) + ROUNDING


@pytest.mark.parametrize("height", [0.0, 1e-18, 1e-17, 1e-16, 1e-14, 1e-11, 1e-9, 1e-7])
def test_triangles_of_almost_no_height_are_segments(height):
    rng = np.random.default_rng(0)
    for _ in range(500):  # libigl errs on one in sixty at the worst height
        start, end = rng.normal(size=(2, 3))
        middle = start + rng.uniform() * (end - start) + height * rng.normal(size=3)
        corners = np.stack([start, end, middle])[rng.permutation(3)]
        point = rng.normal(size=(1, 3))
        expected = distance_to_segment(point, start, end)[0]
        measured = _farthest(point, Surface(corners, np.array([[0, 1, 2]])))
        assert measured == pytest.approx(expected, abs=10 * height + ROUNDING)


@pytest.mark.parametrize("faces", [[[0, 0, 0]], [[0, 1, 1]], [[0, 1, 4]]])
def test_a_triangle_without_area_counts_as_the_points_it_has(faces):
    points = np.concatenate([SQUARE, [[0.5, 0.0, 0.0]]])
    measured = hausdorff_distance(Surface(points, np.array(faces)), square((0, 0, 2)), 0.05)
    farthest = np.sqrt(2 + 4) if faces == [[0, 0, 0]] else np.sqrt(1 + 4)
    assert measured == pytest.approx(farthest, abs=ROUNDING)


def test_layers_that_cover_each_other_count_once():
    double = Surface(
        np.concatenate([SQUARE, SQUARE]), np.concatenate([SQUARE_FACES, SQUARE_FACES + 4])
    )
    assert hausdorff_distance(double, square(), 0.1) == pytest.approx(0.0, abs=ROUNDING)


def test_bad_surfaces_and_spacings_are_refused():
    with pytest.raises(ValueError, match="0 triangles; give at least 1"):
        Surface(SQUARE, np.zeros((0, 3), dtype=int))
    with pytest.raises(ValueError, match=r"vertices 0 to 4; .* ids 0 to 3"):
        Surface(SQUARE, np.array([[0, 1, 4]]))
    with pytest.raises(ValueError, match="not finite"):
        Surface(SQUARE * np.nan, SQUARE_FACES)
    with pytest.raises(ValueError, match="spacing is 0"):
        hausdorff_distance(square(), square(), 0.0)
