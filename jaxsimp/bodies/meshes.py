"""Triangle meshes: read from files, welded, cleaned and checked.

A mesh is two arrays, points of shape (V, 3) and triangles of shape (F, 3). Harmless faults are
repaired: coincident points, repeated or empty triangles, points of no triangle, triangles that
face the wrong way. A fault whose repair would change the surface raises an error.
"""

import warnings
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from jaxsimp.bodies.topology import (
    Faces,
    are_among,
    connected_pieces,
    distinct_edges,
    half_edges,
    inner_edges,
    shared_half_edges,
)

Points = Float[np.ndarray, "V 3"]
Mesh = tuple[Float[np.ndarray, "_ 3"], Int[np.ndarray, "_ 3"]]
"""Points and triangles of a mesh that a function returns."""

WELD = 1e-5
"""Distance, relative to the largest extent, below which points are one point, and height below
which a triangle is empty. Above the rounding of a float32 file, below any triangle of a cloth."""
SMALLEST, LARGEST = 0.02, 5.0
"""Limits of a body's largest extent, metres."""
UNITS = (("millimetres", 1e-3), ("centimetres", 1e-2), ("inches", 0.0254))


def load_mesh(path: str | Path, *, scale: float = 1.0) -> Mesh:
    """A clean mesh from a file: `read_mesh`, then `clean_mesh`.

    Args:
        path: an OBJ, PLY, STL, OFF or GLB file, or another format that trimesh reads.
        scale: metres in one unit of the file: 0.001 for millimetres.

    Raises:
        ValueError: if the file holds no mesh, or one that `clean_mesh` refuses.
    """
    points, faces = read_mesh(path)
    try:
        return clean_mesh(points, faces, scale=scale)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def read_mesh(path: str | Path) -> Mesh:
    """Points and triangles of a file: in its order and unit, unwelded, unchecked.

    Splits polygons into triangles, and joins the parts of a scene. Axes stay unchanged, z up.

    Args:
        path: an OBJ, PLY, STL, OFF or GLB file, or another format that trimesh reads.

    Raises:
        ValueError: if the file cannot be read, or has no triangles.
    """
    import trimesh

    # Each option that would reorder, split or merge points is off.
    options = {"maintain_order": True, "group_material": False, "skip_materials": True}
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            mesh = trimesh.load_mesh(Path(path), process=False, **options)
            points = np.array(mesh.vertices, dtype=float)
            faces = np.array(mesh.faces, dtype=np.int64)
        if faces.size:
            _check_shapes(points, faces)
    except Exception as error:  # the readers raise many kinds of errors on a broken file
        raise ValueError(
            f"{path} cannot be read as a mesh ({type(error).__name__}: {error}); "
            f"give an OBJ, PLY, STL, OFF or GLB file"
        ) from error
    if not faces.size:
        raise ValueError(f"{path} has no triangles; give a file with the triangles of a surface")
    return points, faces


def clean_mesh(points: Points, faces: Faces, *, scale: float = 1.0) -> Mesh:
    """One orientable surface in metres, from a mesh that may have faults.

    Repairs: points that coincide (see `WELD`) become the first of them; empty or repeated
    triangles, and points of no triangle, are removed; triangles are turned to face the same way
    as the first. An empty triangle that fills a gap between three others stays. The order of
    points and triangles does not change, and a clean mesh stays unchanged.

    Args:
        points: shape (V, 3).
        faces: point ids of the triangles, shape (F, 3).
        scale: metres in one unit of `points`.

    Raises:
        ValueError: if ids or coordinates are invalid, no triangle remains, the extent is outside
            `SMALLEST` to `LARGEST`, an edge has more than two triangles, the mesh is in several
            pieces, or it has one side only.
    """
    if not 0 < scale < np.inf:
        raise ValueError(f"scale is {scale}; give the metres in one unit of the mesh")
    _check_shapes(points, faces)
    points, faces = _referenced(points, _distinct_ids(points, faces))
    points = scale * points.astype(float)
    _check_coordinates(points)
    tolerance = WELD * float(np.ptp(points, axis=0).max())
    faces = _without_dirt(points, _weld(points, tolerance)[faces], tolerance)
    if not len(faces):
        raise ValueError("every triangle is empty (a line or a point); give a surface")
    points, faces = _referenced(points, faces)
    _check_edges(points, faces)
    return points, _oriented(points, faces)


def covering_radii(
    points: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> Float[np.ndarray, " F"]:
    """Least radius of discs about the corners of each triangle that cover it, shape (F,), metres.

    The radius of the circle through the corners, or half the longest side of an obtuse triangle.
    """
    corners = points[faces]
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    longest = sides.max(axis=1)
    obtuse = 2 * longest**2 > (sides**2).sum(axis=1) * (1 + 1e-9)
    area = np.where(obtuse, 1.0, face_areas(points, faces))  # which may be 0
    return np.where(obtuse, longest / 2, sides.prod(axis=1) / (4 * area))


def face_areas(points: Points, faces: Faces) -> Float[np.ndarray, " F"]:
    """Areas of the triangles, shape (F,), square metres."""
    a, b, c = points[faces].transpose(1, 0, 2)
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2


def spring_weights(
    points: Points, faces: Faces
) -> tuple[
    tuple[Int[np.ndarray, "E 2"], Float[np.ndarray, " E"]],
    tuple[Int[np.ndarray, "I 2"], Float[np.ndarray, " I"]],
]:
    """Springs of an elastic sheet: along the edges, and across the edges between two triangles.

    A spring's weight is the area of its triangles over its squared length, as in A. Van Gelder,
    "Approximate simulation of elastic membranes by triangulated spring meshes" (1998). A spring
    of stiffness `k weight` then has the energy of its strain times its area: the sheet's behaviour
    depends on `k`, and not on the resolution of the mesh. On equilateral triangles the sheet has
    Young's modulus times thickness `k`, in newtons per metre, and Poisson's ratio 1/3; equal
    stretch in all directions is exact on any triangles.

    Across an edge the length is that of the two triangles laid flat, so that the stiffness stays
    bounded where triangles are folded onto each other at rest. Pairs that an edge already joins
    are omitted; a pair across two edges has the sum of both weights.

    Args:
        points: rest coordinates, shape (V, 3), metres.
        faces: triangles of a clean mesh, shape (F, 3).

    Returns:
        Pairs of point ids, the lower first, and their weights: along edges, then across them.
    """
    pairs, where, count = distinct_edges(half_edges(faces)[0])
    total = np.bincount(where, weights=np.tile(face_areas(points, faces), 3))
    length = _lengths(points, pairs)
    ends = np.sort(inner_edges(faces)[1], axis=1)  # in the order of `pairs`, as all arrays here
    inner = count == 2
    heights = 2 * total[inner] / length[inner]
    weight = total[inner] / np.maximum(_lengths(points, ends), heights) ** 2
    across, group, _ = distinct_edges(ends)
    weight = np.bincount(group, weights=weight, minlength=len(across))
    free = ~are_among(across, pairs)
    return (pairs, total / length**2), (across[free], weight[free])


def _check_shapes(points: np.ndarray, faces: np.ndarray) -> None:
    for name, array in (("points", points), ("faces", faces)):
        if array.ndim != 2 or array.shape[1] != 3:
            raise ValueError(f"{name} has shape {array.shape}; a row of three is needed for each")


def _distinct_ids(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Triangles of three different points."""
    if not len(faces):
        raise ValueError("the mesh has no triangles; give a surface")
    wrong = faces[(faces < 0) | (faces >= len(points))]
    if wrong.size:
        raise ValueError(
            f"a triangle names point {wrong[0]}; a mesh of {len(points)} points has ids 0 to "
            f"{len(points) - 1}"
        )
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    if not len(faces):
        raise ValueError("every triangle names a point twice; give a surface")
    return faces


def _referenced(points: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The mesh without points of no triangle."""
    used, faces = np.unique(faces, return_inverse=True)
    return points[used], faces.reshape(-1, 3)


def _check_coordinates(points: np.ndarray) -> None:
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if bad.size:
        raise ValueError(
            f"{bad.size} points of triangles are not finite, the first is "
            f"{points[bad[0]].tolist()}; give finite coordinates"
        )
    extent = float(np.ptp(points, axis=0).max())
    if SMALLEST <= extent <= LARGEST:
        return
    if extent == 0:
        raise ValueError("every triangle is empty (all points coincide); give a surface")
    guesses = [f"{name}? scale={scale:g}" for name, scale in UNITS if 0.1 <= extent * scale <= 2]
    if 0.1 <= extent * 1e3 <= 2:
        guesses.append("converted from millimetres twice? scale=1000")
    hint = guesses[0] if guesses else "scale is the metres in one unit of the mesh"
    raise ValueError(
        f"the mesh is {extent:.4g} m large; a body is {SMALLEST:g} to {LARGEST:g} m. "
        f"Give its unit as a factor ({hint})"
    )


def _weld(points: np.ndarray, tolerance: float) -> np.ndarray:
    """Id of the first point that each point coincides with, shape (V,)."""
    from scipy.spatial import cKDTree

    # Exact copies first: the remaining points have few pairs even where many points coincide.
    distinct, where = np.unique(points, axis=0, return_inverse=True)
    near = cKDTree(distinct).query_pairs(tolerance, output_type="ndarray")
    group = connected_pieces(near, len(distinct))[1][where.ravel()]
    _, first, group = np.unique(group, return_index=True, return_inverse=True)
    return first[group]


def _without_dirt(points: np.ndarray, faces: np.ndarray, tolerance: float) -> np.ndarray:
    """Triangles of three different points, without repeated or empty ones."""
    faces = faces[(np.diff(np.sort(faces, axis=1), axis=1) > 0).all(axis=1)]
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    faces = faces[np.sort(first)]
    while len(faces):
        edges, _ = half_edges(faces)
        longest = _lengths(points, edges).reshape(3, -1).max(axis=0)
        empty = 2 * face_areas(points, faces) < tolerance * longest
        _, where, count = distinct_edges(edges)
        fills = (count[where].reshape(3, -1) == 2).all(axis=0)
        if not (empty & ~fills).any():
            break
        faces = faces[~empty | fills]  # this may leave another triangle without its neighbour
    return faces


def _check_edges(points: np.ndarray, faces: np.ndarray) -> None:
    """Refuse edges of more than two triangles, and a mesh of several pieces."""
    pairs, _, count = distinct_edges(half_edges(faces)[0])
    crowded = np.flatnonzero(count > 2)
    if crowded.size:
        start, end = points[pairs[crowded[0]]].round(4).tolist()
        raise ValueError(
            f"{count[crowded[0]]} triangles meet at the edge from {start} to {end} "
            f"({crowded.size} such edges); a sheet has two at most: cut it there"
        )
    number, piece = connected_pieces(inner_edges(faces)[2], len(faces))
    if number > 1:
        sizes = sorted(np.bincount(piece).tolist(), reverse=True)
        listed = ", ".join(map(str, sizes[:8])) + (", ..." if number > 8 else "")
        raise ValueError(
            f"the mesh is in {number} pieces that share no edge, of {listed} triangles; "
            f"join them, or give each as a body of its own"
        )


def _oriented(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The triangles, turned where needed to face the same way as the first.

    Each triangle is two nodes of a graph: unchanged, and turned. Neighbours that run along their
    edge in opposite directions agree unchanged, the others after one is turned.
    """
    count = len(faces)
    edges, rows = half_edges(faces)[0], shared_half_edges(faces)
    first, second = rows.T % count
    agree = edges[rows[:, 0], 0] == edges[rows[:, 1], 1]
    other = np.where(agree, second, second + count)
    as_they_are = np.stack([first, other], axis=1)
    turned = (as_they_are + count) % (2 * count)
    _, side = connected_pieces(np.concatenate([as_they_are, turned]), 2 * count)
    if side[0] == side[count]:
        raise ValueError(
            "the mesh has one side only, like a Möbius strip; cut it open across the strip"
        )
    return np.where((side[:count] == side[0])[:, None], faces, faces[:, ::-1])


def _lengths(points: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points[pairs[:, 1]] - points[pairs[:, 0]], axis=1)
