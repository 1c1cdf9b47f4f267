"""Rest coordinates of a sheet from a goal: triangles laid flat with the goal's edge lengths.

A folded or crumpled sheet is nearly isometric to its flat rest shape, and layers that coincide in
space are still apart along the sheet. Distances along the edges therefore give a first layout
(multidimensional scaling, as in J. Tenenbaum et al., "A global geometric framework for nonlinear
dimensionality reduction", 2000), and Gauss-Newton steps fit the lengths of the edges. The weight
of wrong edges, such as those across a crease, falls in stages (S. Geman and D. McClure's loss,
with a decreasing scale).
"""

import numpy as np
from jaxtyping import Float, Int

from jaxsimp.bodies.meshes import WELD
from jaxsimp.bodies.size import require_size
from jaxsimp.bodies.topology import (
    Faces,
    connected_pieces,
    distinct_edges,
    half_edges,
    inner_edges,
)
from jaxsimp.checks import require_ids, require_shape
from jaxsimp.goals.shapes import Positions

SCALES = (1.0, 0.3, 0.1)
"""Misfit above which an edge's weight falls, relative to the median edge, for each stage."""
STEPS = 20
"""Number of steps per stage: half of them suffice on folded cloths and garments."""
ENOUGH = 1e-6
"""Step, relative to the longest edge, after which no further one is taken."""
DAMPING = 1e-3
"""Stiffness that holds each point, relative to an edge: without it a solution may float."""
MOST_LANDMARKS = 64
MISFIT = 0.05
"""Largest median misfit of edges after the first stage, relative to the median edge: 2 mm of noise
on a cloth with 12.5 mm between particles gives 0.01, a hemisphere with a rim 0.06."""


def flatten(positions: Positions, faces: Faces) -> Float[np.ndarray, "N 2"]:
    """Flat rest coordinates of a sheet in a goal, shape (N, 2), metres.

    The smallest box around them lies along x and y, its longer side along x, and the first
    triangle is counter-clockwise. Lengths are accurate where creases lie along edges. An edge
    across a crease is shorter than at rest by an unknown amount: the sheet loses up to the width
    of a triangle there.

    Args:
        positions: positions of the particles in the goal, shape (N, 3), metres.
        faces: particle ids of the triangles, shape (F, 3).

    Raises:
        ValueError: if the triangles are not those of a disc, the goal is on a line or too large,
            or it cannot be laid flat: triangles would turn over, or edges would change by more
            than `MISFIT` in the median.
    """
    edges = _edges_of_disc(faces, len(positions))
    _check_extent(positions)
    lengths = np.linalg.norm(positions[edges[:, 1]] - positions[edges[:, 0]], axis=1)
    stages = lay_out(edges, lengths, len(positions))
    misfit = median_misfit(stages[0], edges, lengths)
    if misfit > MISFIT:
        raise ValueError(
            f"laid flat, its edges change by {misfit:.1%} in the median; {MISFIT:.0%} is the limit "
            f"for a sheet that is flat at rest. Add rest, or give the body"
        )
    # A stage with a small scale may turn slivers over that an earlier stage did not.
    lying = [points for points in stages if not _num_turned(points, faces)]
    if not lying:
        raise ValueError(
            f"it cannot be laid flat: {_num_turned(stages[-1], faces)} pairs of neighbouring "
            f"triangles would cover each other; add rest, or give the body"
        )
    return _upright(lying[-1], faces)


def lay_out(
    edges: Int[np.ndarray, "E 2"],
    lengths: Float[np.ndarray, " E"],
    num_points: int,
    first: Float[np.ndarray, "N 2"] | None = None,
) -> list[Float[np.ndarray, "N 2"]]:
    """Points in the plane with given distances of neighbours: one layout for each of `SCALES`.

    Args:
        edges: pairs of neighbours, which connect all points, shape (E, 2).
        lengths: their distances, shape (E,), metres.
        num_points: number of points, N.
        first: a layout to start from, shape (N, 2), metres; by default that of the distances
            along the edges.
    """
    usual = float(np.median(lengths))
    points = _scaled_distances(num_points, edges, lengths) if first is None else first
    stages = []
    for scale in SCALES:
        points = _fit_lengths(points, edges, lengths, scale * usual)
        stages.append(points)
    return stages


def median_misfit(
    points: Float[np.ndarray, "N 2"],
    edges: Int[np.ndarray, "E 2"],
    lengths: Float[np.ndarray, " E"],
) -> float:
    """Median difference of the distances in a layout from those given, over the median edge."""
    flat = np.linalg.norm(points[edges[:, 1]] - points[edges[:, 0]], axis=1)
    return float(np.median(np.abs(flat - lengths)) / np.median(lengths))


def _edges_of_disc(faces: np.ndarray, num_points: int) -> Int[np.ndarray, "E 2"]:
    """The edges of triangles that form one disc of all points, shape (E, 2)."""
    _check_ids(faces, num_points)
    edges, _, count = distinct_edges(half_edges(faces)[0])
    pieces, _ = connected_pieces(edges, num_points)
    border = np.bincount(edges[count == 1].ravel(), minlength=num_points)
    euler = num_points - len(edges) + len(faces)
    faults = {
        f"it is in {pieces} pieces": pieces > 1,
        f"{count.max()} triangles meet at an edge": count.max() > 2,
        "it is closed": not border.any(),
        "parts of it touch at a point only": border.max() > 2,
        f"its Euler characteristic is {euler}, and a disc's is 1": euler != 1,
    }
    for fault, found in faults.items():
        if found:
            raise ValueError(
                f"without rest coordinates the sheet must be a disc, without holes or handles: "
                f"{fault}; add rest, or give the body"
            )
    return edges


def _check_extent(positions: np.ndarray) -> None:
    """Raise a `ValueError` for a goal that is too large for a sheet, or on a line."""
    extent = float(np.ptp(positions, axis=0).max())
    require_size("the largest extent of positions", extent, smallest=0.0)
    spread = np.linalg.svd(positions - positions.mean(axis=0), compute_uv=False)
    if spread[1] <= WELD * spread[0]:
        raise ValueError("all particles lie on a line; add rest, or give the body")


def _check_ids(faces: np.ndarray, num_points: int) -> None:
    """Raise a `ValueError` for triangles with wrong shape, unknown points, or a point twice."""
    require_shape("faces", faces, ("F", 3), "a row of three points for each triangle")
    if not len(faces):
        raise ValueError("there are no faces; give at least one triangle")
    require_ids("a triangle", faces, num_points, "points")
    twice = np.flatnonzero((np.diff(np.sort(faces, axis=1), axis=1) == 0).any(axis=1))
    if twice.size:
        raise ValueError(
            f"triangle {twice[0]} names a point twice ({twice.size} such triangles); leave it out "
            f"of faces"
        )


def _scaled_distances(
    num_points: int, edges: np.ndarray, lengths: np.ndarray
) -> Float[np.ndarray, "N 2"]:
    """Points in the plane with approximately their distances along the edges, shape (N, 2).

    Classical scaling of the distances between some landmarks; their distances from these place the
    other points (V. de Silva and J. Tenenbaum, "Sparse multidimensional scaling using landmark
    points", 2004).
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import dijkstra

    count = min(num_points, MOST_LANDMARKS)
    landmarks = np.linspace(0, num_points - 1, count).round().astype(int)
    graph = coo_array((lengths, edges.T), shape=(num_points,) * 2).tocsr()
    squared = dijkstra(graph, directed=False, indices=landmarks) ** 2
    between = squared[:, landmarks]
    means = between.mean(axis=0)
    values, vectors = np.linalg.eigh((means + means[:, None] - between - between.mean()) / 2)
    axes = vectors[:, -2:] / np.sqrt(np.maximum(values[-2:], 1e-12))
    return (means[:, None] - squared).T @ axes / 2


def _fit_lengths(
    points: np.ndarray, edges: np.ndarray, lengths: np.ndarray, scale: float
) -> Float[np.ndarray, "N 2"]:
    """Points moved to fit the edges' lengths; a misfit far above `scale` has little weight."""
    from scipy.sparse import csc_array, eye_array
    from scipy.sparse.linalg import splu

    ends = 2 * edges[:, [0, 0, 1, 1]] + np.array([0, 1, 0, 1])
    rows = np.repeat(np.arange(len(edges)), 4)
    damping = DAMPING * eye_array(2 * len(points))
    for _ in range(STEPS):
        along = points[edges[:, 1]] - points[edges[:, 0]]
        now = np.linalg.norm(along, axis=1)
        unit = along / np.maximum(now, 1e-12)[:, None]
        shape = (len(edges), 2 * len(points))
        J = csc_array((np.hstack([-unit, unit]).ravel(), (rows, ends.ravel())), shape=shape)
        weights = (1 + ((now - lengths) / scale) ** 2) ** -2.0
        normal = csc_array(J.T @ (J * weights[:, None]) + damping)
        step = splu(normal).solve(J.T @ (weights * (now - lengths))).reshape(-1, 2)
        points = points - step
        if np.abs(step).max() <= ENOUGH * lengths.max():
            break
    return points


def _num_turned(points: np.ndarray, faces: np.ndarray) -> int:
    """Number of edges whose two triangles lie on the same side of them."""
    edges, opposite, _ = inner_edges(faces)
    start, end = points[np.sort(edges, axis=1)].transpose(1, 0, 2)
    sides = [_cross(end - start, points[corner] - start) for corner in opposite.T]
    return int(np.sum(sides[0] * sides[1] >= 0))


def _upright(points: np.ndarray, faces: np.ndarray) -> Float[np.ndarray, "N 2"]:
    """Points turned, and turned over, to the orientation that `flatten` documents."""
    from scipy.spatial import ConvexHull

    hull = points[ConvexHull(points).vertices]
    sides = np.roll(hull, -1, axis=0) - hull
    x = sides / np.linalg.norm(sides, axis=1, keepdims=True)  # an edge lies along the best box
    axes = np.stack([x, np.stack([-x[:, 1], x[:, 0]], axis=1)], axis=2)
    extents = np.ptp(hull @ axes, axis=1)
    best = int(extents.prod(axis=1).argmin())
    turned = points @ axes[best]
    if extents[best, 0] < extents[best, 1]:
        turned = np.stack([turned[:, 1], -turned[:, 0]], axis=1)
    a, b, c = turned[faces[0]]
    return turned if _cross(b - a, c - a) > 0 else turned * np.array([1.0, -1.0])


def _cross(first: np.ndarray, second: np.ndarray) -> np.ndarray | np.float64:
    return first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0]
