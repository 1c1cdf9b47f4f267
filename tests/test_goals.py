"""Goals: isometries, layers and arc length, against what geometry says of them."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from jaxsimp import goals
from jaxsimp.body import cloth, rope

# Float64 coordinates of about 1 m, a few operations each.
ROUNDING = 1e-12

angles = st.floats(-7.0, 7.0)
coordinates = st.floats(-0.2, 0.2)
CLOTH = cloth((6, 5), (0.3, 0.2))


def distances(points: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points[:, None] - points[None], axis=-1)


@given(angle=angles)
def test_flat_is_a_turn_of_the_rest_shape_at_the_height_of_the_radius(angle):
    found = goals.flat(CLOTH, angle)
    # Complex numbers turn counter-clockwise when multiplied by e^{i angle}.
    turned = (CLOTH.rest[:, 0] + 1j * CLOTH.rest[:, 1]) * np.exp(1j * angle)
    np.testing.assert_allclose(found[:, 0], turned.real, atol=ROUNDING)
    np.testing.assert_allclose(found[:, 1], turned.imag, atol=ROUNDING)
    np.testing.assert_array_equal(found[:, 2], CLOTH.radius)
    np.testing.assert_allclose(distances(found), distances(CLOTH.rest), atol=ROUNDING)


def walk(corners: np.ndarray, distance: float) -> np.ndarray:
    """The point at a distance along a polyline, one leg after another."""
    for start, end in pairwise(corners):
        leg = float(np.hypot(*(end - start)))
        if distance <= leg and leg > 0:
            return start + (end - start) * distance / leg
        distance -= leg
    return corners[-1]


@given(
    corners=st.lists(st.tuples(coordinates, coordinates), min_size=2, max_size=6),
    num_particles=st.integers(2, 30),
)
def test_polyline_spreads_particles_evenly_along_its_arc(corners, num_particles):
    corners = np.array(corners)
    total = np.hypot(*np.diff(corners, axis=0).T).sum()
    assume(total > 1e-3)
    body = rope(num_particles, 0.5)
    found = goals.polyline(body, corners)
    wanted = [walk(corners, total * i / (num_particles - 1)) for i in range(num_particles)]
    np.testing.assert_allclose(found[:, :2], wanted, atol=ROUNDING)
    np.testing.assert_array_equal(found[:, 2], body.radius)


def test_straight_has_the_rest_length_or_the_one_asked_for():
    body = rope(11, 0.5)
    np.testing.assert_allclose(goals.straight(body), goals.flat(body), atol=ROUNDING)
    shorter = goals.straight(body, 0.4)
    np.testing.assert_allclose(np.diff(shorter[:, 0]), 0.04, atol=ROUNDING)
    np.testing.assert_allclose(shorter[[0, -1], 0], [-0.2, 0.2], atol=ROUNDING)


@given(point=st.tuples(coordinates, coordinates), angle=angles, scale=st.floats(0.01, 100.0))
def test_fold_mirrors_the_left_on_the_right(point, angle, scale):
    start = goals.flat(CLOTH)
    direction = scale * np.array([np.cos(angle), np.sin(angle)])
    folded = goals.fold(CLOTH, start, np.array(point), direction)
    # In the complex plane with the line as real axis: above it is left, and conjugates.
    unit = np.exp(1j * angle)
    away = (start[:, :2] @ np.array([1, 1j]) - complex(*point)) / unit
    # What is nearer to the line than this may be taken for its crease (documented: rounding).
    assume(np.abs(away.imag).min() > 1e-6)
    left = away.imag > 0
    wanted = np.where(left, away.conj(), away) * unit + complex(*point)
    np.testing.assert_allclose(folded[:, :2] @ np.array([1, 1j]), wanted, atol=ROUNDING)
    np.testing.assert_allclose(folded[:, 2], CLOTH.radius * np.where(left, 3, 1), rtol=ROUNDING)
    for side in (left, ~left):
        np.testing.assert_allclose(distances(folded[side]), distances(start[side]), atol=ROUNDING)


@given(angle=angles)
def test_fold_along_a_row_of_particles_makes_a_crease_between_the_layers(angle):
    body = cloth((5, 4), (0.2, 0.3))
    row = body.rest[:, 0]
    start = goals.flat(body, angle)
    # The middle row lies along y; turned, its direction is this, and its left is -x.
    folded = goals.fold(body, start, np.zeros(2), np.array([-np.sin(angle), np.cos(angle)]))
    layers = body.radius * np.select([row < -1e-9, row > 1e-9], [3.0, 1.0], 2.0)
    np.testing.assert_allclose(folded[:, 2], layers, rtol=ROUNDING)
    moved = goals.flat(body, angle).reshape(5, 4, 3)[[4, 3, 2, 3, 4], :, :2]
    np.testing.assert_allclose(folded.reshape(5, 4, 3)[..., :2], moved, atol=ROUNDING)


def test_a_fold_leaves_what_it_is_given_alone():
    start = goals.flat(CLOTH)
    goals.fold(CLOTH, start, np.zeros(2), np.array([1.0, 0.0]))
    np.testing.assert_array_equal(start, goals.flat(CLOTH))


def test_folding_twice_stacks_four_layers_a_thickness_apart():
    body = cloth((4, 4))
    half = goals.fold(body, goals.flat(body), np.zeros(2), np.array([0.0, 1.0]))
    quarter = goals.fold(body, half, np.zeros(2), np.array([1.0, 0.0]))
    stacks: dict[tuple[float, ...], list[float]] = {}
    for *xy, z in quarter.round(9).tolist():
        stacks.setdefault(tuple(xy), []).append(z / body.radius)
    assert len(stacks) == 4
    for heights in stacks.values():
        np.testing.assert_allclose(sorted(heights), [1.0, 3.0, 5.0, 7.0], rtol=1e-6)
    # The order of the layers, as paper does it: the second fold turns its half upside down.
    z = quarter.reshape(4, 4, 3)[..., 2] / body.radius
    np.testing.assert_allclose(z[3, 0], 1.0)  # right of both lines: stays
    np.testing.assert_allclose(z[0, 0], 3.0)  # folded first
    np.testing.assert_allclose(z[0, 3], 5.0)  # folded first, then turned over
    np.testing.assert_allclose(z[3, 3], 7.0)  # at the bottom of what was turned over


def test_check_goal_gives_the_goal_as_floats():
    goal = goals.flat(CLOTH)
    np.testing.assert_array_equal(goals.check_goal(CLOTH, goal), goal)
    assert goals.check_goal(CLOTH, goal.astype(np.float32)).dtype == np.float64


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize(
    ("goal", "message"),
    [
        (np.zeros((30, 2)), r"goal has shape \(30, 2\); \(30, 3\) is needed.*of the cloth"),
        (np.zeros((29, 3)), r"goal has shape \(29, 3\)"),
        (np.zeros(3), r"goal has shape \(3,\)"),
    ],
)
def test_check_goal_refuses_a_wrong_shape(goal, message):
    with pytest.raises(ValueError, match=message):
        goals.check_goal(CLOTH, goal)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_check_goal_names_the_first_particle_that_is_not_finite(bad):
    goal = goals.flat(CLOTH)
    goal[[4, 9], 1] = bad
    with pytest.raises(ValueError, match=r"goal of particle 4 is .*\(2 such particles\)"):
        goals.check_goal(CLOTH, goal)


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize(
    ("corners", "message"),
    [
        (np.zeros((1, 2)), r"corners has shape \(1, 2\); \(M, 2\) with M of 2 or more"),
        (np.zeros((3, 3)), r"corners has shape \(3, 3\)"),
        (np.zeros(4), r"corners has shape \(4,\)"),
        (np.zeros((3, 2)), "polyline is 0 m long; give corners that are apart"),
        (np.array([[0.0, 0.0], [np.nan, 0.0]]), "polyline is nan m long"),
        (np.array([[0.0, 0.0], [np.inf, 0.0]]), "polyline is inf m long"),
    ],
)
def test_polyline_refuses(corners, message):
    with pytest.raises(ValueError, match=message):
        goals.polyline(rope(), corners)


@pytest.mark.parametrize(
    ("point", "direction", "message"),
    [
        ([0.0, 0.0], [0.0, 0.0], r"direction is \[0.0, 0.0\]; give a finite vector with a length"),
        ([0.0, 0.0], [np.nan, 1.0], "direction is"),
        ([0.0, 0.0], [np.inf, 1.0], "direction is"),
        ([np.nan, 0.0], [1.0, 0.0], r"point is \[nan, 0.0\]; give finite coordinates"),
    ],
)
def test_fold_refuses(point, direction, message):
    with pytest.raises(ValueError, match=message):
        goals.fold(CLOTH, goals.flat(CLOTH), np.array(point), np.array(direction))
