from functools import cache

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jaxsimp import bodies, goals
from jaxsimp.simplification import simplify
from jaxsimp.simplification.key_points import FitStatus
from jaxsimp.simplification.surfaces.hausdorff import Surface, hausdorff_distance
from jaxsimp.simplification.surfaces.quadric import (
    collapse_sequence,
    follow_creases,
    simplify_quadric,
)

HALF = 0.15
CORNERS = [(-HALF, -HALF), (HALF, -HALF), (-HALF, HALF), (HALF, HALF)]
ENDS = {"x": [(-HALF, 0), (HALF, 0)], "y": [(0, -HALF), (0, HALF)], "xy": []}
SIDES = {(0, 1): "y", (0, -1): "y", (1, 0): "x", (-1, 0): "x"}
DIAGONALS = dict.fromkeys([(1, 1), (-1, -1), (1, -1), (-1, 1)], "xy")
FOLDS = {**SIDES, **DIAGONALS}

seeds = st.integers(0, 2**32 - 1)


@cache
def cloth(count):
    return bodies.cloth((count, count))


def quadric(sheet, goal, **options):
    [points] = simplify_quadric(sheet, goal[None], **options)
    return points


def folded(count, direction, angle=0.0):
    """The goal of a fold about the middle, the whole turned by `angle`."""
    cos, sin = np.cos(angle), np.sin(angle)
    turned = np.array([[cos, -sin], [sin, cos]]) @ np.array(direction, dtype=float)
    return goals.fold(cloth(count), goals.flat(cloth(count), angle), np.zeros(2), turned)


def assert_paper(points, count, direction):
    """The paper's key points, each within a particle spacing of where it belongs."""
    expected = np.array(CORNERS + ENDS[FOLDS[direction]])
    assert len(points) == len(expected)
    rest = cloth(count).rest[points.particles, :2]
    distance = np.linalg.norm(rest[:, None] - expected, axis=2)
    assert distance.min(axis=0).max() <= cloth(count).spacing * 1.001
    assert distance.min(axis=1).max() <= cloth(count).spacing * 1.001


def crumpled(rng, count=7):
    """A goal that is a smooth, random deformation of the sheet."""
    rest = cloth(count).rest
    waves = sum(
        np.outer(np.sin(rest @ rng.normal(scale=15, size=3) + rng.uniform(0, 6)), direction)
        for direction in rng.normal(scale=0.02, size=(3, 3))
    )
    return goals.flat(cloth(count)) + waves


@pytest.mark.parametrize("direction", [(0, 1), (1, 0), (1, 1), (1, -1)])
def test_folds_of_the_paper_have_its_key_points(direction):
    assert_paper(quadric(cloth(25), folded(25, direction)), 25, direction)


@pytest.mark.parametrize("count", [9, 12, 13])
@pytest.mark.parametrize("direction", FOLDS)
def test_other_meshes_have_the_same_key_points(count, direction):
    assert_paper(quadric(cloth(count), folded(count, direction)), count, direction)


@given(direction=st.sampled_from(list(FOLDS)), angle=st.floats(0, 2 * np.pi))
@settings(max_examples=8)
def test_a_turned_goal_has_the_same_key_points(direction, angle):
    assert_paper(quadric(cloth(13), folded(13, direction, angle)), 13, direction)


def test_a_flat_sheet_has_its_corners():
    points = quadric(cloth(13), goals.flat(cloth(13), 0.4))
    assert points.particles.tolist() == [0, 12, 156, 168]
    assert points.errors[0] == pytest.approx(0.0, abs=1e-7)  # square root of 1e-14
    assert points.tolerance == pytest.approx(0.03)


@given(seeds)
@settings(max_examples=10)
def test_key_points_are_particles_where_the_goal_has_them(seed):
    goal = crumpled(np.random.default_rng(seed))
    points = quadric(cloth(7), goal, tolerance=0.04, max_size=49)
    assert np.array_equal(points.positions, goal[points.particles])
    assert (np.diff(points.particles) > 0).all()
    assert np.array_equal(np.unique(points.elements), np.arange(len(points)))
    assert points.sizes == tuple(range(points.sizes[0], points.sizes[-1] + 1))
    before = points.errors[: points.sizes.index(len(points))]
    # Its edges are those of the collapse, turned: of a goal this crumpled even all particles can
    # fail to fit.
    assert points.tolerance <= min(before, default=np.inf)
    assert (points.error < points.tolerance) == (points.status == FitStatus.FITS)
    model = Surface(points.positions, points.elements)
    original = Surface(goal, cloth(7).faces)
    # Distances from the same samples, written with other vertex ids.
    sampling = max(points.tolerance / 10, cloth(7).spacing / 8)
    measured = hausdorff_distance(original, model, sampling)
    assert measured == pytest.approx(points.error, abs=1e-9)


@given(seeds)
@settings(max_examples=10)
def test_every_mesh_on_the_way_is_a_disc(seed):
    goal = crumpled(np.random.default_rng(seed))
    meshes = collapse_sequence(goal, cloth(7).faces, max_size=30)
    assert max(meshes) == 30
    for size, faces in meshes.items():
        used, compact = np.unique(faces, return_inverse=True)
        mesh = trimesh.Trimesh(goal[used], compact.reshape(-1, 3), process=False)
        assert len(used) == size
        assert mesh.euler_number == 1  # a disc, and one piece
        assert mesh.body_count == 1
        assert mesh.is_winding_consistent
        _, uses = np.unique(np.sort(mesh.edges, axis=1), axis=0, return_counts=True)
        assert uses.max() == 2  # manifold
        assert np.linalg.norm(mesh.triangles_cross, axis=1).min() > 1e-6 * goal.var()


@pytest.mark.parametrize("seed", range(3))
def test_the_sequence_matches_brute_force(seed):
    """At every step the cheapest of all collapses, found by trying each from its definition."""
    rng = np.random.default_rng(seed)
    sphere = trimesh.creation.icosphere(subdivisions=1)  # closed: no boundary to weigh
    points = np.asarray(sphere.vertices) + rng.normal(scale=0.1, size=sphere.vertices.shape)
    faces = np.asarray(sphere.faces)
    meshes = collapse_sequence(points, faces, max_size=len(points))
    planes = {v: planes_at(points, faces, v) for v in range(len(points))}
    for size in range(len(points) - 1, min(meshes) - 1, -1):
        costs = {
            pair: sum(
                area * (points[pair[1]] @ normal + offset) ** 2
                for end in pair
                for area, normal, offset in planes[end]
            )
            for pair in sound_collapses(points, faces)
        }
        removed, kept = min(costs, key=costs.__getitem__)
        planes[kept] += planes[removed]
        shared = (faces == removed).any(axis=1) & (faces == kept).any(axis=1)
        faces = np.where(faces == removed, kept, faces)[~shared]
        assert sorted(map(sorted, faces.tolist())) == sorted(map(sorted, meshes[size].tolist()))


def planes_at(points, faces, vertex):
    """Area, unit normal and offset of the plane of each triangle at a vertex."""
    planes = []
    for a, b, c in points[faces[(faces == vertex).any(axis=1)]]:
        normal = np.cross(b - a, c - a)
        twice = np.linalg.norm(normal)
        planes.append((twice / 2, normal / twice, -normal @ a / twice))
    return planes


def sound_collapses(points, faces):
    """Pairs (removed, kept) that keep the topology and turn no triangle over."""
    rings = {
        v: set(faces[(faces == v).any(axis=1)].ravel().tolist()) - {v}
        for v in np.unique(faces).tolist()
    }
    return [
        (v, w)
        for v in rings
        for w in rings[v]
        if len(rings[v] & rings[w]) == 2 and leaves_sound(points, faces, v, w)
    ]


def leaves_sound(points, faces, removed, kept):
    """Whether no triangle that stays is turned over or has a height next to nothing."""
    old = faces[(faces == removed).any(axis=1) & ~(faces == kept).any(axis=1)]
    before, after = points[old], points[np.where(old == removed, kept, old)]
    normals = [np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]) for t in (before, after)]
    longest = np.linalg.norm(after - np.roll(after, 1, axis=1), axis=2).max(axis=1)
    wide = np.linalg.norm(normals[1], axis=1) > 1e-3 * longest**2
    return bool((wide & (np.sum(normals[0] * normals[1], axis=1) >= 0)).all())


@given(seeds)
@settings(max_examples=10)
def test_meshes_of_a_flat_sheet_cover_it_without_overlap(seed):
    sheet = cloth(7)
    goal = goals.flat(sheet)
    inner = (np.abs(sheet.rest[:, :2]) < HALF - 1e-9).all(axis=1)
    jitter = np.random.default_rng(seed).uniform(-0.3, 0.3, size=(inner.sum(), 2))
    goal[np.ix_(inner, [0, 1])] += jitter * sheet.spacing
    meshes = collapse_sequence(goal, sheet.faces, 49)
    assert set(meshes) == set(range(4, 50))
    for faces in meshes.values():
        a, b, c = np.swapaxes(goal[faces, :2], 0, 1)
        (bx, by), (cx, cy) = (b - a).T, (c - a).T
        areas = (bx * cy - by * cx) / 2
        assert areas.min() > 0
        assert areas.sum() == pytest.approx(0.09)


def test_the_sequence_is_deterministic_and_leaves_its_input_alone():
    goal, faces = crumpled(np.random.default_rng(0)), cloth(7).faces
    before = goal.copy()
    first, second = (collapse_sequence(goal, faces, 10) for _ in range(2))
    assert all(np.array_equal(first[size], second[size]) for size in first)
    assert np.array_equal(goal, before)


def test_a_motion_in_space_changes_nothing():
    rng = np.random.default_rng(1)
    goal = crumpled(rng)
    turn = Rotation.random(rng=rng).as_matrix()
    moved = goal @ turn.T + [3.0, -2.0, 5.0]
    first, second = (quadric(cloth(7), g) for g in (goal, moved))
    assert np.array_equal(first.particles, second.particles)
    assert np.allclose(first.errors, second.errors, rtol=0.0, atol=2e-3)  # twice the bound


def test_a_closed_surface_stays_closed():
    sphere = trimesh.creation.icosphere(subdivisions=2)
    meshes = collapse_sequence(np.asarray(sphere.vertices), np.asarray(sphere.faces), 40)
    for faces in meshes.values():
        model = trimesh.Trimesh(sphere.vertices, faces, process=False)
        assert model.is_watertight
        assert model.is_winding_consistent


def test_a_hole_is_kept():
    ring = cloth(7)
    keep = ~np.isin(ring.faces, [24]).any(axis=1)
    for faces in collapse_sequence(goals.flat(ring), ring.faces[keep], 20).values():
        used, compact = np.unique(faces, return_inverse=True)
        mesh = trimesh.Trimesh(ring.rest[used], compact.reshape(-1, 3), process=False)
        assert mesh.euler_number == 0


def test_triangles_follow_the_crease_they_would_cross():
    count = 9
    crossing = follow_creases(cloth(count), folded(count, (1, 1)))
    edges = np.sort(crossing[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    crease = np.arange(count) * (count + 1)
    along = np.stack([crease[:-1], crease[1:]], axis=1)
    assert {tuple(e) for e in along.tolist()} <= {tuple(e) for e in edges.tolist()}
    changed = (crossing != cloth(count).faces).any(axis=1)
    assert changed.sum() == 2 * (count - 1)
    # The sheet is covered as before, every triangle seen from the same side.
    x, y = (
        cloth(count).rest[crossing[:, k], :2] - cloth(count).rest[crossing[:, 0], :2]
        for k in (1, 2)
    )
    areas = (x[:, 0] * y[:, 1] - x[:, 1] * y[:, 0]) / 2
    assert (areas > 0).all()
    assert areas.sum() == pytest.approx(0.09)


@pytest.mark.parametrize("direction", [(1, -1), (0, 1)])
def test_triangles_that_follow_the_crease_are_left_alone(direction):
    assert np.array_equal(follow_creases(cloth(9), folded(9, direction)), cloth(9).faces)


@pytest.mark.parametrize("axes", [[1, 0, 0], [0, 1, 0]])
def test_a_goal_in_one_line_has_no_model(axes):
    points = quadric(cloth(5), goals.flat(cloth(5)) * axes)  # every triangle is degenerate
    assert points.status == FitStatus.NO_FIT
    assert len(points) == 0
    assert points.error == np.inf


def test_no_fit_is_the_best_mesh_tried():
    goal = crumpled(np.random.default_rng(2))
    points = quadric(cloth(7), goal, tolerance=1e-5, max_size=6)
    assert points.status == FitStatus.NO_FIT
    assert max(points.sizes) == 6
    assert len(points) == points.sizes[int(np.argmin(points.errors))]


def test_goals_of_a_batch_are_independent():
    batch = np.stack([folded(9, (0, 1)), crumpled(np.random.default_rng(0), 9), folded(9, (1, 1))])
    together = simplify_quadric(cloth(9), batch)
    for goal, points in zip(batch, together, strict=True):
        assert np.array_equal(points.particles, quadric(cloth(9), goal).particles)


def test_the_entry_takes_a_cloth():
    points = simplify(cloth(13), folded(13, (0, 1)), method="paper", max_size=8)
    assert_paper(points, 13, (0, 1))
    assert points.method == "quadric collapse"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tolerance": -1.0}, r"tolerance is -1.0; give a number from 1e-09 to 5 m"),
        ({"max_size": 3}, "max_size is 3; give a whole number of at least 4"),
    ],
)
def test_bad_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        quadric(cloth(5), goals.flat(cloth(5)), **options)


def test_bad_arguments_are_refused():
    rope = bodies.rope()
    with pytest.raises(ValueError, match="the rope has 0 triangles; give a body with triangles"):
        quadric(rope, goals.straight(rope))
