"""Registration: particles are found in goals of other points, or these are refused.

The oracle is a map of the body at rest into space that keeps lengths: it gives both the goal's
points and where each particle truly is.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxsimp import goals
from jaxsimp.bodies import cloth, mesh_outline, rope, t_shirt, trousers
from jaxsimp.goals import register

CLOTH = cloth((13, 13))
ROPE = rope(31)
SQUARE = 0.15 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
OTHER = mesh_outline(SQUARE, 300)


def rolled(rest, radius, start=-1.0, angle=9.0):
    """A sheet rolled up about y, from an x on, by up to an angle: an isometry of its plane."""
    along = np.clip((rest[:, 0] - start) / radius, 0, angle)
    beyond = rest[:, 0] - start - radius * along
    x = start + radius * np.sin(along) + np.cos(along) * beyond
    z = 0.002 + radius * (1 - np.cos(along)) + np.sin(along) * beyond
    return np.stack([x, rest[:, 1], z], axis=1)


def bent(rest):
    return rolled(rest, 0.2, -0.2)


def folded(rest, gap=0.1):
    """Folded in half, the layers a distance apart."""
    return rolled(rest, gap / 2, -gap * np.pi / 4, np.pi)


def shuffled(rng, points, faces, noise=0.0):
    """The points in another order, with noise, and their triangles."""
    order = rng.permutation(len(points))
    moved = points + rng.normal(scale=noise, size=points.shape) if noise else points
    return moved[order], np.argsort(order)[faces]


@pytest.mark.parametrize("is_mesh", [True, False])
@pytest.mark.parametrize("state", [goals.flat, bent, folded])
def test_particles_in_another_order_are_found_to_the_bit(state, is_mesh):
    true = state(CLOTH) if state is goals.flat else state(CLOTH.rest)
    points, faces = shuffled(np.random.default_rng(0), true, CLOTH.faces)
    found = register(CLOTH, points, faces if is_mesh else None, start=true)
    np.testing.assert_array_equal(found.positions, true)
    assert found.num_alike == 8  # a square, turned and turned over
    # Chords of the bent cloth are up to 2 % shorter than its arcs.
    assert found.error < 0.01


@pytest.mark.parametrize("is_mesh", [True, False])
@settings(max_examples=3)
@given(seed=st.integers(0, 10**6), state=st.sampled_from([bent, folded]))
def test_a_goal_of_other_points_gives_each_particle_its_place(seed, state, is_mesh):
    noise = 1e-3
    points, faces = OTHER
    points, faces = shuffled(np.random.default_rng(seed), state(points), faces, noise)
    true = state(CLOTH.rest)
    found = register(CLOTH, points, faces if is_mesh else None, start=true)
    away = np.linalg.norm(found.positions - true, axis=1)
    # Noise itself is 1.7 mm away; what is left is the layout's, summed over 17 edges.
    assert np.sqrt((away**2).mean()) < 5e-3
    assert found.error < 0.01


def test_a_garment_with_arms_is_laid_out():
    body, finer = (trousers(num_particles=count).body for count in (300, 1500))
    true = bent(body.rest)
    found = register(body, bent(finer.rest), finer.faces, start=true)
    assert found.num_alike == 2  # its mirror image, turned over
    # Chords of the mesh are h^2 / 8r below the arc: 0.4 mm at edges of 25 mm.
    assert np.abs(found.positions - true).max() < 2e-3


def test_the_way_nearest_to_the_start_is_taken():
    points, _ = shuffled(np.random.default_rng(1), goals.flat(CLOTH), CLOTH.faces)
    np.testing.assert_array_equal(register(CLOTH, points).positions, goals.flat(CLOTH))
    start = goals.flat(CLOTH, np.pi / 2)
    np.testing.assert_allclose(register(CLOTH, points, start=start).positions, start, atol=1e-12)


def test_a_cloud_whose_layers_touch_is_refused_and_its_mesh_is_not():
    true = folded(CLOTH.rest, 0.01)
    points, faces = shuffled(np.random.default_rng(2), true, CLOTH.faces)
    with pytest.raises(ValueError, match=r"of a cloud whose layers touch give a mesh \(add faces"):
        register(CLOTH, points)
    np.testing.assert_array_equal(register(CLOTH, points, faces, start=true).positions, true)


@pytest.mark.parametrize("fraction", [0.25, 0.5])
@pytest.mark.parametrize("gap", [0.002, 0.01, 0.03])
def test_a_cloud_is_right_or_refused(fraction, gap):
    """Wherever a corner of the cloth lies on it, and at any distance of the layers."""
    turn = np.array([[1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 2**0.5]]) / 2**0.5
    line = 0.21 - 0.42 * fraction
    true = rolled(CLOTH.rest @ turn, gap / 2, line, np.pi)
    points, _ = shuffled(np.random.default_rng(3), true, CLOTH.faces)
    try:
        found = register(CLOTH, points, start=true)
    except ValueError as error:
        assert "touch" in str(error)  # noqa: PT017 - either is right
    else:
        assert np.abs(found.positions - true).max() < 0.02


def test_a_coarse_cloud_whose_layers_are_as_near_as_its_points_is_refused():
    """40 mm apart, the points 21 mm: laid flat it would have about the outline of the cloth."""
    fine, coarse = cloth((25, 25)), cloth((15, 15))
    true, points = (rolled(body.rest, 0.02, 0.02, np.pi) for body in (fine, coarse))
    with pytest.raises(ValueError, match="layers of the cloth are as near to each other as"):
        register(fine, points, start=true)


# --- ropes ---------------------------------------------------------------------------------------


def between(goal, count, rng):
    """Random points of a rope, in no order; its ends are among them."""
    at = np.concatenate([[0.0, len(goal) - 1.0], rng.uniform(0, len(goal) - 1, count - 2)])
    index = np.arange(len(goal))
    return rng.permutation(np.stack([np.interp(at, index, axis) for axis in goal.T], axis=1))


@given(seed=st.integers(0, 10**6), letter=st.sampled_from("CMSU"))
def test_particles_of_a_rope_in_another_order_are_found_to_the_bit(seed, letter):
    goal = goals.letter(ROPE, letter)
    points = np.random.default_rng(seed).permutation(goal)
    found = register(ROPE, points, start=goal)
    np.testing.assert_array_equal(found.positions, goal)
    assert (found.error, found.num_alike) == (0.0, 2)
    backwards = register(ROPE, points, start=goal[::-1])
    np.testing.assert_array_equal(backwards.positions, goal[::-1])


@pytest.mark.parametrize(("count", "noise"), [(300, 0.0), (1000, 2e-3)])
@pytest.mark.parametrize("letter", "CMSU")
def test_a_rope_lies_along_a_dense_cloud(letter, count, noise):
    rng = np.random.default_rng(0)
    goal = goals.letter(ROPE, letter)
    points = between(goal, count, rng) + rng.normal(scale=noise, size=(count, 3)) * (noise > 0)
    found = register(ROPE, points, start=goal).positions
    # Averages of points 17 mm apart cut the corners of an M; the rest is spread over its length.
    limit = ROPE.spacing * (1.0 if letter == "M" else 0.35)
    assert np.linalg.norm(found - goal, axis=1).max() < limit


def test_without_a_start_the_first_point_is_at_the_first_end():
    goal = goals.letter(ROPE, "U")
    order = np.random.default_rng(0).permutation(len(goal))
    for end, wanted in ((0, goal), (30, goal[::-1])):
        order = np.concatenate([[end], order[order != end]])
        np.testing.assert_array_equal(register(ROPE, goal[order]).positions, wanted)


@pytest.mark.parametrize(
    "goal",
    [
        goals.lift_crossings(ROPE, goals.crossed_triangle(ROPE)),
        goals.letter(ROPE, "O"),
        goals.polyline(ROPE, np.array([[0.0, 0.0], [0.25, 0.0], [0.25, 0.006], [0.0, 0.006]])),
    ],
)
def test_a_rope_that_meets_itself_is_refused(goal):
    with pytest.raises(ValueError, match=r"touches or crosses itself .*: give its points in order"):
        register(ROPE, np.random.default_rng(0).permutation(goal))


# --- refusals ------------------------------------------------------------------------------------

TWO_SHEETS = t_shirt(num_particles=200, sheets=2).body
FACES = OTHER[1]


@pytest.mark.parametrize(
    ("body", "points", "faces", "message"),
    [
        (CLOTH, OTHER[0][:2], None, "the goal has 2 points, .*; 3 to 20000 points"),
        (CLOTH, OTHER[0] * np.nan, None, r"points\[0\] is \[nan, nan, nan\]"),
        (CLOTH, OTHER[0] * 1e3, None, r"is 300 m; .* scale=0\.001"),
        (CLOTH, OTHER[0] * 1.3, FACES, "the cloth is only .* m long between them"),
        (CLOTH, OTHER[0] * [1.0, 0.7, 1.0], FACES, "laid flat, the goal reaches .* short by that"),
        (CLOTH, OTHER[0] * [1.0, 0.0, 1.0], None, "lie on a line, .* with a spread of .* m"),
        (ROPE, OTHER[0] * 0.0, None, "at one place, with a spread of 0 m; give points of a rope"),
        (CLOTH, OTHER[0], FACES[:0], "there are no faces; give triangles, or None for a cloud"),
        (CLOTH, OTHER[0], FACES + 300, "a triangle names"),
        (CLOTH, np.concatenate([OTHER[0], OTHER[0] + 1.0]), None, "are in 2 pieces"),
        (TWO_SHEETS, OTHER[0], FACES, "the T-shirt has several layers at rest"),
        (ROPE, ROPE.rest * 0.8, None, "is 0.4 m long, and the rope 0.5 m; 0.9 to 1.2 of that"),
        (ROPE, OTHER[0], None, "leaves out points|meets itself|m long"),
    ],
)
def test_what_does_not_fit_is_refused(body, points, faces, message):
    with pytest.raises(ValueError, match=message):
        register(body, points, faces)


def test_points_that_are_there_twice_do_no_harm():
    goal = goals.letter(ROPE, "S")
    found = register(ROPE, np.concatenate([goal, goal[::3]]), start=goal)
    np.testing.assert_array_equal(found.positions, goal)


def test_a_closed_mesh_is_no_goal_of_a_sheet():
    corners = 0.1 * np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    with pytest.raises(ValueError, match=r"the mesh of the goal is closed, .*; a sheet has"):
        register(CLOTH, corners, faces)
