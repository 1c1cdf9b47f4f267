"""Triangle meshes in files: the points of a file in its order, each once, or what is wrong with it.

OBJ files are read here, since a reader for pictures splits points where materials or textures meet.
trimesh reads the other formats.
"""

import re
import warnings
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from jaxsimp.bodies.meshes import FLAT, NARROW, Mesh, as_mesh, clean_mesh, relative_stiffness, z_up
from jaxsimp.bodies.size import MOST_PARTICLES

MOST_BYTES = 256 * 2**20
"""Largest file that is read: four times an OBJ file of `MOST_PARTICLES` with textures."""
FORMATS = "an OBJ, PLY, STL, OFF or GLB file"
CONVERT = {
    **dict.fromkeys((".usd", ".usda", ".usdc", ".usdz"), "USD"),
    **dict.fromkeys((".fbx", ".blend", ".dae", ".abc", ".3ds"), "a format of scenes"),
}
ARCHIVES = (".zip", ".gz", ".bz2", ".xz", ".tar", ".7z", ".tgz", ".3mf")


class _UnreadableError(ValueError):
    """What is wrong with a file, without its path."""


def load_mesh(path: str | Path, *, scale: float = 1.0, up: str | None = None) -> Mesh:
    """A clean mesh from a file: `read_mesh`, then `clean_mesh`.

    Args:
        path: an OBJ, PLY, STL, OFF or GLB file, or another format that trimesh reads.
        scale: metres in one unit of the file: 0.001 for millimetres.
        up: axis of the file that points up: "z", "y", as in GLB and most OBJ files, or "x"; None
            for "z", with a warning if the mesh is flat and stands on edge.

    Warns of triangles so narrow that they shorten the time step many times.

    Raises:
        ValueError: if the file holds no mesh, or one that `clean_mesh` refuses.
    """
    points, faces = read_mesh(path)
    try:
        points, faces = clean_mesh(z_up(points, up or "z"), faces, scale=scale)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    extents = np.ptp(points, axis=0)
    if up is None and extents[:2].min() <= FLAT * extents[2]:
        warnings.warn(
            f"{path} is flat and stands on edge, {extents[2]:.3g} m high: if y points up in it, "
            f"give up='y' (--up y), otherwise up='z'",
            stacklevel=2,
        )
    if (stiffer := relative_stiffness(points, faces)) > NARROW:
        warnings.warn(
            f"{path} has narrow triangles, which make the longest stable time step "
            f"{stiffer**0.5:.0f} to {stiffer:.0f} times shorter: replace them by "
            f"jaxsimp.bodies.remesh(points, faces, num_points) (--particles)",
            stacklevel=2,
        )
    return points, faces


def read_mesh(path: str | Path) -> Mesh:
    """Points and triangles of a file: each point once, in its order and unit, unwelded, unchecked.

    Splits polygons into triangles, and joins the parts of a scene. Axes stay unchanged, z up.

    Args:
        path: an OBJ, PLY, STL, OFF or GLB file, or another format that trimesh reads.

    Raises:
        ValueError: if the file cannot be read, is too large, or has no triangles.
    """
    try:
        data, suffix = read_file(path, FORMATS), Path(path).suffix.lower()
        if suffix == ".obj":
            points, faces = _read_obj(data)
        else:
            points, faces = _read_with_trimesh(data, Path(path))
        if not faces.size:
            raise _UnreadableError(
                "it has no triangles; give a file with the triangles of a surface"
            )
        return as_mesh(points, faces)
    except ValueError as error:
        raise ValueError(f"{path} cannot be read as a mesh: {error}") from error


def read_file(path: str | Path, wanted: str) -> bytes:
    """The bytes of a file.

    Args:
        path: path of the file.
        wanted: what should be given instead, for the message.

    Raises:
        ValueError: if there is no such file, or it is a folder, empty, too large, or not readable.
    """
    path = Path(path)
    try:
        if path.is_dir():
            raise ValueError(f"it is a folder; give {wanted}")
        size = path.stat().st_size
        if size > MOST_BYTES:
            raise ValueError(
                f"it has {size / 2**20:.0f} MiB; {MOST_BYTES // 2**20} MiB is the limit, and "
                f"{MOST_PARTICLES} points: decimate it"
            )
        data = path.read_bytes()
    except FileNotFoundError:
        raise ValueError(f"there is no such file; give {wanted}") from None
    except OSError as error:
        raise ValueError(f"{error.strerror or error}; give {wanted}") from error
    if not data:
        raise ValueError(f"it is empty; give {wanted}")
    return data


def _read_obj(data: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Points and triangles of an OBJ file, whatever materials, groups and textures it has."""
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise _UnreadableError("it is in UTF-16; save it as UTF-8")
    points: list[list[float]] = []
    polygons: list[list[int]] = []
    text = re.sub(rb"\\\r?\n", b" ", data.removeprefix(b"\xef\xbb\xbf"))
    for number, line in enumerate(text.splitlines(), start=1):
        word, *rest = line.partition(b"#")[0].split() or [b""]
        try:
            if word == b"v":
                x, y, z = map(float, rest[:3])
                points.append([x, y, z])
            elif word == b"f":
                polygons.append(_corners(rest, len(points)))
        except ValueError as error:
            told = line.decode("latin-1").strip()[:60]
            raise _UnreadableError(
                f"line {number} is {told!r}; give a point as 'v x y z', a triangle as 'f 1 2 3'"
            ) from error
        if len(points) > MOST_PARTICLES:
            raise _UnreadableError(
                f"it has more than {MOST_PARTICLES} points, the limit: decimate it"
            )
    if not points:
        raise _UnreadableError(f"it has no points ('v x y z'), or is no OBJ file; give {FORMATS}")
    return np.array(points), _triangles(polygons)


def _corners(words: list[bytes], count: int) -> list[int]:
    """Ids of a polygon's points: counted from 1, or backwards from the last point so far."""
    ids = [int(word.partition(b"/")[0]) for word in words]
    if len(ids) < 3 or 0 in ids:
        raise ValueError
    return [each - 1 if each > 0 else count + each for each in ids]


def _triangles(polygons: list[list[int]]) -> np.ndarray:
    """Polygons as fans of triangles, in their order; of quadrangles alone in that of trimesh."""
    from trimesh.geometry import triangulate_quads

    if {len(polygon) for polygon in polygons} == {4}:
        return np.asarray(triangulate_quads(polygons))
    fans: list[list[int]] = []
    for polygon in polygons:
        if len(polygon) == 4:
            a, b, c, d = polygon
            fans += [[a, b, c], [c, d, a]]  # as trimesh has them
        else:
            fans += [[polygon[0], *polygon[i : i + 2]] for i in range(1, len(polygon) - 1)]
    return np.array(fans, dtype=np.int64).reshape(-1, 3)


def _read_with_trimesh(data: bytes, path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Points and triangles of a file in another format, with the files beside it that it names."""
    import trimesh

    suffix = path.suffix.lower()
    if suffix in CONVERT:
        raise _UnreadableError(
            f"{CONVERT[suffix]} is not read; give an OBJ or PLY file, which Blender, for one, "
            f"exports"
        )
    if suffix in ARCHIVES:
        raise _UnreadableError(f"it is an archive; unpack it, and give {FORMATS}")
    kind = suffix[1:]
    if kind not in trimesh.available_formats():
        raise _UnreadableError(
            f"{suffix or 'a name without suffix'} is no mesh format; give {FORMATS}"
        )
    # Each option that would reorder, split or merge points is off.
    options: dict[str, Any] = {"process": False, "fix_texture": False, "skip_materials": True}
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            beside = trimesh.resolvers.FilePathResolver(str(path))
            file = BytesIO(_in_ascii(data, kind))
            scene = trimesh.load_scene(file, file_type=kind, resolver=beside, **options)
            parts = [part for part in scene.dump() if isinstance(part, trimesh.Trimesh)]
            return _joined([(np.array(part.vertices), np.array(part.faces)) for part in parts])
    except Exception as error:  # the readers raise many kinds of errors on a broken file
        raise _UnreadableError(
            f"it is damaged, or is no {kind.upper()} file; export it again, or give {FORMATS}"
        ) from error


def _in_ascii(data: bytes, kind: str) -> bytes:
    """A file whose text is ASCII: other letters, in comments and names, may be in any encoding."""
    end = len(data)
    if kind == "ply":
        end = data.find(b"end_header")
    elif kind == "stl":
        count = int.from_bytes(data[80:84], "little")
        end = 0 if len(data) == 84 + 50 * count else end
    elif kind != "off":
        end = 0
    head = data[: max(end, 0)].removeprefix(b"\xef\xbb\xbf")
    return head.decode("ascii", "replace").encode("ascii", "replace") + data[max(end, 0) :]


def _joined(parts: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """One mesh of all parts. Parts of the same points, as one a material in GLB, share them."""
    points: list[np.ndarray] = []
    faces: list[np.ndarray] = []
    first = count = 0
    for own, ids in parts:
        if not (points and np.array_equal(own, points[-1])):
            points.append(own)
            first, count = count, count + len(own)
        faces.append(ids + first)
    if not points:
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
    return np.concatenate(points), np.concatenate(faces)
