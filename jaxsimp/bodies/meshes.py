"""Triangle meshes: welded, cleaned and checked.

A mesh is two arrays, points of shape (V, 3) and triangles of shape (F, 3). Harmless faults are
repaired: coincident points, repeated or empty triangles, points of no triangle, triangles that
face the wrong way. A fault whose repair would change the surface raises an error.
"""

import numpy as np
from jaxtyping import Float, Int

from jaxsimp.bodies.size import (
    MOST_PARTICLES,
    MOST_TRIANGLES,
    require_scale,
    require_size,
)
from jaxsimp.bodies.topology import (
    Faces,
    are_among,
    connected_pieces,
    distinct_edges,
    half_edges,
    inner_edges,
    shared_half_edges,
)
from jaxsimp.checks import require_choice, require_ids, require_reals, require_shape, require_whole

Points = Float[np.ndarray, "V 3"]
Mesh = tuple[Float[np.ndarray, "_ 3"], Int[np.ndarray, "_ 3"]]
"""Points and triangles of a mesh that a function returns."""

WELD = 1e-5
"""Distance, relative to the largest extent, below which points are one point, and height below
which a triangle is empty. Above the rounding of a float32 file, below any triangle of a cloth."""
FLAT = 1e-3
"""Largest height of a flat mesh, relative to its extent."""
NARROW = 20.0
"""Largest relative stiffness of a mesh without a warning: meshes for rendering have 2 to 15."""


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
        ValueError: if ids or coordinates are invalid, no triangle remains, the extent is that
            of no body (see `jaxsimp.bodies.size`), an edge has more than two triangles, the mesh is
            in several pieces, or it has one side only.
    """
    scale = require_scale(scale)
    points, faces = as_mesh(points, faces)
    points, faces = _referenced(points, _distinct_ids(points, faces))
    points = scale * points
    _check_coordinates(points)
    tolerance = WELD * float(np.ptp(points, axis=0).max())
    faces = _without_dirt(points, _weld(points, tolerance)[faces], tolerance)
    if not len(faces):
        raise ValueError("every triangle is empty (a line or a point); give a surface")
    points, faces = _referenced(points, faces)
    _check_edges(points, faces)
    return points, _oriented(points, faces)


def as_mesh(points: object, faces: object) -> Mesh:
    """Points as floats, finite or not, and triangles as whole numbers, of any id.

    Raises:
        ValueError: if an array has another shape or type, or there are more than `MOST_PARTICLES`
            points or `MOST_TRIANGLES` triangles.
    """
    coordinates = require_reals("points", points, ("V", 3), "a row of x, y, z for each point")
    ids = require_whole("faces", faces)
    require_shape("faces", ids, ("F", 3), "a row of three points for each triangle")
    for name, count, most in (
        ("points", len(coordinates), MOST_PARTICLES),
        ("triangles", len(ids), MOST_TRIANGLES),
    ):
        if count > most:
            raise ValueError(f"the mesh has {count} {name}; {most} is the limit: decimate it")
    return coordinates, ids


def z_up(points: np.ndarray, up: str) -> np.ndarray:
    """Points turned so that z is up, shape (V, 3).

    Args:
        points: shape (V, 3).
        up: the axis that is up so far: "x", "y" or "z".

    Raises:
        ValueError: if `up` is another one.
    """
    require_choice("up", up, ("x", "y", "z"))
    if up == "y":
        return np.stack([points[:, 0], -points[:, 2], points[:, 1]], axis=1)
    return points[:, [1, 2, 0]] if up == "x" else points


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
    # Of no pairs NumPy makes whole numbers.
    weight = np.bincount(group, weights=weight, minlength=len(across)).astype(float)
    free = ~are_among(across, pairs)
    return (pairs, total / length**2), (across[free], weight[free])


def relative_stiffness(points: Points, faces: Faces) -> float:
    """Stiffness over mass of the stiffest point of a sheet, relative to that of the median point.

    The longest stable time step falls with it: with its root where stiffness sets the time step,
    and in proportion where damping does.

    Args:
        points: points of a clean mesh, shape (V, 3), metres.
        faces: point ids of the triangles, shape (F, 3).
    """
    (edges, along), (pairs, across) = spring_weights(points, faces)
    ends = np.concatenate([edges, pairs]).ravel()
    weight = np.repeat(np.concatenate([along, across]), 2)
    mass = np.bincount(faces.ravel(), np.repeat(face_areas(points, faces), 3), len(points))
    each = np.bincount(ends, weight, len(points)) / mass
    return float(each.max() / np.median(each))


def _distinct_ids(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Triangles of three different points."""
    if not len(faces):
        raise ValueError("the mesh has no triangles; give a surface")
    require_ids("a triangle", faces, len(points), "points")
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    if not len(faces):
        raise ValueError(f"each of {len(a)} triangles names a point twice; give a surface")
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
    if extent == 0:
        raise ValueError("every triangle is empty (all points coincide); give a surface")
    require_size("the largest extent of the mesh", extent)


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
