"""Topology: edges, rims, pieces and neighbours of triangle meshes and of springs.

A mesh is an array of the point ids of its triangles, shape (F, 3); springs and edges are pairs of
ids, shape (E, 2). Coordinates are not used.
"""

import numpy as np
from jaxtyping import Bool, Int

Faces = Int[np.ndarray, "F 3"]
Pairs = Int[np.ndarray, "_ 2"]


def half_edges(faces: Faces) -> tuple[Int[np.ndarray, "3*F 2"], Int[np.ndarray, " 3*F"]]:
    """Edges of each triangle, in the triangle's direction, and the corners opposite to them.

    Rows `i`, `F + i` and `2 F + i` belong to triangle `i`.

    Args:
        faces: point ids of the triangles, shape (F, 3).
    """
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    return edges, faces[:, [2, 0, 1]].T.ravel()


def distinct_edges(edges: Pairs) -> tuple[Pairs, Int[np.ndarray, " _"], Int[np.ndarray, " _"]]:
    """Edges without direction: each once, with the index for every row and the number of rows.

    Args:
        edges: pairs of point ids, shape (H, 2); a pair may occur several times, in any direction.

    Returns:
        The E different pairs, lower id first, in ascending order, shape (E, 2); for each row of
        `edges` the index of its pair, shape (H,); the number of rows of each pair, shape (E,).
    """
    pairs, where, count = np.unique(
        np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    return pairs, where.ravel(), count


def boundary_edges(faces: Faces) -> tuple[Pairs, Int[np.ndarray, " _"]]:
    """Edges of one triangle only, in its direction, and that triangle.

    Args:
        faces: point ids of the triangles, shape (F, 3).

    Returns:
        Edges in the order of `half_edges`, shape (E, 2), and ids of their triangles, shape (E,).
    """
    edges, _ = half_edges(faces)
    _, where, count = distinct_edges(edges)
    alone = np.flatnonzero(count[where] == 1)
    return edges[alone], alone % max(len(faces), 1)


def shared_half_edges(faces: Faces) -> Pairs:
    """The two rows in `half_edges` of each edge of exactly two triangles, ascending, shape (E, 2).

    Args:
        faces: point ids of the triangles, shape (F, 3).
    """
    _, where, count = distinct_edges(half_edges(faces)[0])
    # In the order of edges: the two rows of an edge of two triangles are adjacent.
    order = np.argsort(where, kind="stable")
    return order[np.repeat(count == 2, count)].reshape(-1, 2)


def inner_edges(faces: Faces) -> tuple[Pairs, Pairs, Pairs]:
    """Edges of two triangles, the points opposite to them, and the triangles, shape (E, 2) each.

    An edge has the direction of its first triangle, the one with the lower row in `half_edges`.

    Args:
        faces: point ids of the triangles, shape (F, 3).
    """
    edges, opposite = half_edges(faces)
    rows = shared_half_edges(faces)
    return edges[rows[:, 0]], opposite[rows], rows % max(len(faces), 1)


def boundary_loops(faces: Faces) -> list[list[int]]:
    """Point ids along each boundary, in the direction of its triangles.

    Args:
        faces: point ids of the triangles, shape (F, 3), all facing the same way.

    Raises:
        ValueError: if a boundary touches itself or another one at a point.
    """
    edges, _ = boundary_edges(faces)
    after = dict(edges.tolist())
    if len(after) < len(edges):
        raise ValueError("the boundary touches itself at a point; cut the mesh there")
    loops = []
    while after:
        start = next(iter(after))
        loop = [start]
        while (point := after.pop(loop[-1])) != start:
            loop.append(point)
        loops.append(loop)
    return loops


def rim(faces: Faces, num_points: int) -> Int[np.ndarray, "N 2"]:
    """The two neighbours of each point along the boundary, shape (N, 2); -1 for inner points.

    Where boundaries touch, a point has more than two neighbours: these are the lowest and highest.

    Args:
        faces: point ids of the triangles, shape (F, 3).
        num_points: number of points, N.
    """
    edges, _ = boundary_edges(faces)
    both = np.concatenate([edges, edges[:, ::-1]])
    both = both[np.lexsort(both.T[::-1])]
    found = np.full((num_points, 2), -1)
    # Assignment in forward order keeps the last neighbour, in backward order the first.
    found[both[:, 0], 1] = both[:, 1]
    found[both[::-1, 0], 0] = both[::-1, 1]
    return found


def chain(num_points: int, apart: int = 1) -> Pairs:
    """Pairs of points at a distance of `apart` places in a line, lower id first.

    Args:
        num_points: number of points in the line.
        apart: number of places, at least 1.
    """
    ids = np.arange(num_points)
    return np.stack([ids[:-apart], ids[apart:]], axis=1)


def neighbours(
    pairs: Pairs, num_points: int
) -> tuple[Int[np.ndarray, " _"], Int[np.ndarray, " _"]]:
    """The neighbours of each point, joined to it by pairs.

    Args:
        pairs: point ids, shape (E, 2); a pair may occur several times, in any direction.
        num_points: number of points, N.

    Returns:
        `first`, shape (N + 1,), and `other`: the neighbours of point `i` are
        `other[first[i] : first[i + 1]]`, each once, in ascending order.
    """
    both = np.unique(np.concatenate([pairs, pairs[:, ::-1]]), axis=0)
    first = np.searchsorted(both[:, 0], np.arange(num_points + 1))
    return first, np.ascontiguousarray(both[:, 1])


def connected_pieces(pairs: Pairs, num_points: int) -> tuple[int, Int[np.ndarray, " N"]]:
    """Number of connected pieces, and the piece of each point, counted from 0.

    Args:
        pairs: point ids, shape (E, 2).
        num_points: number of points, N. A point of no pair is a piece of its own.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    shape = (num_points, num_points)
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=shape)
    number, piece = connected_components(graph, directed=False)
    return int(number), piece


def are_among(pairs: Pairs, edges: Pairs) -> Bool[np.ndarray, " _"]:
    """Whether each pair is one of the edges, in either direction, shape (len(pairs),).

    Args:
        pairs: point ids, shape (P, 2).
        edges: point ids, shape (E, 2).
    """
    count = 1 + max(pairs.max(initial=0), edges.max(initial=0))
    codes = [np.sort(each, axis=1) @ np.array([count, 1]) for each in (pairs, edges)]
    return np.isin(*codes)
