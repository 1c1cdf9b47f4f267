import zlib
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import Delaunay
from scipy.spatial.transform import Rotation

from experiments.ideal_goals import FOLDS, NOISES, add_noise, ideal_goal, is_right
from jaxsimp import bodies, goals
from jaxsimp.bodies.topology import boundary_edges
from jaxsimp.simplification import simplify, simplify_meshlab, simplify_quadric
from jaxsimp.simplification.interpolation import interpolation_weights
from jaxsimp.simplification.key_points import FitStatus
from jaxsimp.simplification.surfaces import parametric
from jaxsimp.simplification.surfaces.common import rest_normals
from jaxsimp.simplification.surfaces.parametric import simplify_parametric

ROUNDING = 1e-9  # metres, of sums over some hundred particles of a sheet of 0.3 m

seeds = st.integers(0, 2**32 - 1)


@cache
def cloth(count, other=None):
    return bodies.cloth((count, other or count), (0.3, 0.3 * (other or count) / count))


def robust(sheet, goal, **options):
    [points] = simplify_parametric(sheet, goal[None], **options)
    return points


def mesh_body(rest, faces):
    """A body of any triangles, with springs along their edges."""
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    springs = np.unique(edges, axis=0)
    lengths = np.linalg.norm(rest[springs[:, 1]] - rest[springs[:, 0]], axis=1)
    plain = bodies.cloth((3, 3))
    return replace(
        plain,
        name="mesh",
        rest=rest.copy(),
        mass=np.full(len(rest), 1e-4),
        springs=springs,
        families=np.zeros(len(springs), dtype=int),
        rest_length=lengths,
        stiffness=np.ones(len(springs)),
        damping=np.ones(len(springs)),
        faces=faces.astype(np.int64),
        shape=(len(rest),),
    )


def scattered(rng, inside, count=400):
    """A mesh of random points of a part of the unit square, the triangles unequal."""
    points = rng.uniform(size=(4 * count, 2))
    points = points[inside(*points.T)][:count]
    faces = Delaunay(points).simplices
    faces = faces[inside(*points[faces].mean(axis=1).T)]
    used, faces = np.unique(faces, return_inverse=True)
    rest = np.column_stack([points[used], np.zeros(len(used))])
    return mesh_body(rest, faces.reshape(-1, 3))


def crumpled(sheet, rng, height=0.02):
    """A goal that is a smooth, random deformation of a body."""
    rest = sheet.rest * 0.3 / sheet.size
    return sheet.rest + sheet.size / 0.3 * sum(
        np.outer(np.sin(rest @ rng.normal(scale=15, size=3) + rng.uniform(0, 6)), direction)
        for direction in rng.normal(scale=height, size=(3, 3))
    )


def signed_areas(rest, faces):
    a, b, c = np.swapaxes(rest[faces, :2], 0, 1)
    (x, y), (u, v) = (b - a).T, (c - a).T
    return (x * v - y * u) / 2


# --- what is right --------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(13, 13), (25, 25), (16, 24)])
@pytest.mark.parametrize("name", FOLDS)
def test_known_folds_have_their_key_points(shape, name):
    ideal = ideal_goal(cloth(*shape), name)
    assert is_right(robust(ideal.body, ideal.goal), ideal)


@pytest.mark.parametrize("name", FOLDS)
@pytest.mark.parametrize("kind", NOISES)
def test_noise_of_two_millimetres_changes_nothing(name, kind):
    ideal = ideal_goal(cloth(25), name, gap=0.01, rounding=0.004)
    noisy = add_noise(ideal, kind, 0.002, zlib.crc32(name.encode()))
    assert is_right(robust(ideal.body, noisy.goal), ideal)


@pytest.mark.parametrize("gap", [0.0, 0.01])
def test_noise_as_large_as_half_the_spacing_changes_nothing(gap):
    ideal = ideal_goal(cloth(64), "quarter", gap=gap)
    noisy = add_noise(ideal, "white", 0.002, 0)
    assert is_right(robust(ideal.body, noisy.goal), ideal)


def test_a_flat_sheet_has_its_corners():
    points = robust(cloth(13), goals.flat(cloth(13), 0.4))
    assert points.particles.tolist() == [0, 12, 156, 168]
    assert points.error == pytest.approx(0.0, abs=1e-7)  # square root of 1e-14
    assert points.tolerance == pytest.approx(0.03)
    assert points.status == FitStatus.FITS
    assert not points.certified


def test_the_default_tolerance_is_a_tenth_of_the_side_of_a_square_of_its_area():
    strip = bodies.cloth((5, 17), (0.1, 0.4))
    assert robust(strip, goals.flat(strip)).tolerance == pytest.approx(0.02)


def test_a_small_part_counts_as_much_as_a_large_one():
    """A sleeve of a fiftieth of the area, folded: the mean square would not see it."""
    shirt = scattered(
        np.random.default_rng(3),
        lambda x, y: (x < 0.7) | ((y > 0.4) & (y < 0.55)),
        count=900,
    )
    goal = goals.fold(shirt, shirt.rest, np.array([0.75, 0.0]), np.array([0.0, -1.0]))
    points = robust(shirt, goal, tolerance=0.04)  # without the crease it is off by 0.07
    rest = shirt.rest[points.particles]
    assert points.status == FitStatus.FITS
    assert rest[:, 0].max() > 0.9  # the end of the sleeve
    assert np.linalg.norm(rest[:, :2] - [0.75, 0.475], axis=1).min() < 0.15  # and its crease


# --- invariants -----------------------------------------------------------------------------


@given(seeds, st.floats(0.05, 5.0))
@settings(max_examples=8)
def test_motions_and_scale_change_nothing(seed, scale):
    rng = np.random.default_rng(seed)
    sheet = cloth(9)
    goal = crumpled(sheet, rng)
    first = robust(sheet, goal)
    turn, shift = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)
    second = robust(sheet, goal @ turn.T + shift)
    larger = mesh_body(scale * sheet.rest, sheet.faces)
    third = robust(larger, scale * goal)
    for other, factor in ((second, 1.0), (third, scale)):
        assert np.array_equal(first.particles, other.particles)
        assert np.array_equal(first.elements, other.elements)
        assert np.allclose(np.multiply(first.errors, factor), other.errors, rtol=1e-6, atol=0)
    assert np.allclose(first.positions @ turn.T + shift, second.positions, rtol=0, atol=ROUNDING)


@given(seeds)
@settings(max_examples=10)
def test_models_of_every_size_are_discs_that_cover_the_sheet(seed):
    rng = np.random.default_rng(seed)
    sheet = cloth(9, 12)
    models = all_models(sheet, crumpled(sheet, rng))
    assert set(models) == set(range(3, 25))
    for size, model in models.items():
        faces = model.vertices[model.triangles]
        assert size == len(model.vertices) == len(np.unique(faces))
        edges, _ = boundary_edges(faces)
        assert len(faces) == 2 * size - 2 - len(edges)  # Euler: a disc
        areas = signed_areas(sheet.rest, faces)
        assert areas.min() > 0
        # A boundary vertex never leaves the boundary, so what is lost are corners.
        assert areas.sum() <= 0.3 * 0.4 * (1 + ROUNDING)
        if {0, 11, 96, 107} <= set(model.vertices.tolist()):
            assert areas.sum() == pytest.approx(0.3 * 0.4)


def all_models(sheet, goal, size=24):
    scale = np.sqrt(np.linalg.norm(rest_normals(sheet.rest, sheet.faces), axis=1).sum())
    return parametric._models(parametric._sheet(sheet, goal, scale), sheet.faces, size, 0.1)


@given(seeds)
@settings(max_examples=10)
def test_the_error_is_that_of_a_fit_by_dense_least_squares(seed):
    """Weights by locating every particle in every triangle, positions by numpy's lstsq."""
    sheet = cloth(9)
    goal = crumpled(sheet, np.random.default_rng(seed))
    points = robust(sheet, goal, tolerance=0.02)
    # Of a rectangle whose corners are key points no particle is outside.
    assert {0, 8, 72, 80} <= set(points.particles.tolist())
    weights = interpolation_weights(sheet.rest, points.particles, points.elements)
    area = np.zeros(81)
    for face in sheet.faces:
        area[face] += 1.0  # all are alike
    root = np.sqrt(area)[:, None]
    expected, *_ = np.linalg.lstsq(root * weights, root * goal)
    off = np.linalg.norm(weights @ expected - goal, axis=1)
    assert np.allclose(points.positions, expected, rtol=0, atol=ROUNDING)
    assert points.error == points.max_error == pytest.approx(off.max(), abs=ROUNDING)
    assert points.rms_error == pytest.approx(np.sqrt(np.mean(off**2)), abs=ROUNDING)


@given(seeds)
@settings(max_examples=10)
def test_key_points_are_particles_and_the_first_size_that_fits(seed):
    sheet = cloth(9)
    points = robust(sheet, crumpled(sheet, np.random.default_rng(seed)))
    assert (np.diff(points.particles) > 0).all()
    assert np.array_equal(np.unique(points.elements), np.arange(len(points)))
    at = points.sizes.index(len(points))
    first = 3 if 3 in points.sizes else 4
    assert points.sizes[: at + 1] == tuple(range(first, len(points) + 1))
    if points.status == FitStatus.NO_FIT:  # one in fifty is too crumpled for 24 key points
        assert points.sizes == tuple(range(first, 25))
        assert points.tolerance <= points.error == min(points.errors)
    else:
        assert points.error < points.tolerance <= min(points.errors[:at], default=np.inf)
        assert len(points.sizes) - 1 - at <= 3


def test_the_same_goal_gives_the_same_bits_alone_and_in_a_batch():
    sheet = cloth(13)
    batch = np.stack([crumpled(sheet, np.random.default_rng(seed)) for seed in range(4)])
    before = batch.copy()
    together = simplify_parametric(sheet, batch)
    assert np.array_equal(batch, before)
    for goal, points in zip(batch, together, strict=True):
        alone = robust(sheet, goal)
        assert np.array_equal(alone.particles, points.particles)
        assert np.array_equal(alone.elements, points.elements)
        assert alone.positions.tobytes() == points.positions.tobytes()
        assert alone.errors == points.errors


# --- other bodies ---------------------------------------------------------------------------


def test_a_body_with_a_hole_keeps_it():
    ring = scattered(np.random.default_rng(0), lambda x, y: np.hypot(x - 0.5, y - 0.5) > 0.3)
    goal = goals.fold(ring, ring.rest, np.array([0.5, 0.5]), np.array([0.0, 1.0]))
    points = robust(ring, goal)
    assert points.status == FitStatus.FITS
    faces = points.particles[points.elements]
    assert euler(faces) == euler(ring.faces) == 0
    assert trimesh.Trimesh(ring.rest, faces, process=False).is_winding_consistent
    assert signed_areas(ring.rest, faces).min() > 0


def euler(faces):
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    return len(np.unique(faces)) - len(np.unique(edges, axis=0)) + len(faces)


def test_an_outline_that_is_not_convex_is_folded_along_its_parts():
    """Trousers, one leg over the other: the crease runs from the waist to the crotch."""
    trousers = scattered(
        np.random.default_rng(1), lambda x, y: (y > 0.6) | (x < 0.4) | (x > 0.6), count=900
    )
    goal = goals.fold(trousers, trousers.rest, np.array([0.5, 0.0]), np.array([0.0, 1.0]))
    points = robust(trousers, goal)
    assert points.status == FitStatus.FITS
    rest = trousers.rest[points.particles, :2]
    for wanted in ([0, 0], [0, 1], [1, 0], [1, 1], [0.5, 1]):
        assert np.linalg.norm(rest - wanted, axis=1).min() < 0.12  # two spacings
    assert signed_areas(trousers.rest, points.particles[points.elements]).min() > 0
    assert len(points) <= 10


def test_a_closed_surface_stays_closed_down_to_four_points():
    sphere = trimesh.creation.icosphere(subdivisions=3)
    ball = mesh_body(np.asarray(sphere.vertices), np.asarray(sphere.faces))
    models = all_models(ball, ball.rest)
    assert min(models) == 4
    for model in models.values():
        faces = model.vertices[model.triangles]
        assert trimesh.Trimesh(ball.rest, faces, process=False).is_watertight
        assert euler(faces) == 2
    points = robust(ball, ball.rest)
    assert points.status == FitStatus.FITS
    assert len(points) > 4  # no tetrahedron is within a tenth of a ball's size of it


def test_two_sides_that_coincide_at_rest_are_kept_apart():
    """A pillow: two sheets sewn at their rims, at rest upon each other; the upper one is lifted."""
    sheet = cloth(9)
    rim = np.unique(boundary_edges(sheet.faces)[0])
    inner = np.setdiff1d(np.arange(81), rim)
    upper = np.arange(81)
    upper[inner] = 81 + np.arange(len(inner))
    rest = np.concatenate([sheet.rest, sheet.rest[inner]])
    pillow = mesh_body(rest, np.concatenate([sheet.faces[:, ::-1], upper[sheet.faces]]))
    dome = 0.15 - np.abs(rest[:, :2]).max(axis=1)
    goal = rest + np.where(np.arange(len(rest)) >= 81, dome, 0.0)[:, None] * [0.0, 0.0, 1.0]
    points = robust(pillow, goal, tolerance=0.02)
    assert points.status == FitStatus.FITS
    assert len(points) == 5  # a pyramid, with its bottom
    assert 0.14 < points.positions[:, 2].max() < 0.16


def test_particles_of_no_triangle_are_left_out_of_account():
    sheet = cloth(9)
    stray = mesh_body(np.concatenate([sheet.rest, [[3.0, 3.0, 3.0]]]), sheet.faces)
    goal = goals.fold(sheet, goals.flat(sheet), np.zeros(2), np.array([0.0, 1.0]))
    points = robust(stray, np.concatenate([goal, [[-3.0, 0.0, 0.0]]]))
    expected = robust(sheet, goal)
    assert np.array_equal(points.particles, expected.particles)
    assert points.max_error == pytest.approx(expected.max_error, abs=ROUNDING)


# --- what does not fit ----------------------------------------------------------------------


def test_no_fit_is_the_best_model_tried():
    sheet = cloth(9)
    points = robust(sheet, crumpled(sheet, np.random.default_rng(0)), tolerance=1e-6, max_size=7)
    assert points.status == FitStatus.NO_FIT
    assert max(points.sizes) == 7
    assert len(points) == points.sizes[int(np.argmin(points.errors))]
    assert points.max_error == points.error


def test_no_model_of_so_few_points_is_no_key_point():
    sphere = trimesh.creation.icosphere(subdivisions=2)
    ball = mesh_body(np.asarray(sphere.vertices), np.asarray(sphere.faces))
    points = robust(ball, ball.rest, max_size=3)
    assert points.status == FitStatus.NO_FIT
    assert len(points) == 0
    assert points.error == np.inf


def test_a_goal_in_a_small_place_has_the_fewest_key_points():
    points = robust(cloth(5), goals.flat(cloth(5)) * 0.11)
    assert points.status == FitStatus.FITS
    assert len(points) <= 4


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tolerance": 0.0}, r"tolerance is 0.0; give a number from 1e-09 to 5 m"),
        ({"max_size": 2}, "max_size is 2; give a whole number of at least 3"),
    ],
)
def test_bad_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        robust(cloth(5), goals.flat(cloth(5)), **options)


def test_a_rope_is_refused():
    rope = bodies.rope()
    with pytest.raises(ValueError, match="the rope has 0 triangles; give a body with triangles"):
        robust(rope, goals.straight(rope))


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize("method", [simplify_parametric, simplify_quadric, simplify_meshlab])
def test_no_method_for_surfaces_takes_goals_of_another_body(method):
    sheet = cloth(5)
    goal = goals.flat(sheet)
    with pytest.raises(ValueError, match=r"the goal has shape \(24, 3\); give shape \(25, 3\)"):
        method(sheet, goal[None, :24])
    with pytest.raises(ValueError, match=r"the goal has shape \(3,\); give shape \(25, 3\)"):
        method(sheet, goal)
    goal[7, 1] = np.nan
    with pytest.raises(ValueError, match=r"particle 7 is .* give finite"):
        method(sheet, np.stack([goals.flat(sheet), goal]))


def test_the_entry_takes_a_cloth():
    ideal = ideal_goal(cloth(13), "side, x")
    points = simplify(ideal.body, ideal.goal, method="robust")
    assert is_right(points, ideal)
    assert points.method == "rest-aware collapse"
