"""Meshes: files from anywhere end in the mesh that they hold or in a clear refusal."""

import re

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial import cKDTree

from jaxsimp.bodies import cloth
from jaxsimp.bodies.mesh_files import load_mesh, read_mesh
from jaxsimp.bodies.meshes import clean_mesh, face_areas, spring_weights

FORMATS = ["obj", "ply", "stl", "off", "glb"]
FLOAT32 = 1e-6  # coordinates of up to 1 m, written as float32 or with 8 digits

seeds = st.integers(0, 10**6)


def grid_mesh(rows: int = 4, columns: int = 5, step: float = 0.1):
    body = cloth((rows, columns), ((rows - 1) * step, (columns - 1) * step))
    return body.rest.copy(), body.faces.copy()


def open_mesh(seed: int):
    """A bumpy sheet, somewhere, turned somehow, its points in random order."""
    rng = np.random.default_rng(seed)
    points, faces = grid_mesh(*rng.integers(2, 6, 2).tolist())
    return shuffled(points + 0.02 * rng.standard_normal(points.shape), faces, rng)


def closed_mesh(seed: int):
    rng = np.random.default_rng(seed)
    solid = trimesh.creation.icosphere(subdivisions=1, radius=0.2)
    bumps = 1 + 0.1 * rng.standard_normal((len(solid.vertices), 1))
    return shuffled(np.asarray(solid.vertices) * bumps, np.asarray(solid.faces), rng)


def shuffled(points, faces, rng):
    order = rng.permutation(len(points))
    turn, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    points = points @ turn + rng.uniform(-0.5, 0.5, 3)
    return points[order], np.argsort(order)[faces][rng.permutation(len(faces))]


meshes = st.tuples(st.sampled_from([open_mesh, closed_mesh]), seeds)


def triangles(points, faces) -> set:
    """Triangles as their corners' places, whatever the order of points and triangles."""
    places = points.round(4).tolist()
    corners = [[tuple(places[i]) for i in face] for face in faces.tolist()]
    first = [min(range(3), key=face.__getitem__) for face in corners]
    return {tuple(face[i:] + face[:i]) for face, i in zip(corners, first, strict=True)}


# --- files ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", FORMATS)
@given(mesh=meshes)
def test_a_mesh_comes_back_from_its_file(suffix, mesh, tmp_path):
    make, seed_of_mesh = mesh
    points, faces = make(seed_of_mesh)
    path = tmp_path / f"mesh.{suffix}"
    trimesh.Trimesh(points, faces, process=False).export(path)
    found_points, found_faces = load_mesh(path)
    assert found_points.shape == points.shape
    assert found_faces.shape == faces.shape
    if suffix == "stl":  # which has corners of triangles only: they are welded, in another order
        away, order = cKDTree(points).query(found_points)
        assert away.max() < FLOAT32
        assert sorted(order.tolist()) == list(range(len(points)))
        found_faces = order[found_faces]
    else:
        np.testing.assert_allclose(found_points, points, atol=FLOAT32)
    np.testing.assert_array_equal(found_faces, faces)


def test_scale_takes_a_file_in_millimetres(tmp_path):
    points, faces = grid_mesh()
    path = tmp_path / "mesh.ply"
    trimesh.Trimesh(1000 * points, faces, process=False).export(path)
    with pytest.raises(ValueError, match=r"mesh\.ply: .* is 400 m; .*millimetres\? scale=0\.001"):
        load_mesh(path)
    np.testing.assert_allclose(load_mesh(path, scale=1e-3)[0], points, atol=FLOAT32)


def test_polygons_are_cut_and_parts_are_put_together(tmp_path):
    quads = tmp_path / "quads.obj"
    quads.write_text(
        "o one\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\no two\nv 2 0 0\nv 2 1 0\nf 2 5 6 3\n"
    )
    points, faces = load_mesh(quads)
    assert len(points) == 6
    np.testing.assert_allclose(face_areas(points, faces).sum(), 2.0, rtol=1e-12)
    scene = trimesh.Scene()
    for x in (0.0, 0.3):
        part, part_faces = grid_mesh(4, 4)
        scene.add_geometry(trimesh.Trimesh(part + np.array([x, 0, 0]), part_faces, process=False))
    scene.export(tmp_path / "parts.glb")
    points, faces = load_mesh(tmp_path / "parts.glb")  # welded along the side that they share
    assert len(points) == 2 * 16 - 4
    assert len(faces) == 2 * 18


@pytest.mark.parametrize("suffix", [*FORMATS, "gltf", "dae", "3mf", "zip", "xyz", "txt", ""])
@given(content=st.binary(max_size=300))
def test_random_bytes_are_refused_by_name(suffix, content, tmp_path, capfd):
    path = tmp_path / f"some.{suffix}"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=re.escape(str(path)) + ".*(give a|save it)"):
        load_mesh(path)
    assert capfd.readouterr() == ("", "")


TOKENS = {
    "obj": ["v 0 0 0\n", "v 1 0 0\n", "v 0 1 0\n", "v nan 0 1\n", "v 1e39 0\n", "f 1 2 3\n",
            "f 3 2 9\n", "f -1 -2 -3\n", "f 1/2/3 4 5\n", "usemtl a\n", "g b\n", "vt 0 0\n"],
    "off": ["OFF\n", "3 1 0\n", "0 0 0\n", "1 0 0\n", "0 1 0\n", "3 0 1 2\n", "3 0 1 7\n", "#\n"],
    "ply": ["ply\n", "format ascii 1.0\n", "element vertex 3\n", "property float x\n",
            "property float y\n", "property float z\n", "element face 1\n",
            "property list uchar int vertex_indices\n", "end_header\n", "0 0 0\n", "1 0 0\n",
            "0 1 0\n", "3 0 1 2\n", "3 0 1 9\n"],
    "stl": ["solid a\n", "facet normal 0 0 1\n", "outer loop\n", "vertex 0 0 0\n",
            "vertex 1 0 0\n", "vertex 0 1 0\n", "vertex inf 0 0\n", "endloop\n", "endfacet\n",
            "endsolid\n"],
}  # fmt: skip


@pytest.mark.parametrize("suffix", list(TOKENS))
@given(data=st.data())
def test_half_right_text_ends_in_a_mesh_or_a_refusal(suffix, data, tmp_path, capfd):
    tokens = TOKENS[suffix]
    lines = data.draw(st.lists(st.sampled_from(tokens), max_size=20))
    if data.draw(st.booleans()):  # near the right order
        lines = [line for line in tokens if data.draw(st.integers(0, 4))]
    path = tmp_path / f"some.{suffix}"
    path.write_text("".join(lines))
    try:
        points, faces = load_mesh(path)
    except ValueError:
        with pytest.raises(ValueError, match=re.escape(str(path))):
            load_mesh(path)
    else:
        assert np.isfinite(points).all()
        assert (face_areas(points, faces) > 0).all()
        assert set(faces.ravel().tolist()) == set(range(len(points)))
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("name", "fault"),
    [
        ("missing.obj", "there is no such file"),
        ("missing", "there is no such file"),
        ("folder.obj", "it is a folder"),
        ("empty.ply", "it is empty"),
    ],
)
def test_what_is_no_file_is_refused(name, fault, tmp_path):
    (tmp_path / "folder.obj").mkdir()
    (tmp_path / "empty.ply").touch()
    with pytest.raises(ValueError, match=f"{name} cannot be read as a mesh: {fault}; give an OBJ"):
        read_mesh(tmp_path / name)


def test_points_without_triangles_are_refused(tmp_path):
    trimesh.PointCloud(np.eye(3)).export(tmp_path / "cloud.ply")
    with pytest.raises(ValueError, match=r"cloud\.ply .* it has no triangles; give a file with"):
        load_mesh(tmp_path / "cloud.ply")


# --- cleaning ------------------------------------------------------------------------------------


@given(mesh=meshes)
def test_a_clean_mesh_comes_back_as_it_was(mesh):
    make, seed_of_mesh = mesh
    points, faces = make(seed_of_mesh)
    found_points, found_faces = clean_mesh(points, faces)
    np.testing.assert_array_equal(found_points, points)
    np.testing.assert_array_equal(found_faces, faces)


@given(mesh=meshes, seed=seeds)
def test_dirt_changes_nothing(mesh, seed):
    make, seed_of_mesh = mesh
    points, faces = make(seed_of_mesh)
    rng = np.random.default_rng(seed)
    count = len(points)
    # Triangles again, turned and turned over; triangles of two points, and of two and a copy.
    again = faces[rng.integers(0, len(faces), 4)][:, rng.permutation(3)]
    a, b = faces[rng.integers(0, len(faces))][:2]
    middle = (points[a] + points[b]) / 2
    size = np.ptp(points, axis=0).max()
    copies = points[[a, b]] + 1e-6 * size * rng.uniform(-1, 1, (2, 3))
    lost = np.array([[np.nan, 0.0, 0.0], [1e9, 0.0, 0.0]])
    more = [[a, a, b], [a, b, count], [a, count + 2, b], [b, count, count + 2]]
    dirty = np.concatenate([points, copies, middle[None], lost])
    # One triangle through a copy of its corner.
    moved = faces.copy()
    moved[0][moved[0] == a] = count
    found_points, found_faces = clean_mesh(dirty, np.concatenate([moved, again, more]))
    np.testing.assert_array_equal(found_points, points)
    np.testing.assert_array_equal(found_faces, faces)


@given(mesh=meshes, seed=seeds)
def test_triangles_are_turned_to_face_as_the_first(mesh, seed):
    make, seed_of_mesh = mesh
    points, faces = make(seed_of_mesh)
    turned = np.random.default_rng(seed).random(len(faces)) < 0.5
    _, found = clean_mesh(points, np.where(turned[:, None], faces[:, ::-1], faces))
    wanted = faces[:, ::-1] if turned[0] else faces
    assert triangles(points, found) == triangles(points, wanted)


def test_an_empty_triangle_that_fills_a_gap_stays():
    # The square's side from 1 to 3 has a point (4) in its middle for one of its neighbours.
    points = np.array([[0, 0, 0], [1, 0, 0], [2, 1, 0], [0, 1, 0], [0.5, 0.5, 0]], dtype=float)
    sheet = np.array([[0, 1, 3], [1, 2, 4], [4, 2, 3]])
    with pytest.raises(ValueError, match="2 pieces"):
        clean_mesh(points, sheet)
    dirt = [[0, 1, 0], [0, 3, 1]]
    _, found = clean_mesh(points, np.concatenate([sheet, [[1, 4, 3]], dirt]))
    assert len(found) == 4
    # So it does beside an empty triangle that fills nothing.
    middle = np.concatenate([points, [[0.5, 0.0, 0.0]]])
    _, found = clean_mesh(middle, np.concatenate([sheet, [[1, 4, 3], [0, 5, 1]]]))
    assert len(found) == 4
    # On the boundary the same triangle is dirt.
    _, found = clean_mesh(points, np.array([[1, 2, 4], [4, 2, 3], [1, 4, 3]]))
    assert len(found) == 2


NAN = float("nan")
SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=float)
TWO = np.array([[0, 1, 2], [0, 2, 3]])


def strip(turns: int):
    """A closed strip of 12 pieces with half turns: one-sided if their number is odd."""
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    half = turns * angle / 2
    out = np.stack([np.cos(half) * np.cos(angle), np.cos(half) * np.sin(angle), np.sin(half)], 1)
    middle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    lower, upper = np.arange(12), np.arange(12, 24)
    after_lower, after_upper = np.roll(lower, -1), np.roll(upper, -1)
    if turns % 2:
        after_lower[-1], after_upper[-1] = 12, 0
    faces = [
        np.stack([lower, after_lower, upper], 1),
        np.stack([after_lower, after_upper, upper], 1),
    ]
    return np.concatenate([middle - 0.3 * out, middle + 0.3 * out]), np.concatenate(faces)


def test_a_strip_with_a_half_turn_is_refused_and_with_two_is_not():
    assert len(clean_mesh(*strip(2))[1]) == 24
    with pytest.raises(ValueError, match="one side only, like a Möbius strip; cut it open"):
        clean_mesh(*strip(1))


@pytest.mark.parametrize(
    ("points", "faces", "message"),
    [
        (SQUARE, np.zeros((0, 3), dtype=int), "the mesh has no triangles; give a surface"),
        (SQUARE, TWO + 2, "a triangle names 4; the ids of 4 points are 0 to 3"),
        (SQUARE, TWO - 1, "a triangle names -1; the ids of 4 points"),
        (SQUARE, np.array([[0, 1, 1], [2, 2, 2]]), "each of 2 triangles names a point twice; give"),
        (SQUARE * [1, 0, 0], TWO, "every triangle is empty"),
        (SQUARE * 0, TWO, "every triangle is empty"),
        (np.where(SQUARE == 1, NAN, SQUARE), TWO, r"3 points .* not finite, the first is \[nan"),
        (SQUARE - np.inf, TWO, "points of triangles are not finite"),
        (SQUARE * 300, TWO, r"is 300 m; a body is 0\.01 to 5 m.*millimetres\? scale=0\.001, or"),
        (SQUARE * 60, TWO, r"centimetres\? scale=0\.01,"),
        (SQUARE * 7, TWO, r"inches\? scale=0\.0254"),
        (SQUARE * 1e6, TWO, "scale is the metres in one unit"),
        (SQUARE * 4e-4, TWO, r"converted from millimetres twice\? scale=1000"),
        (SQUARE * 0.0099, TWO, r"is 0\.0099 m; a body is 0\.01 to 5 m"),
        (SQUARE * 1e300, TWO, r"is 1e\+300 m; a body is"),
        (
            np.concatenate([SQUARE, [[0.5, 0.5, 1]]]),
            np.concatenate([TWO, [[0, 2, 4]]]),
            r"3 triangles meet at the edge from \[0.0, 0.0, 0.0\] to \[1.0, 1.0, 0.0\] \(1 such",
        ),
        (
            np.concatenate([SQUARE, SQUARE[:3] + np.array([2, 0, 0])]),
            np.concatenate([TWO, [[4, 5, 6]]]),
            "in 2 pieces that share no edge, of 2, 1 triangles; join them",
        ),
        (  # two squares that touch at a corner
            np.concatenate([SQUARE, SQUARE[:3] + np.array([1, 1, 0])]),
            np.concatenate([TWO, [[4, 5, 6]]]),
            "in 2 pieces",
        ),
    ],
)  # fmt: skip
def test_a_mesh_of_another_meaning_is_refused(points, faces, message):
    with pytest.raises(ValueError, match=message):
        clean_mesh(points, faces)


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize(
    ("points", "faces", "message"),
    [
        (SQUARE[:, :2], TWO, r"points has shape \(4, 2\)"),
        (SQUARE, TWO[:, :2], r"faces has shape \(2, 2\)"),
        (SQUARE, TWO[0], r"faces has shape \(3,\)"),
    ],
)
def test_arrays_of_another_shape_are_refused(points, faces, message):
    with pytest.raises(ValueError, match=message):
        clean_mesh(points, faces)


@pytest.mark.parametrize("scale", [0.0, -1.0, NAN, np.inf])
def test_a_scale_that_is_none_is_refused(scale):
    with pytest.raises(ValueError, match=r"scale is .*; give a number .*, the metres in one unit"):
        clean_mesh(SQUARE, TWO, scale=scale)


# --- measures ------------------------------------------------------------------------------------


@given(rows=st.integers(2, 6), columns=st.integers(2, 6))
def test_the_triangles_of_a_grid_have_half_a_cell_each(rows, columns):
    points, faces = grid_mesh(rows, columns)
    np.testing.assert_allclose(face_areas(points, faces), 0.005, rtol=1e-12)


def energy(points, springs, weights, strain) -> float:
    """Energy of springs of weight 1 N/m in a homogeneous small strain, joules."""
    ends = (points[springs[:, 1]] - points[springs[:, 0]])[:, :2]
    length = np.linalg.norm(ends, axis=1)
    elongation = np.einsum("si,ij,sj->s", ends, strain, ends) / length
    return float(np.sum(weights * elongation**2) / 2)


def equilateral(rows: int, columns: int, side: float):
    points, faces = grid_mesh(rows, columns, side)
    # Shear of the grid takes its diagonals to the length of its sides.
    return points @ np.array([[1, 0, 0], [0.5, np.sqrt(3) / 2, 0], [0, 0, 1.0]]), faces


strains = hnp.arrays(float, 3, elements=st.floats(-1, 1)).map(
    lambda e: np.array([[e[0], e[2]], [e[2], e[1]]])
)


@given(strain=strains, rows=st.integers(2, 5), columns=st.integers(2, 5))
def test_equilateral_triangles_have_the_energy_of_an_elastic_sheet(strain, rows, columns):
    points, faces = equilateral(rows, columns, 0.05)
    (edges, weights), _ = spring_weights(points, faces)
    area = 2 * (rows - 1) * (columns - 1) * np.sqrt(3) / 4 * 0.05**2
    # Plane stress with E h = 1 N/m and nu = 1/3.
    nu, trace, square = 1 / 3, np.trace(strain), np.sum(strain**2)
    density = (nu * trace**2 + (1 - nu) * square) / (2 * (1 - nu**2))
    np.testing.assert_allclose(
        energy(points, edges, weights, strain), area * density, rtol=1e-9, atol=1e-15
    )


@given(seed=seeds)
def test_equal_stretch_has_the_energy_of_an_elastic_sheet_on_any_triangles(seed):
    points, faces = grid_mesh(4, 5)
    points[:, :2] += np.random.default_rng(seed).uniform(-0.03, 0.03, (len(points), 2))
    (edges, weights), _ = spring_weights(points, faces)
    found = energy(points, edges, weights, np.eye(2))
    # E h / (1 - nu) times the area: 3/2 N/m with nu = 1/3.
    np.testing.assert_allclose(found, 1.5 * face_areas(points, faces).sum(), rtol=1e-9)


def test_springs_across_edges_join_the_opposite_corners():
    points, faces = equilateral(2, 2, 0.1)
    (edges, along), (pairs, across) = spring_weights(points, faces)
    assert len(edges) == 5
    assert pairs.tolist() == [[0, 3]]
    # Area of the rhombus over the square of its long diagonal: (sqrt(3)/2 a^2) / (3 a^2).
    np.testing.assert_allclose(across, np.sqrt(3) / 6, rtol=1e-12)
    # One triangle at the sides, two in the middle, over a^2.
    np.testing.assert_allclose(
        sorted(along), np.sqrt(3) / 4 * np.array([1, 1, 1, 1, 2]), rtol=1e-12
    )


def test_pairs_that_are_edges_are_left_out_and_pairs_met_twice_are_joined_once():
    solid = trimesh.creation.icosphere(subdivisions=0)
    tetrahedron = np.array([[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]])
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    assert len(spring_weights(corners, tetrahedron)[1][0]) == 0
    # An octahedron has 12 edges but only 3 diagonals, each across 4 edges.
    octahedron = np.concatenate([np.eye(3), -np.eye(3)])
    faces = np.array(
        [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]]
    )
    _, (pairs, weights) = spring_weights(octahedron, faces)
    assert pairs.tolist() == [[0, 3], [1, 4], [2, 5]]
    # Each across an edge of length sqrt(2): area sqrt(3), heights sqrt(6) in all, more than 2.
    np.testing.assert_allclose(weights, 4 * np.sqrt(3) / 6, rtol=1e-12)
    _, (pairs, _) = spring_weights(np.asarray(solid.vertices), np.asarray(solid.faces))
    assert len(pairs) == len(np.unique(pairs, axis=0)) == 30


def test_triangles_folded_on_each_other_do_not_make_a_stiff_spring():
    points = np.array([[0, 0, 0], [1, 0, 0], [0.5, 0.8, 1e-3], [0.5, 0.8, -1e-3]])
    _, (pairs, weights) = spring_weights(points, np.array([[0, 1, 2], [1, 0, 3]]))
    assert pairs.tolist() == [[2, 3]]
    # As laid flat: area 0.8, distance of the corners 1.6.
    np.testing.assert_allclose(weights, 0.8 / 1.6**2, rtol=1e-5)


def test_loading_a_mesh_leaves_the_caller_s_arrays_alone():
    points, faces = grid_mesh()
    before = points.copy(), faces.copy()
    clean_mesh(points, faces[:, ::-1], scale=0.5)
    np.testing.assert_array_equal(points, before[0])
    np.testing.assert_array_equal(faces, before[1])
