"""Rest coordinates from goals: folds and crumples undone, and what is no flat sheet refused."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxsimp import goals
from jaxsimp.bodies import cloth
from jaxsimp.bodies.garments import t_shirt, trousers
from jaxsimp.bodies.topology import half_edges
from jaxsimp.goals.flatten import flatten
from jaxsimp.simplification import simplify

CLOTH = cloth()  # 25 x 25, 0.3 m
FOLDS = ("side", "diagonal", "letter", "quarter")


def folded(body, name):
    return goals.fold_sequence(body, goals.rectangle_folds(body, name))


def distance(found, wanted):
    """Largest distance between points, after the best rigid motion or reflection (Kabsch)."""
    a, b = found - found.mean(axis=0), wanted - wanted.mean(axis=0)
    u, _, vt = np.linalg.svd(a.T @ b)
    return np.linalg.norm(a @ u @ vt - b, axis=1).max()


def longest_excess(body, goal):
    """By how much the thickness of the layers makes the worst edge longer than at rest."""
    a, b = half_edges(body.faces)[0].T
    at_rest, now = (np.linalg.norm(points[b] - points[a], axis=1) for points in (body.rest, goal))
    return (now - at_rest).max()


# --- folds ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", FOLDS)
def test_folds_of_no_thickness_are_undone(name):
    # Layers coincide in space, and every edge has its length: the rest coordinates are exact.
    thin = cloth(thickness=0.0)
    found = flatten(folded(thin, name), thin.faces)
    assert distance(found, thin.rest[:, :2]) < 1e-8  # Gauss-Newton has settled long before


@pytest.mark.parametrize("name", FOLDS)
def test_thickness_moves_particles_no_farther_than_it_lengthens_edges(name):
    # Edges climb from layer to layer at a crease, and are 0.2 to 3.5 mm too long there.
    goal = folded(CLOTH, name)
    found = flatten(goal, CLOTH.faces)
    # The diagonal is crossed along x and along y.
    limit = np.sqrt(2) * longest_excess(CLOTH, goal)
    assert distance(found, CLOTH.rest[:, :2]) <= limit + 1e-6


@pytest.mark.parametrize("name", FOLDS)
def test_noise_moves_particles_little(name):
    goal = folded(CLOTH, name)
    noisy = goal + np.random.default_rng(0).normal(scale=5e-4, size=goal.shape)
    found = flatten(noisy, CLOTH.faces)
    # An edge errs by 0.7 mm, a row of 24 edges by sqrt(24) times that.
    limit = longest_excess(CLOTH, goal) + np.sqrt(24) * 0.7e-3
    assert distance(found, CLOTH.rest[:, :2]) <= limit


@pytest.mark.parametrize("name", FOLDS)
def test_key_points_are_those_of_the_goal_with_rest(name, tmp_path):
    goal = folded(CLOTH, name)
    np.savez(tmp_path / "with.npz", positions=goal, rest=CLOTH.rest, faces=CLOTH.faces)
    np.savez(tmp_path / "without.npz", positions=goal, faces=CLOTH.faces)
    models = [simplify(*goals.load_goal(tmp_path / f"{each}.npz")) for each in ("with", "without")]
    np.testing.assert_array_equal(models[0].particles, models[1].particles)


@pytest.mark.parametrize("radius", [0.0, 0.002])
def test_a_crease_across_edges_costs_a_triangle_at_most(radius):
    # The crease runs across the diagonals of the cells: their ends coincide, but for thickness.
    body = cloth(thickness=2 * radius)
    goal = goals.fold(body, goals.flat(body), np.zeros(2), np.array([1.0, 1.0]))
    found = flatten(goal, CLOTH.faces)
    assert distance(found, CLOTH.rest[:, :2]) < np.sqrt(2) * CLOTH.spacing


def test_garments_are_laid_flat():
    shirt = t_shirt(num_particles=300)
    flat = flatten(goals.flat(shirt.body), shirt.body.faces)
    assert distance(flat, shirt.body.rest[:, :2]) < 1e-6
    # Turned into a box no larger than the one along the shirt's own axes.
    assert np.ptp(flat, axis=0).prod() < np.ptp(shirt.body.rest[:, :2], axis=0).prod() + 1e-6
    folded_in = flatten(goals.fold_sequence(shirt.body, goals.sleeves_in(shirt)), shirt.body.faces)
    edges = half_edges(shirt.body.faces)[0]
    lengths = np.linalg.norm(np.diff(shirt.body.rest[edges], axis=1), axis=2)
    assert distance(folded_in, shirt.body.rest[:, :2]) < np.median(lengths)


def test_a_layout_that_starts_turned_over_is_unfolded():
    # Paths around the crotch are longer than the plane's: scaling lets some triangles turn
    # over there. Their edges have to be let go before they can turn back.
    body = trousers(num_particles=600).body
    assert distance(flatten(goals.flat(body), body.faces), body.rest[:, :2]) < 1e-3


@settings(max_examples=10)
@given(
    st.lists(st.floats(0.0, 2 * np.pi), min_size=10, max_size=10),
    st.floats(0.02, 1.0),
    st.integers(0, 10**6),
)
def test_a_sheet_bent_along_its_rows_is_undone(angles, length, seed):
    # Rows follow a path of equal steps in any directions: an isometry, whatever coincides.
    body = cloth((11, 7), (length, 0.5 * length))
    step = length / 10
    path = np.cumsum([[0.0, 0.0], *(step * np.array([np.cos(a), np.sin(a)]) for a in angles)], 0)
    x, z = np.repeat(path, 7, axis=0).T
    bent = np.stack([x, body.rest[:, 1], z], axis=1)
    turned = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    found = flatten(bent @ turned + 1.0, body.faces)
    assert distance(found, body.rest[:, :2]) < 1e-6 * length
    # The longer side lies along x, and the first triangle is counter-clockwise.
    np.testing.assert_allclose(np.ptp(found, axis=0), [length, length / 2], rtol=1e-6)
    a, b, c = found[body.faces[0]]
    assert np.linalg.det([b - a, c - a]) > 0


def test_the_result_is_the_same_bit_for_bit():
    goal = folded(CLOTH, "letter")
    np.testing.assert_array_equal(flatten(goal, CLOTH.faces), flatten(goal, CLOTH.faces))


# --- refusals ------------------------------------------------------------------------------------


SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 1, 0]]) / 5
CAN = trimesh.creation.cylinder(0.1, 0.3)
SIDE = np.abs(CAN.face_normals[:, 2]) < 0.5  # a tube, without the ends of the can
TUBE = trimesh.Trimesh(CAN.vertices, CAN.faces[SIDE], process=True)
BALL = trimesh.creation.icosphere(2, 0.1)


@pytest.mark.parametrize(
    ("points", "faces", "message"),
    [
        (BALL.vertices, BALL.faces, "must be a disc, .*: it is closed; add rest"),
        (TUBE.vertices, TUBE.faces, "its Euler characteristic is 0, and a disc's is 1"),
        (SQUARE, [[0, 1, 2], [0, 2, 3]], "it is in 2 pieces"),
        (SQUARE, [[0, 1, 2], [0, 2, 3], [0, 2, 4]], "3 triangles meet at an edge"),
        (SQUARE, [[0, 1, 2], [2, 3, 4]], "parts of it touch at a point only"),
        (SQUARE, [[0, 1, 2], [0, 2, 5]], "a triangle names 5; the ids of 5 points are 0 to 4"),
        (SQUARE, [[0, 1, 2], [0, 2, -1]], "a triangle names -1"),
        (
            SQUARE[:3],
            [[0, 1, 2], [1, 1, 2]],
            "triangle 1 names a point twice .1 such triangles.; leave",
        ),
        (SQUARE[:3, [0, 2, 2]], [[0, 1, 2]], "all particles lie on a line"),
        (SQUARE[:3] * 100, [[0, 1, 2]], "extent of positions is 20 m; a body is 0.01 to 5 m"),
        (SQUARE[:3], np.zeros((0, 3), int), r"there are no faces; give at least one"),
    ],
)
def test_what_is_no_disc_of_a_body_is_refused(points, faces, message):
    with pytest.raises(ValueError, match=message):
        flatten(np.array(points, dtype=float), np.array(faces, dtype=np.int64))


def dome(angle):
    """A cloth over a ball, from the top to an angle at the middle of its sides, radians."""
    flat = CLOTH.rest[:, :2]
    radius = 0.15 / angle
    around = np.linalg.norm(flat, axis=1) / radius
    return np.column_stack([flat * np.sinc(around / np.pi)[:, None], radius * np.cos(around)])


def test_what_is_not_flat_at_rest_is_refused():
    flatten(dome(0.4), CLOTH.faces)
    with pytest.raises(ValueError, match=r"its edges change by \d\.\d% in the median; 5% is"):
        flatten(dome(1.6), CLOTH.faces)


def test_a_crumple_that_does_not_lie_flat_is_refused():
    noise = np.random.default_rng(0).normal(scale=4e-3, size=CLOTH.rest.shape)
    with pytest.raises(ValueError, match=r"cannot be laid flat: \d+ pairs of neighbouring"):
        flatten(CLOTH.rest + noise, CLOTH.faces)
