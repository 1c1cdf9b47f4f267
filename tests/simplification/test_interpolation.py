import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from jaxsimp import bodies
from jaxsimp.simplification.interpolation import (
    interpolation_weights,
    model_errors,
    nearest_in_simplex,
)

ROUNDING = 1e-9  # of float64 on coordinates of about 1, with room for a square root

seeds = st.integers(0, 2**32 - 1)


@given(seeds)
def test_the_nearest_point_of_a_triangle_is_that_of_trimesh(seed):
    rng = np.random.default_rng(seed)
    corners, points = rng.normal(size=(3, 3)), rng.normal(size=(40, 3))
    coordinates, squared = nearest_in_simplex(points, corners)
    repeated = np.broadcast_to(corners, (40, 3, 3))
    expected = trimesh.triangles.closest_point(repeated, points)
    # trimesh works with tolerances of 1e-8 of its own.
    assert np.allclose(coordinates @ corners, expected, rtol=0, atol=1e-6)
    assert np.allclose(squared, np.sum((points - expected) ** 2, axis=1), rtol=0, atol=1e-6)
    assert (coordinates >= 0).all()
    assert np.allclose(coordinates.sum(axis=1), 1, rtol=0, atol=ROUNDING)


@given(seeds)
def test_the_nearest_point_of_a_segment_is_no_farther_than_any_other(seed):
    rng = np.random.default_rng(seed)
    corners, points = rng.normal(size=(2, 3)), rng.normal(size=(40, 3))
    coordinates, squared = nearest_in_simplex(points, corners)
    along = np.linspace(0, 1, 101)[:, None]
    others = (1 - along) * corners[0] + along * corners[1]
    farther = np.sum((points[:, None] - others) ** 2, axis=2)
    assert (squared[:, None] <= farther + ROUNDING).all()
    assert np.allclose(coordinates.sum(axis=1), 1, rtol=0, atol=ROUNDING)
    assert (coordinates >= 0).all()


@pytest.mark.parametrize("height", [0.0, 1e-17, 1e-14, 1e-10, 1e-8, 1e-6, 1e-4])
def test_slivers_are_as_near_as_their_longest_edge(height):
    rng = np.random.default_rng(0)
    for _ in range(50):
        start, end = rng.normal(size=(2, 3))
        middle = start + rng.uniform() * (end - start) + height * rng.normal(size=3)
        corners = np.stack([start, end, middle])[rng.permutation(3)]
        points = rng.normal(size=(20, 3))
        _, squared = nearest_in_simplex(points, corners)
        _, expected = nearest_in_simplex(points, np.stack([start, end]))
        difference = np.abs(np.sqrt(squared) - np.sqrt(expected)).max()
        assert difference <= 10 * height + ROUNDING


@pytest.mark.parametrize("corners", [np.zeros((2, 3)), np.zeros((3, 3))])
def test_a_simplex_in_one_point_is_that_point(corners):
    coordinates, squared = nearest_in_simplex(np.array([[3.0, 0.0, 4.0]]), corners)
    assert squared[0] == pytest.approx(25.0)
    assert coordinates.sum() == pytest.approx(1.0)


@given(seeds)
def test_affine_goals_are_exact_inside_of_the_model(seed):
    rng = np.random.default_rng(seed)
    sheet = bodies.cloth((6, 8), (0.3, 0.4))
    corners = np.array([0, 7, 40, 47])
    goal = sheet.rest @ rng.normal(size=(3, 3)) + rng.normal(size=3)
    weights = interpolation_weights(sheet.rest, corners, np.array([[0, 2, 1], [2, 3, 1]]))
    assert np.allclose(weights @ goal[corners], goal, rtol=0, atol=ROUNDING)
    assert np.allclose(weights[corners], np.eye(4), rtol=0, atol=ROUNDING)
    largest, mean = model_errors(goal, weights, goal[corners] + np.array([0.0, 0.3, 0.4]))
    assert largest == pytest.approx(0.5)
    assert mean == pytest.approx(0.5)


def test_a_rope_is_interpolated_between_its_neighbouring_key_points():
    rope = bodies.rope(11)
    weights = interpolation_weights(rope.rest, np.array([0, 4, 10]), np.array([[0, 1], [1, 2]]))
    expected = [np.interp(range(11), [0, 4, 10], row) for row in np.eye(3)]
    assert np.allclose(weights, np.transpose(expected), rtol=0, atol=ROUNDING)


def test_particles_outside_of_the_model_go_to_its_nearest_point():
    rest = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [2, -1, 0]])
    weights = interpolation_weights(rest, np.array([0, 1, 2]), np.array([[0, 1, 2]]))
    assert np.allclose(weights[3], [0, 0.5, 0.5])
    assert np.allclose(weights[4], [0, 1, 0])


def test_largest_and_mean_error_are_those_of_the_distances():
    goal = np.array([[0.0, 0, 0], [0, 3, 4]])
    assert model_errors(goal, np.ones((2, 1)), np.zeros((1, 3))) == (5.0, np.sqrt(12.5))
