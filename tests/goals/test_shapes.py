"""Goals of ropes: arc lengths, circles and crossings, against what geometry says of them."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from jaxsimp import goals
from jaxsimp.bodies import cloth, rope, rope_along

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


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize(
    ("corners", "message"),
    [
        (np.zeros((1, 2)), r"corners has 1 rows; give at least 2, of x and y"),
        (np.zeros((3, 3)), r"corners is an array of shape \(3, 3\); give rows of 2 real"),
        (np.zeros(4), r"corners is an array of shape \(4,\)"),
        (np.zeros((3, 2)), "polyline is 0 m long; give at least two corners that are apart"),
        (
            np.array([[0.0, 0.0], [np.nan, 0.0]]),
            r"corners\[1\] is \[nan, 0.0\] .*give finite numbers",
        ),
        (np.array([[0.0, 0.0], [np.inf, 0.0]]), r"corners\[1\] is \[inf, 0.0\]"),
    ],
)
def test_polyline_refuses(corners, message):
    with pytest.raises(ValueError, match=message):
        goals.polyline(rope(), corners)


# --- letters -------------------------------------------------------------------------------------

LETTERS = ["S", "O", "M", "C", "U"]
shapes = st.sampled_from(LETTERS)


def bends(points: np.ndarray) -> np.ndarray:
    """Signed angle from each step to the next, radians; left is positive."""
    step = np.diff(points[:, 0] + 1j * points[:, 1])
    return np.angle(step[1:] / step[:-1])


def circle_through(a, b, c) -> tuple[complex, float]:
    """Centre and radius of the circle through three points of the complex plane."""
    w = (c - a) / (b - a)
    centre = a + (b - a) * (w - abs(w) ** 2) / (2j * w.imag)
    return centre, abs(centre - a)


@given(name=shapes, count=st.integers(300, 400), slack=st.floats(0, 0.5), length=st.floats(0.2, 2))
def test_a_letter_is_as_long_as_the_rope_less_its_slack(name, count, slack, length):
    body = rope(count, length)
    found = goals.letter(body, name, slack)
    steps = np.linalg.norm(np.diff(found, axis=0), axis=1)
    # Chords of bows of at most 5 radians in all over 300 steps, and steps across 4 corners.
    np.testing.assert_allclose(steps.sum(), (1 - slack) * length, rtol=0.02)
    # Particles are evenly spread along the line: no step is longer than its share, and most
    # are as long, but for corners and the curvature within half a degree.
    share = (1 - slack) * length / (count - 1)
    assert steps.max() <= share * (1 + 1e-9)
    np.testing.assert_allclose(np.median(steps), share, rtol=1e-3)
    np.testing.assert_array_equal(found[:, 2], body.radius)
    low, high = found[:, :2].min(axis=0), found[:, :2].max(axis=0)
    np.testing.assert_allclose(low + high, 0.0, atol=2 * share)


@given(name=shapes, count=st.integers(21, 80))
def test_a_letter_is_a_goal(name, count):
    body = rope(count, 0.5)
    goals.check_goal(body, goals.letter(body, name))


# Each letter by how much it turns, left positive, in degrees (a bow loses up to one step at
# either end of the angles between steps).
@pytest.mark.parametrize(
    ("name", "turns"),
    [("S", [270, -270]), ("O", [350]), ("C", [270]), ("U", [180]), ("M", [-135, 90, -135])],
)
def test_letters_turn_as_they_are_written(name, turns):
    bend = np.rad2deg(bends(goals.letter(rope(801, 0.5), name)))
    bend[np.abs(bend) < 1e-3] = 0.0
    runs = np.split(bend, np.flatnonzero(np.diff(np.sign(bend))) + 1)
    totals = [total for run in runs if abs(total := run.sum()) > 5]
    np.testing.assert_allclose(totals, turns, atol=3)


def test_an_s_is_two_circles_that_touch():
    found = goals.letter(rope(401, 0.6), "S") @ np.array([1, 1j, 0])
    radius = 0.6 / (3 * np.pi)  # two arcs of 3/2 pi
    upper, upper_radius = circle_through(*found[[0, 100, 199]])
    lower, lower_radius = circle_through(*found[[201, 300, 400]])
    # The arcs are polygons with corners half a degree apart.
    np.testing.assert_allclose([upper_radius, lower_radius], radius, rtol=1e-4)
    np.testing.assert_allclose([upper, lower], [1j * radius, -1j * radius], atol=1e-4 * radius)
    assert found[0].real > 0 > found[-1].real  # an S, and not its mirror image


def test_letters_are_upright():
    body = rope(201, 0.5)
    for name, opening in (("C", [1, 0]), ("U", [0, 1]), ("O", [0, 1])):
        found = goals.letter(body, name)
        ends = found[[0, -1], :2].mean(axis=0)
        away = ends - found[:, :2].mean(axis=0)
        assert away @ np.array(opening) > 0.5 * np.linalg.norm(away)
    middle = goals.letter(body, "M")[100]
    np.testing.assert_allclose(middle[:2], [0, 0], atol=1e-9)  # the notch between two peaks


def test_the_length_of_a_rope_is_along_it():
    body = rope_along(goals.letter(rope(101, 0.5), "U"))
    steps = np.linalg.norm(np.diff(goals.letter(body, "C"), axis=0), axis=1)
    np.testing.assert_allclose(steps.sum(), 0.5, rtol=1e-2)


@pytest.mark.parametrize("name", ["s", "X", ""])
def test_a_letter_that_is_none_is_refused(name):
    with pytest.raises(ValueError, match=f"letter is '{name}'; choose from C, M, O, S, U"):
        goals.letter(rope(), name)


@pytest.mark.parametrize("slack", [-0.1, 1.0, float("nan")])
def test_slack_is_a_share(slack):
    for make in (
        lambda: goals.letter(rope(), "C", slack),
        lambda: goals.crossed_triangle(rope(), slack),
    ):
        with pytest.raises(
            ValueError, match=r"slack is .*; give a number from 0 to 0.999 of the rest length"
        ):
            make()


# --- crossings -----------------------------------------------------------------------------------


@given(count=st.integers(60, 120), slack=st.floats(0, 0.3), tail=st.floats(0.2, 1.0))
def test_a_crossed_triangle_is_equilateral_with_two_tails(count, slack, tail):
    length = 0.6
    body = rope(count, length)
    found = goals.crossed_triangle(body, slack, tail)
    side = (1 - slack) * length / (3 + 2 * tail)
    # The first end, up to the first corner, is a straight line through the top.
    first, last = found[0, :2], found[-1, :2]
    np.testing.assert_allclose(first - last, [-tail * side, 0], atol=1e-9)
    heights = found[:, 1] - found[:, 1].min()
    np.testing.assert_allclose(heights[0], (1 + tail) * np.sqrt(3) / 2 * side, rtol=1e-6)
    steps = np.linalg.norm(np.diff(found[:, :2], axis=0), axis=1)
    np.testing.assert_allclose(np.sort(steps)[3:], (1 - slack) * length / (count - 1), rtol=1e-9)
    goals.check_goal(body, found)
    # Where the later part crosses the earlier one it is a thickness above it.
    assert found[: count // 2, 2].max() == body.radius
    np.testing.assert_allclose(found[:, 2].max(), 3 * body.radius, rtol=1e-12)


def height_at(points, share, start):
    return (1 - share) * points[start, 2] + share * points[start + 1, 2]


@given(seed=st.integers(0, 10**6))
def test_a_rope_that_crosses_itself_is_a_thickness_above_itself(seed):
    rng = np.random.default_rng(seed)
    body = rope(30, 0.5)
    corners = rng.uniform(-0.2, 0.2, (3, 2))
    line = np.concatenate([corners, corners[:1] + 0.3 * (corners[:1] - corners[2:])])
    assume(abs(np.linalg.det(corners[1:] - corners[0])) > 0.01)
    # The last leg goes on from the third corner through the first: it meets the start there.
    line[-1] += 0.15 * (corners[1] - corners[0])
    start = goals.polyline(body, line)
    found = goals.lift_crossings(body, start)
    np.testing.assert_array_equal(found[:, :2], start[:, :2])
    for j in range(2, 29):
        for i in range(j - 1):
            matrix = np.stack([start[i + 1] - start[i], start[j] - start[j + 1]], 1)[:2]
            if abs(np.linalg.det(matrix)) < 1e-12:
                continue
            shares = np.linalg.solve(matrix, (start[j] - start[i])[:2])
            if (shares > 0).all() and (shares < 1).all():
                above = height_at(found, shares[1], j) - height_at(found, shares[0], i)
                assert above >= 2 * body.radius * (1 - 1e-9)


def test_a_rope_that_crosses_itself_at_a_particle_is_lifted_there():
    line = np.array([[-1, 0], [0, 0], [1, 0], [1, 1], [0, 1], [0, 0], [0, -1]]) * 0.1
    body = rope(7, 0.6)
    flat = np.concatenate([line, np.full((7, 1), body.radius)], axis=1)
    found = goals.lift_crossings(body, flat)
    assert found[1, 2] == body.radius
    np.testing.assert_allclose(found[5, 2], 3 * body.radius, rtol=1e-12)


def test_a_rope_that_does_not_cross_itself_stays_down():
    body = rope(41, 0.5)
    for found in (goals.letter(body, "M"), goals.straight(body)):
        np.testing.assert_array_equal(goals.lift_crossings(body, found), found)


def test_a_tail_has_a_length():
    with pytest.raises(
        ValueError, match=r"tail is 0.0; give a number from 0.001 to 1000 times the"
    ):
        goals.crossed_triangle(rope(), tail=0.0)
