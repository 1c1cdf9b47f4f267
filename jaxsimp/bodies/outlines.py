"""Outlines filled with triangles: a polygon to an even mesh with a given number of points.

Points lie evenly on the sides and on a hexagonal lattice inside, joined by Delaunay's
triangulation. The result is deterministic. (Smoothing made no angle larger.)
"""

import numpy as np
from jaxtyping import Float, Int

from jaxsimp.bodies.meshes import FLAT, Mesh, Points, face_areas
from jaxsimp.bodies.size import MOST_PARTICLES, require_size
from jaxsimp.bodies.topology import Faces, boundary_edges, boundary_loops, distinct_edges
from jaxsimp.checks import require_count, require_rows

Corners = Float[np.ndarray, "C 2"]

COUNT_TOLERANCE = 0.1
"""Largest relative difference between the requested and the actual number of points."""
CLEARANCE = 0.6  # distance between lattice and outline, as a fraction of the spacing
TURN = np.deg2rad(20.0)  # turn of a boundary above which a point is a corner


def mesh_outline(corners: Corners, num_points: int) -> Mesh:
    """A polygon filled with nearly equilateral triangles, facing up, at z = 0.

    The corners are points of the mesh, and come first, in their order. Each side is divided
    evenly.

    Args:
        corners: corners of the outline in order, in either direction, shape (C, 2), C at least 3,
            metres.
        num_points: number of points, met within `COUNT_TOLERANCE`.

    Raises:
        ValueError: if the outline crosses or touches itself or encloses nothing, or has parts
            too narrow, or too many corners, for the number of points.
    """
    corners = check_outline(corners)
    return _triangulate(corners, *_fill(corners, num_points, mirrored=False))


def mesh_symmetric_outline(
    half: Corners, num_points: int
) -> tuple[Points, Faces, Int[np.ndarray, " V"]]:
    """A mesh that is its own mirror image in x, from one half of its outline.

    The half with x >= 0 is meshed as by `mesh_outline`, its corners first, and mirrored: each
    point has bitwise the same coordinates as its mirror image, except for the sign of x.

    Args:
        half: corners of the half, from one end of its middle line, where x = 0, to the other,
            with x > 0 between, shape (C, 2), C at least 3, metres.
        num_points: number of points of the whole mesh, met within `COUNT_TOLERANCE`.

    Returns:
        Points, triangles, and the id of each point's mirror image; on the line its own id.

    Raises:
        ValueError: as `mesh_outline`, or if the x of a corner is not as stated for `half`.
    """
    half = require_rows("half", half, 2)
    if len(half) < 3:
        raise ValueError(f"half has {len(half)} corners; give at least 3, two of them at x = 0")
    on_line = half[:, 0] == 0
    if not (on_line[0] and on_line[-1]) or on_line[1:-1].any() or (half[:, 0] < 0).any():
        raise ValueError(
            f"the half outline has x from {half[:, 0].min():g} m; let it begin and end at "
            f"x = 0, with x above zero between"
        )
    half = check_outline(half)
    points, faces = _triangulate(half, *_fill(half, num_points, mirrored=True))
    off_line = np.flatnonzero(points[:, 0] != 0)
    image = np.arange(len(points))
    image[off_line] = len(points) + np.arange(len(off_line))
    mirrored = points[off_line] * np.array([-1.0, 1.0, 1.0])
    mirror = np.concatenate([image, off_line])
    return (
        np.concatenate([points, mirrored]),
        np.concatenate([faces, image[faces[:, ::-1]]]),
        mirror,
    )


def refill(points: Points, faces: Faces, num_points: int) -> Mesh | None:
    """A flat mesh of one outline meshed again, horizontal, facing up; None for any other mesh.

    The outline keeps its corners, where it turns by more than 20 degrees; between them the new
    outline follows it within a thousandth of its extent.

    Args:
        points: points of a clean mesh, shape (V, 3), metres.
        faces: point ids of the triangles, shape (F, 3).
        num_points: number of points, met within `COUNT_TOLERANCE`.

    Raises:
        ValueError: if `mesh_outline` refuses the outline.
    """
    flat = _laid_flat(points)
    loops = boundary_loops(faces)
    if flat is None or len(loops) != 1:
        return None
    outline = flat[loops[0]]
    covered, enclosed = face_areas(points, faces).sum(), abs(_signed_area(outline))
    if not np.isclose(covered, enclosed, rtol=1e-3):
        return None  # it overlaps itself
    return mesh_outline(_simplified(outline), num_points)


def check_outline(corners: Corners) -> Corners:
    """The corners of an outline as floats, if it is simple.

    Raises:
        ValueError: if there are fewer than three corners, one is not finite, the outline crosses
            or touches itself or encloses nothing, or it is too small or too large for a body.
    """
    corners = require_rows("corners", corners, 2)
    if len(corners) < 3:
        raise ValueError(f"an outline of {len(corners)} corners is given; give at least 3")
    size = np.ptp(corners, axis=0).max()
    twice = np.flatnonzero(_side_lengths(corners) <= 1e-9 * size)
    if twice.size:
        raise ValueError(f"corner {twice[0]} is there twice in a row; leave one out")
    starts, ends = corners, np.roll(corners, -1, axis=0)
    for side, (start, end) in enumerate(zip(starts, ends, strict=True)):
        # The side before and the one after may touch this one only at the corner.
        others = np.delete(np.arange(len(corners)), [side - 1, side, (side + 1) % len(corners)])
        far = np.concatenate([corners[others], starts[[side - 1]], ends[[(side + 1) % len(ends)]]])
        touched = _distances(far, start[None], end[None]).min() <= 1e-9 * size
        if touched or _cross(start, end, starts[others], ends[others]).any():
            raise ValueError(
                f"the outline crosses or touches itself at the side from "
                f"{start.round(4).tolist()} to {end.round(4).tolist()}; give a simple outline"
            )
    if abs(_signed_area(corners)) <= 1e-9 * size**2:
        raise ValueError("the outline encloses nothing; give corners around an area")
    require_size("the largest extent of the outline", size)
    return corners


def _fill(corners: np.ndarray, num_points: int, *, mirrored: bool) -> tuple[np.ndarray, np.ndarray]:
    """Points on the sides, from the start of each side, and points inside, shape (_, 2) each.

    If `mirrored`, `num_points` includes the mirror images of the points off x = 0.
    """
    num_points = require_count("num_points", num_points, 3, MOST_PARTICLES)
    images = 2 if mirrored else 1
    area, around = abs(_signed_area(corners)), _side_lengths(corners).sum()
    # A hexagonal lattice has num = 2 area / (sqrt(3) h^2) + around / (2 h) + 1 points.
    wanted = num_points / images
    spacing = (around + np.sqrt(around**2 + 32 * wanted * area / np.sqrt(3))) / (4 * wanted)
    best, miss = None, np.inf
    for _ in range(30):
        sides = _divide(corners, spacing)
        inside = _lattice(corners, spacing)
        count = images * (len(sides) + len(inside))
        count -= int((sides[:, 0] == 0).sum()) if mirrored else 0
        if abs(count - num_points) < miss:
            best, miss, found = (sides, inside), abs(count - num_points), count
        spacing *= (count / num_points) ** 0.4  # below 1/2, which overshoots
    if best is None or miss > COUNT_TOLERANCE * num_points:
        raise ValueError(
            f"{num_points} points are asked for; this outline is met with {found}: ask for that, "
            f"or for many more"
        )
    return best


def _divide(corners: np.ndarray, spacing: float) -> np.ndarray:
    """Points along the outline, each side divided evenly, about `spacing` apart."""
    ends = np.roll(corners, -1, axis=0)
    parts = np.maximum(1, np.rint(_side_lengths(corners) / spacing)).astype(int)
    rows = [
        start + (end - start) * np.arange(count)[:, None] / count
        for start, end, count in zip(corners, ends, parts, strict=True)
    ]
    return np.concatenate(rows)


def _lattice(corners: np.ndarray, spacing: float) -> np.ndarray:
    """Points of a hexagonal lattice inside the outline, clear of it."""
    low, high = corners.min(axis=0), corners.max(axis=0)
    rise = spacing * np.sqrt(3) / 2
    rows = np.arange(1 + int((high[1] - low[1]) / rise))
    columns = np.arange(1 + int((high[0] - low[0]) / spacing))
    x = low[0] + spacing * (columns[None] + (rows[:, None] % 2) / 2)
    y = np.broadcast_to(low[1] + rise * rows[:, None], x.shape)
    points = np.stack([x.ravel(), y.ravel()], axis=1)
    clear = _distances(points, corners, np.roll(corners, -1, axis=0)) > CLEARANCE * spacing
    return points[clear.all(axis=1) & _inside(points, corners)]


def _triangulate(
    corners: np.ndarray, sides: np.ndarray, inside: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Delaunay's triangulation of an outline and its inner points; corners first."""
    is_corner = (sides[:, None] == corners[None]).all(axis=2).any(axis=1)
    order = np.argsort(~is_corner, kind="stable")
    ring = np.argsort(order)  # ids of the points along the outline
    points = np.concatenate([sides[order], inside])
    faces = _delaunay(points, corners)
    found, _, _ = distinct_edges(boundary_edges(faces)[0])
    wanted, _, _ = distinct_edges(np.stack([ring, np.roll(ring, -1)], axis=1))
    if not np.array_equal(found, wanted):
        raise ValueError(
            f"the outline has parts too narrow for {len(points)} points; ask for more points, "
            f"or widen it"
        )
    return np.concatenate([points, np.zeros((len(points), 1))], axis=1), faces


def _delaunay(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Triangles inside the outline, counter-clockwise."""
    from scipy.spatial import Delaunay

    faces = Delaunay(points).simplices.astype(np.int64)
    a, b, c = points[faces].transpose(1, 0, 2)
    area = _cross_product(b - a, c - a) / 2
    faces = np.where((area < 0)[:, None], faces[:, ::-1], faces)
    # Points on a side may leave triangles that are empty up to rounding.
    whole = np.abs(area) > 1e-9 * np.ptp(corners, axis=0).max() ** 2
    return faces[whole & _inside((a + b + c) / 3, corners)]


def _laid_flat(points: np.ndarray) -> Float[np.ndarray, "V 2"] | None:
    """A flat mesh turned to horizontal by the least angle, shape (V, 2); None if it is not flat."""
    centred = points - points.mean(axis=0)
    normal = np.linalg.svd(centred, full_matrices=False)[2][2]
    if np.ptp(centred @ normal) > FLAT * np.ptp(points, axis=0).max():
        return None
    leading = normal[::-1][np.flatnonzero(np.abs(normal[::-1]) > 1e-9)[0]]
    normal = normal * np.sign(leading)  # up, otherwise along y or x
    axis = np.cross(normal, [0.0, 0.0, 1.0])
    cross = np.cross(np.eye(3), axis)  # its rows are e x axis
    turn = np.eye(3) + cross + cross @ cross / (1 + normal[2])
    return (centred @ turn.T)[:, :2]


def _simplified(outline: np.ndarray) -> np.ndarray:
    """Corners of an outline, and the further points needed to follow it closely."""
    along = np.roll(outline, -1, axis=0) - outline
    before = np.roll(along, 1, axis=0)
    angle = np.arctan2(_cross_product(before, along), np.sum(before * along, axis=1))
    kept = np.flatnonzero(np.abs(angle) > TURN).tolist()
    if len(kept) < 2:
        first = kept[0] if kept else 0
        farthest = int(np.linalg.norm(outline - outline[first], axis=1).argmax())
        kept = sorted([first, farthest])
    tolerance = 1e-3 * np.ptp(outline, axis=0).max()
    corners = []
    for start, end in zip(kept, [*kept[1:], kept[0] + len(outline)], strict=True):
        run = outline[np.arange(start, end + 1) % len(outline)]
        corners.append(run[_follow(run, tolerance)[:-1]])
    return np.concatenate(corners)


def _follow(line: np.ndarray, tolerance: float) -> list[int]:
    """Ids of a line's points whose polyline is within the tolerance (Douglas and Peucker)."""
    kept, spans = {0, len(line) - 1}, [(0, len(line) - 1)]
    while spans:
        start, end = spans.pop()
        if end - start < 2:
            continue
        away = _distances(line[start + 1 : end], line[[start]], line[[end]])[:, 0]
        if away.max() > tolerance:
            middle = start + 1 + int(away.argmax())
            kept.add(middle)
            spans += [(start, middle), (middle, end)]
    return sorted(kept)


def _signed_area(corners: np.ndarray) -> float:
    return float(_cross_product(corners, np.roll(corners, -1, axis=0)).sum() / 2)


def _side_lengths(corners: np.ndarray) -> np.ndarray:
    return np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)


def _cross_product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _cross(start: np.ndarray, end: np.ndarray, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Whether a segment crosses each of some others, from one side to the other."""
    sides = [_cross_product(end - start, points - start) for points in (starts, ends)]
    own = [_cross_product(ends - starts, point - starts) for point in (start, end)]
    return (sides[0] * sides[1] < 0) & (own[0] * own[1] < 0)


def _distances(points: np.ndarray, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Distances of points from segments, shape (P, C)."""
    along = ends - starts
    away = points[:, None] - starts[None]
    share = np.sum(away * along[None], axis=2) / np.sum(along**2, axis=1)
    return np.linalg.norm(away - np.clip(share, 0, 1)[..., None] * along[None], axis=2)


def _inside(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Whether points are inside an outline: a ray along x crosses it an odd number of times."""
    (x0, y0), (x1, y1) = corners.T, np.roll(corners, -1, axis=0).T
    x, y = points.T[:, :, None]
    crosses = (y0 > y) != (y1 > y)
    # Whether the point is left of the crossing, without a division by the side's rise.
    before = ((y - y0) * (x1 - x0) > (x - x0) * (y1 - y0)) == (y1 > y0)
    return (crosses & before).sum(axis=1) % 2 == 1
