"""Mesh files from elsewhere: their points in order, each once, or what is wrong with the file."""

import json
import re
import struct
import warnings
import zipfile

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from jaxsimp.bodies import cloth, mesh_files
from jaxsimp.bodies.mesh_files import load_mesh, read_mesh
from jaxsimp.bodies.size import MOST_PARTICLES

CLOTH = cloth((9, 9))
LATIN = "größe 5 µm".encode("latin-1")


def obj(points, lines) -> bytes:
    """An OBJ file: all points first, then other lines."""
    coordinates = [f"v {x!r} {y!r} {z!r}" for x, y, z in points.tolist()]
    return "\n".join([*coordinates, *lines, ""]).encode()


def test_an_obj_file_of_two_materials_has_each_point_once_in_its_order(tmp_path):
    right = CLOTH.rest[CLOTH.faces].mean(axis=1)[:, 0] > 0
    first, second = CLOTH.faces[right], CLOTH.faces[~right]
    lines = ["usemtl a", *(f"f {a + 1} {b + 1} {c + 1}" for a, b, c in first)]
    lines += ["usemtl b", *(f"f {a + 1} {b + 1} {c + 1}" for a, b, c in second)]
    (tmp_path / "it.obj").write_bytes(obj(CLOTH.rest, lines))
    points, faces = read_mesh(tmp_path / "it.obj")
    np.testing.assert_array_equal(points, CLOTH.rest)
    np.testing.assert_array_equal(faces, np.concatenate([first, second]))
    np.testing.assert_array_equal(load_mesh(tmp_path / "it.obj")[0], CLOTH.rest)


@given(data=st.data(), rows=st.integers(2, 5), columns=st.integers(2, 5))
def test_materials_groups_textures_and_encodings_change_nothing_in_an_obj_file(
    data, rows, columns, tmp_path
):
    body = cloth((rows, columns))
    rng = np.random.default_rng(data.draw(st.integers(0, 10**6)))
    points = body.rest[rng.permutation(len(body.rest))] + 0.01 * rng.standard_normal((1, 3))
    faces = body.faces[rng.permutation(len(body.faces))]
    corner = data.draw(st.sampled_from(["{0}", "{0}/{1}", "{0}//{2}", "{0}/{1}/{2}"]))
    breaks = ["g left", "o one", "usemtl red", "s 1", "usemtl blue\ng right", "# note"]
    lines = ["mtllib it.mtl", *("vt 0.1 0.2" for _ in range(7)), "vn 0 0 1", "vn 0 1 0"]
    for face in faces.tolist():
        if data.draw(st.booleans()):
            lines.append(data.draw(st.sampled_from(breaks)))
        from_end = data.draw(st.booleans())  # counted backwards
        ids = [each - len(points) if from_end else each + 1 for each in face]
        words = [corner.format(i, rng.integers(1, 8), rng.integers(1, 3)) for i in ids]
        lines.append("f " + " ".join(words))
    content = obj(points, lines)
    if data.draw(st.booleans()):
        content = b"# " + LATIN + b"\n" + content
    if data.draw(st.booleans()):
        content = b"\xef\xbb\xbf" + content
    if data.draw(st.booleans()):
        content = content.replace(b"\n", b"\r\n")
    (tmp_path / "it.obj").write_bytes(content)
    found_points, found_faces = read_mesh(tmp_path / "it.obj")
    np.testing.assert_array_equal(found_points, points)
    np.testing.assert_array_equal(found_faces, faces)


def test_polygons_of_an_obj_file_are_fans_and_lines_may_go_on(tmp_path):
    points = np.array([[0, 0, 0], [1, 0, 0], [2, 1, 0], [1, 2, 0], [0, 1, 0.0]])
    (tmp_path / "it.obj").write_bytes(obj(points, ["f 1 2 3 \\", "4 5 # five", "f 1 2 3"]))
    found, faces = read_mesh(tmp_path / "it.obj")
    np.testing.assert_array_equal(found, points)
    assert faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 1, 2]]


@pytest.mark.parametrize("sides", ["3", "4", "34", "345"])
def test_polygons_of_an_obj_file_become_the_triangles_of_trimesh(sides, tmp_path):
    lines = [f"f {' '.join(str(1 + (k + i) % 6) for i in range(int(n)))}" for k, n in
             enumerate(sides * 2)]  # fmt: skip
    path = tmp_path / "it.obj"
    path.write_bytes(obj(np.random.default_rng(0).normal(size=(6, 3)), lines))
    whole = trimesh.load_mesh(path, process=False, maintain_order=True)
    wanted = {frozenset(face) for face in whole.faces.tolist()}
    _, faces = read_mesh(path)
    assert {frozenset(face) for face in faces.tolist()} == wanted
    assert len(faces) == len(whole.faces)


PLY = """ply
format ascii 1.0
comment {}
comment TextureFile it.png
element vertex 4
property float x
property float y
property float z
property float s
property float t
element face 2
property list uchar int vertex_indices
property list uchar float texcoord
end_header
0 0 0 0 0
1 0 0 1 0
1 1 0 .5 .5
0 1 0 .2 .1
3 0 1 2 6 0 0 1 0 1 1
3 0 2 3 6 .5 .5 1 .3 .2 .1
"""
OFF = "OFF\n# {}\n4 2 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 2\n3 0 2 3\n"
SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]])
TWO = [[0, 1, 2], [0, 2, 3]]


@pytest.mark.parametrize("before", [b"", b"\xef\xbb\xbf"], ids=["", "marked"])
@pytest.mark.parametrize("ends", [b"\n", b"\r\n"], ids=["lf", "crlf"])
@pytest.mark.parametrize(("suffix", "text"), [("ply", PLY), ("off", OFF)])
def test_textures_and_encodings_change_nothing_in_a_text_file(suffix, text, ends, before, tmp_path):
    path = tmp_path / f"it.{suffix}"
    path.write_bytes(before + text.encode().replace(b"{}", LATIN).replace(b"\n", ends))
    points, faces = read_mesh(path)
    np.testing.assert_array_equal(points, SQUARE)
    assert faces.tolist() == TWO


def test_a_name_in_latin_1_changes_nothing_in_an_stl_file(tmp_path):
    facet = "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\n"
    text = b"solid " + LATIN + b"\n" + f"{facet}endfacet\nendsolid\n".encode()
    (tmp_path / "it.stl").write_bytes(text)
    points, _ = read_mesh(tmp_path / "it.stl")
    np.testing.assert_array_equal(points, [[0, 0, 0], [1, 0, 0], [0, 1, 0]])


def test_the_materials_of_a_glb_file_share_its_points(tmp_path):
    blob = SQUARE.astype("<f4").tobytes() + np.array(TWO, "<u4").tobytes()
    accessor = {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"}
    ids = [
        {"bufferView": 1, "byteOffset": 12 * i, "componentType": 5125, "count": 3, "type": "SCALAR"}
        for i in range(2)
    ]
    primitives = [{"attributes": {"POSITION": 0}, "indices": i} for i in (1, 2)]
    views = [{"byteOffset": 0, "byteLength": 48}, {"byteOffset": 48, "byteLength": 24}]
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": primitives}],
        "accessors": [accessor | {"min": [0, 0, 0], "max": [1, 1, 0]}, *ids],
        "bufferViews": [{"buffer": 0} | view for view in views],
        "buffers": [{"byteLength": len(blob)}],
    }
    head = json.dumps(document).encode()
    head += b" " * (-len(head) % 4)
    parts = [(b"JSON", head), (b"BIN\0", blob)]
    chunks = b"".join(struct.pack("<I4s", len(body), kind) + body for kind, body in parts)
    header = struct.pack("<4sII", b"glTF", 2, 12 + len(chunks))
    (tmp_path / "it.glb").write_bytes(header + chunks)
    points, faces = read_mesh(tmp_path / "it.glb")
    np.testing.assert_array_equal(points, SQUARE)
    assert faces.tolist() == TWO


# --- units and axes ------------------------------------------------------------------------------


@pytest.mark.parametrize(("up", "axes"), [("y", [0, 2, 1]), ("x", [2, 0, 1])])
def test_another_axis_may_be_up(up, axes, tmp_path):
    flat = np.array([[0, 0, 0], [0.4, 0, 0], [0.4, 0.2, 0], [0, 0.2, 0.1]])
    # Positions in a file: its axis that is up has the height, and it is no mirror image.
    sign = np.array([1, 1, -1.0]) if up == "y" else np.ones(3)
    stored = flat[:, axes] * sign
    (tmp_path / "it.obj").write_bytes(obj(1000 * stored, ["f 1 2 3", "f 1 3 4"]))
    points, faces = load_mesh(tmp_path / "it.obj", up=up, scale=1e-3)
    np.testing.assert_allclose(points, flat, atol=1e-12)
    assert faces.tolist() == TWO


def test_a_flat_mesh_that_stands_on_edge_is_told(tmp_path):
    path = tmp_path / "it.obj"
    path.write_bytes(obj(0.3 * SQUARE[:, [0, 2, 1]], ["f 1 2 3", "f 1 3 4"]))
    with pytest.warns(UserWarning, match=r"stands on edge, 0\.3 m high: .* give up='y'"):
        points, _ = load_mesh(path)
    assert np.ptp(points[:, 2]) == 0.3
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        np.testing.assert_array_equal(load_mesh(path, up="z")[0], points)
        assert np.ptp(load_mesh(path, up="y")[0][:, 2]) == 0.0
    with pytest.raises(ValueError, match=r"it\.obj: up is 'w'; choose from x, y, z"):
        load_mesh(path, up="w")


# --- refusals ------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", ["obj", "ply", "stl", "off", "glb"])
@given(share=st.floats(0.0, 0.99), seed=st.integers(0, 10**6))
def test_a_damaged_file_is_told_by_the_file(suffix, share, seed, tmp_path):
    path = tmp_path / f"it.{suffix}"
    trimesh.Trimesh(CLOTH.rest, CLOTH.faces, process=False).export(path)
    content = bytearray(path.read_bytes())
    del content[int(share * len(content)) :]
    rng = np.random.default_rng(seed)
    for place in rng.integers(0, len(content) + 1, 4):
        content[place : place + 3] = rng.bytes(3)
    path.write_bytes(content)
    try:
        points, _ = load_mesh(path, up="z")
    except ValueError:
        told = f"^{re.escape(str(path))}((?!No module named).)*$"
        with pytest.raises(ValueError, match=told):
            load_mesh(path, up="z")
    else:
        assert np.isfinite(points).all()


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.usd", b"#usda", "USD is not read; give an OBJ or PLY file, which Blender"),
        ("a.fbx", b"Kaydara", "a format of scenes is not read; give an OBJ or PLY file"),
        ("a.zip", b"PK", "it is an archive; unpack it, and give an OBJ, PLY"),
        ("a.txt", b"v 0 0 0", r"\.txt is no mesh format; give an OBJ"),
        ("a", b"v 0 0 0", "a name without suffix is no mesh format; give an OBJ"),
        ("a.glb", b"ply\n", "it is damaged, or is no GLB file; export it again, or give an OBJ"),
        ("a.obj", b"solid a", r"it has no points \('v x y z'\), or is no OBJ file; give an OBJ"),
        ("a.obj", b"\xff\xfev\x00", "it is in UTF-16; save it as UTF-8"),
        ("a.obj", b"v 0 0 0\nv 1 x 0", "line 2 is 'v 1 x 0'; give a point as 'v x y z'"),
        ("a.obj", b"v 0 0 0\nf 1 2", "line 2 is 'f 1 2'; give a point .* triangle as 'f 1 2 3'"),
        ("a.obj", b"v 0 0 0\nf 0 1 1", "line 2 is 'f 0 1 1'"),
    ],
)
def test_what_is_no_mesh_is_told(name, content, message, tmp_path):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=re.escape(str(tmp_path / name)) + ".*" + message):
        read_mesh(tmp_path / name)


def test_a_mesh_of_too_many_points_is_refused_while_it_is_read(tmp_path, monkeypatch):
    path = tmp_path / "it.obj"
    path.write_bytes(b"v 0 0 0\n" * (MOST_PARTICLES + 1) + b"f 1 x 3\n")
    with pytest.raises(ValueError, match="more than 250000 points, the limit: decimate it"):
        read_mesh(path)
    monkeypatch.setattr(mesh_files, "MOST_BYTES", 2**20)
    with pytest.raises(ValueError, match=r"it has 2 MiB; 1 MiB is the limit, .*: decimate it"):
        read_mesh(path)


def test_an_archive_is_not_unpacked(tmp_path):
    with zipfile.ZipFile(tmp_path / "it.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("it.obj", b"v 0 0 0\n" * 10**5)
    with pytest.raises(ValueError, match="it is an archive; unpack it"):
        read_mesh(tmp_path / "it.zip")
