"""Topology: edges, rims, pieces and neighbours, against loops over triangles."""

from collections import defaultdict
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxsimp.bodies.topology import (
    are_among,
    boundary_edges,
    boundary_loops,
    chain,
    connected_pieces,
    distinct_edges,
    half_edges,
    inner_edges,
    neighbours,
    rim,
    shared_half_edges,
)

POINTS = 9

pairs = st.lists(
    st.tuples(st.integers(0, POINTS - 1), st.integers(0, POINTS - 1)), max_size=20
).map(lambda rows: np.array(rows, dtype=int).reshape(-1, 2))


def faces_of(seed: int) -> np.ndarray:
    """Some of all triangles of a few points, any way round: edges of none, one, two and more."""
    rng = np.random.default_rng(seed)
    every = np.array(list(combinations(range(POINTS), 3)))
    chosen = every[rng.permutation(len(every))[: rng.integers(0, 25)]]
    return rng.permuted(chosen, axis=1)


faces = st.integers(0, 10**6).map(faces_of)


def grid(rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Ids of a grid's points, and its triangles, counter-clockwise."""
    ids = np.arange(rows * columns).reshape(rows, columns)
    cells = [
        (ids[i, j], ids[i + 1, j], ids[i, j + 1], ids[i + 1, j + 1])
        for i in range(rows - 1)
        for j in range(columns - 1)
    ]
    return ids, np.array([t for a, b, c, d in cells for t in ((a, b, c), (b, d, c))])


def directed_edges(faces) -> dict[tuple[int, int], list[tuple[int, int, int]]]:
    """By edge, lower id first: start, end and triangle wherever it occurs, edge by edge."""
    found = defaultdict(list)
    for corner in range(3):
        for triangle, face in enumerate(faces.tolist()):
            start, end = face[corner], face[(corner + 1) % 3]
            found[min(start, end), max(start, end)].append((start, end, triangle))
    return found


def test_half_edges_go_with_the_corner_that_they_leave_out():
    edges, opposite = half_edges(np.array([[3, 5, 7], [7, 5, 9]]))
    assert edges.tolist() == [[3, 5], [7, 5], [5, 7], [5, 9], [7, 3], [9, 7]]
    assert opposite.tolist() == [7, 9, 3, 7, 5, 5]


@given(edges=pairs)
def test_distinct_edges_are_each_pair_once_and_counted(edges):
    found, where, count = distinct_edges(edges)
    sorted_rows = [tuple(sorted(row)) for row in edges.tolist()]
    assert list(map(tuple, found.tolist())) == sorted(set(sorted_rows))
    assert [tuple(found[i]) for i in where] == sorted_rows
    assert count.tolist() == [sorted_rows.count(pair) for pair in sorted(set(sorted_rows))]


@given(faces=faces)
def test_boundary_edges_have_one_triangle_and_run_as_in_it(faces):
    edges, triangle = boundary_edges(faces)
    alone = [uses[0] for uses in directed_edges(faces).values() if len(uses) == 1]
    found = np.column_stack([edges, triangle])
    assert sorted(map(tuple, found.tolist())) == sorted(alone)
    rows = list(map(tuple, half_edges(faces)[0].tolist()))
    assert sorted(rows.index(tuple(edge)) for edge in edges.tolist()) == [
        rows.index(tuple(edge)) for edge in edges.tolist()
    ]


@given(faces=faces)
def test_inner_edges_have_two_triangles_and_the_corners_opposite(faces):
    edges, opposite, triangles = inner_edges(faces)
    wanted = {}
    for pair, uses in directed_edges(faces).items():
        if len(uses) == 2:
            owners = [use[2] for use in uses]
            corners = [next(c for c in faces[owner].tolist() if c not in pair) for owner in owners]
            wanted[pair] = (*uses[0][:2], *corners, *owners)
    found = np.column_stack([edges, opposite, triangles]).tolist()
    assert list(map(tuple, found)) == [wanted[pair] for pair in sorted(wanted)]


@given(faces=faces)
def test_shared_half_edges_are_the_rows_of_one_edge(faces):
    rows, edges = shared_half_edges(faces), half_edges(faces)[0]
    assert (rows[:, 0] < rows[:, 1]).all()
    assert np.array_equal(*(np.sort(edges[each], axis=1) for each in rows.T))
    assert len(rows) == sum(len(uses) == 2 for uses in directed_edges(faces).values())


@given(rows=st.integers(2, 6), columns=st.integers(2, 6))
def test_the_boundary_of_a_grid_is_its_perimeter(rows, columns):
    ids, faces = grid(rows, columns)
    ring = [*ids[:-1, 0], *ids[-1, :-1], *ids[:0:-1, -1], *ids[0, :0:-1]]
    (loop,) = boundary_loops(faces)
    # Counter-clockwise triangles have the inside to the left of their boundary.
    at = ring.index(loop[0])
    assert loop == [*ring[at:], *ring[:at]]
    sides = rim(faces, ids.size)
    for before, point, after in zip(ring[-1:] + ring[:-1], ring, [*ring[1:], ring[0]], strict=True):
        assert sides[point].tolist() == sorted([before, after])
    assert (sides[np.setdiff1d(ids, ring)] == -1).all()


def test_a_closed_surface_has_no_boundary():
    tetrahedron = np.array([[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]])
    assert len(boundary_edges(tetrahedron)[0]) == 0
    assert boundary_loops(tetrahedron) == []
    assert (rim(tetrahedron, 4) == -1).all()


def test_a_ring_has_two_boundaries():
    ids, faces = grid(4, 4)
    hole = {ids[1, 1], ids[2, 2], ids[1, 2], ids[2, 1]}
    faces = faces[[not set(face) <= hole for face in faces.tolist()]]
    assert sorted(map(len, boundary_loops(faces))) == [4, 12]


def test_boundaries_that_touch_are_refused_as_loops_and_cut_short_as_a_rim():
    bow = np.array([[0, 1, 2], [2, 3, 4]])
    with pytest.raises(ValueError, match="touches itself at a point; cut the mesh there"):
        boundary_loops(bow)
    assert rim(bow, 6).tolist() == [[1, 2], [0, 2], [0, 4], [2, 4], [2, 3], [-1, -1]]


@pytest.mark.parametrize("apart", [1, 2])
@given(count=st.integers(0, 8))
def test_a_chain_joins_points_of_a_line(apart, count):
    wanted = [[i, i + apart] for i in range(count) if i + apart < count]
    assert chain(count, apart).tolist() == wanted


@given(edges=pairs)
def test_neighbours_are_what_pairs_join(edges):
    first, other = neighbours(edges, POINTS)
    for point in range(POINTS):
        joined = {b if a == point else a for a, b in edges.tolist() if point in (a, b)}
        assert other[first[point] : first[point + 1]].tolist() == sorted(joined)


@given(edges=pairs)
def test_pieces_are_what_pairs_connect(edges):
    number, piece = connected_pieces(edges, POINTS)
    label = list(range(POINTS))  # of each point, the lowest id of its piece in the end
    for _ in range(POINTS):
        for a, b in edges.tolist():
            label[a] = label[b] = min(label[a], label[b])
    assert number == len(set(label))
    for a, b in combinations(range(POINTS), 2):
        assert (piece[a] == piece[b]) == (label[a] == label[b])


@given(some=pairs, edges=pairs)
def test_pairs_are_found_among_edges_either_way_round(some, edges):
    known = [set(edge) for edge in edges.tolist()]
    assert are_among(some, edges).tolist() == [set(pair) in known for pair in some.tolist()]
