"""Surfaces: quadric edge collapse until the Hausdorff distance to the goal is too large.

The method of the paper (section III-A.2) with the algorithm behind its tool: quadric edge
collapse decimation (Garland & Heckbert, "Surface simplification using quadric error
metrics", 1997). A collapsed vertex keeps the position of one of the two ends (subset
placement), so that every vertex of the model is a particle of the body.
"""

import heapq
from collections.abc import Iterable, Iterator

import numpy as np
from jaxtyping import Float, Int

from jaxsimp.bodies import Body
from jaxsimp.bodies.topology import boundary_edges, inner_edges
from jaxsimp.goals import Positions
from jaxsimp.simplification.key_points import KeyPoints
from jaxsimp.simplification.surfaces.common import (
    DEFAULT_MAX_SIZE,
    check_surfaces,
    fewest_vertices,
)

MIN_SIZE = 4  # two triangles, where the paper starts
# Weights of the planes of boundary edges and turns, for a mesh scaled to half an extent of 1,
# in which a triangle's plane weighs its area. With both three times smaller or larger, tests
# of 8 folds on meshes of 12 x 12 to 25 x 25 particles give the same results.
BOUNDARY_WEIGHT = 3.0  # times the length of the edge
TURN_WEIGHT = 0.01
LEAST_HEIGHT = 1e-3  # height of a triangle over its longest edge, below which it is degenerate
LEAST_GAIN = 0.1  # reduction of strain that replaces an edge; rounding must not decide
ROUNDING = 1e-10  # quadric errors below this are rounding


def simplify_quadric(
    body: Body,
    goals: Float[np.ndarray, "B N 3"],
    tolerance: float | None = None,
    max_size: int | None = None,
) -> list[KeyPoints]:
    """Key points of goals of a surface: the vertices of the smallest mesh that covers each.

    One decimation of a goal's mesh goes down to four vertices where its topology allows; the
    meshes on the way are compared with the goal from the smallest up, by the Hausdorff
    distance (see `fewest_vertices`).

    Two steps go beyond the paper's tool: `follow_creases` prepares the mesh, and quadrics hold
    turns of the boundary in place like its edges. Without them a fold along the diagonal that
    the triangles' edges cross gives 5 key points instead of 4 on some meshes.

    Args:
        body: a body with triangles.
        goals: goal positions, shape (B, N, 3), metres.
        tolerance: Hausdorff distance below which a mesh fits, metres; a tenth of the
            body's size by default.
        max_size: largest number of key points tried; 24 by default.

    Returns:
        Key points of each goal: the best of the meshes tried, with the status `NO_FIT`, where no
        mesh of up to `max_size` vertices fits.

    Raises:
        ValueError: if the body has no triangles, a goal does not fit the body, the tolerance
            is not above zero, or `max_size` is below 4.
    """
    tolerance = 0.1 * body.size if tolerance is None else tolerance
    max_size = DEFAULT_MAX_SIZE if max_size is None else max_size
    goals = check_surfaces(body, goals, tolerance, max_size, MIN_SIZE)
    found = []
    for goal in goals:
        meshes = collapse_sequence(goal, follow_creases(body, goal), max_size)
        sizes = sorted(meshes)
        found.append(fewest_vertices(body, goal, meshes, sizes, tolerance, "quadric collapse"))
    return found


def follow_creases(body: Body, goal: Positions) -> Int[np.ndarray, "F 3"]:
    """Triangles of the body with edges along the goal's creases, shape (F, 3).

    A body's triangles do not depend on the goal. Where an edge crosses a crease its ends coincide,
    and its two triangles stand upright between the layers: a wall that the cloth does not have, and
    that would hold its vertices. Such an edge is shorter than at rest; the other diagonal of its
    two triangles replaces it where that one keeps its length.

    Args:
        body: a body with triangles.
        goal: goal positions, shape (N, 3), metres.
    """
    faces = body.faces.copy()
    edges, others, pairs = inner_edges(faces)
    a, b, c, d = *edges.T, *others.T
    flipped = np.stack([np.stack([c, a, d], axis=1), np.stack([d, b, c], axis=1)], axis=1)
    # The two triangles are a flat convex quadrangle if both diagonals give the same area.
    flat = np.isclose(_area(body.rest, faces[pairs]), _area(body.rest, flipped), atol=0.0)
    gain = _strain(body.rest, goal, edges) - _strain(body.rest, goal, others)
    touched: set[int] = set()
    for quad in np.flatnonzero(flat & (gain > LEAST_GAIN)):
        if touched.isdisjoint(pairs[quad].tolist()):
            faces[pairs[quad]] = flipped[quad]
            touched.update(pairs[quad].tolist())
    return faces


def collapse_sequence(
    points: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], max_size: int
) -> dict[int, Int[np.ndarray, "_ 3"]]:
    """Meshes of at most `max_size` vertices, by number of vertices, from one decimation.

    Each step removes the vertex whose quadric error, divided by the shape of the worst
    triangle that results, is least. A collapse that would change the topology (link
    condition), turn a triangle over or make one degenerate waits until its surroundings
    change. The sequence ends at four vertices, or earlier where no collapse is possible. Edge
    length, then vertex id, decide between equal costs: the result is deterministic.

    Args:
        points: vertex positions, shape (V, 3), metres.
        faces: vertex ids of the triangles, shape (F, 3), consistently oriented.
        max_size: number of vertices of the largest mesh to keep.

    Returns:
        Triangles of each mesh, in the vertex ids of `faces`.
    """
    centred = points - points.mean(axis=0)
    collapses = _Collapses(centred / max(np.abs(centred).max(), np.finfo(float).tiny), faces)
    kept = {}
    for _ in collapses:
        size = len(collapses.vertices)
        if size <= max_size:
            kept[size] = collapses.triangles()
    return kept


class _Collapses:
    """A mesh under decimation, and the queue of its possible collapses."""

    def __init__(self, points: np.ndarray, faces: np.ndarray) -> None:
        self.points = points
        self.faces = faces.copy()
        self.quadrics = _quadrics(points, faces)
        self.around: list[set[int]] = [set() for _ in points]
        for face, corners in enumerate(faces.tolist()):
            for vertex in corners:
                self.around[vertex].add(face)
        self.ring = [self._neighbours(vertex) for vertex in range(len(points))]
        self.vertices = {vertex for vertex, ring in enumerate(self.ring) if ring}
        self.latest: dict[tuple[int, int], int] = {}
        self.queue: list[tuple[float, float, int, int, int]] = []

    def __iter__(self) -> Iterator[None]:
        """Collapse until four vertices are left; yields at every mesh, the first included."""
        self._enqueue(self.vertices)
        yield
        while self.queue and len(self.vertices) > MIN_SIZE:
            *_, removed, kept, ticket = heapq.heappop(self.queue)
            if self.latest.get((removed, kept)) != ticket:
                continue
            # A collapse that is not sound enters the queue again when its surroundings change.
            if self._links(removed, kept) and self._sound(removed, kept):
                self._enqueue(self._collapse(removed, kept))
                yield

    def triangles(self) -> np.ndarray:
        """Triangles of the current mesh, shape (F, 3)."""
        alive = sorted(set().union(*(self.around[vertex] for vertex in self.vertices)))
        return self.faces[alive]

    def _neighbours(self, vertex: int) -> set[int]:
        return set(self.faces[list(self.around[vertex])].ravel().tolist()) - {vertex}

    def _links(self, removed: int, kept: int) -> bool:
        """Whether the collapse keeps the surface's topology (link condition)."""
        shared = self.around[removed] & self.around[kept]
        if len(self.ring[removed] & self.ring[kept]) != len(shared):
            return False
        inner = len(shared) == 2
        return not (inner and self._on_boundary(removed) and self._on_boundary(kept))

    def _sound(self, removed: int, kept: int) -> bool:
        """Whether the collapse leaves triangles, none of them degenerate or turned over."""
        moving = list(self.around[removed] - self.around[kept])
        if not moving:
            return False
        before = self.faces[moving]
        old, _ = _normals(self.points[before])
        new, longest = _normals(self.points[np.where(before == removed, kept, before)])
        wide = np.sum(new**2, axis=1) > (LEAST_HEIGHT * longest) ** 2
        upright = np.sum(old * new, axis=1) >= 0
        return bool((wide & upright).all())

    def _on_boundary(self, vertex: int) -> bool:
        return len(self.ring[vertex]) != len(self.around[vertex])

    def _collapse(self, removed: int, kept: int) -> set[int]:
        """Move `removed` onto `kept`; returns the vertices whose triangles changed."""
        vanishing = self.around[removed] & self.around[kept]
        moving = self.around[removed] - vanishing
        changed = self.ring[removed]
        for vertex in changed:
            self.around[vertex] -= vanishing
            self.latest.pop((removed, vertex), None)
            self.latest.pop((vertex, removed), None)
        rows = list(moving)
        self.faces[rows] = np.where(self.faces[rows] == removed, kept, self.faces[rows])
        self.around[kept] |= moving
        self.around[removed] = set()
        self.quadrics[kept] += self.quadrics[removed]
        self.vertices.discard(removed)
        for vertex in changed:
            self.ring[vertex] = self._neighbours(vertex)
        return changed

    def _enqueue(self, vertices: Iterable[int]) -> None:
        """Put all collapses along the edges at `vertices` into the queue again."""
        edges = {(v, w) for v in vertices for w in self.ring[v]}
        edges |= {(w, v) for v, w in edges}
        pairs = sorted(edges)
        for pair, cost, length in zip(pairs, *self._price(np.array(pairs)), strict=True):
            ticket = self.latest[pair] = self.latest.get(pair, 0) + 1
            heapq.heappush(self.queue, (cost, length, *pair, ticket))

    def _price(self, pairs: np.ndarray) -> tuple[list[float], list[float]]:
        """Quadric errors of the collapses (removed, kept), and lengths of their edges."""
        removed, kept = pairs.T
        target = _homogeneous(self.points[kept])
        quadric = self.quadrics[removed] + self.quadrics[kept]
        error = np.einsum("pi,pij,pj->p", target, quadric, target)
        length = np.linalg.norm(self.points[kept] - self.points[removed], axis=1)
        return np.maximum(error / ROUNDING, 1.0).round(6).tolist(), length.round(6).tolist()


def _area(points: np.ndarray, quads: np.ndarray) -> np.ndarray:
    """Areas of pairs of triangles, given as vertex ids of shape (E, 2, 3)."""
    normals, _ = _normals(points[quads].reshape(-1, 3, 3))
    return np.linalg.norm(normals, axis=1).reshape(-1, 2).sum(axis=1) / 2


def _strain(rest: np.ndarray, goal: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Absolute strain of edges: change of length relative to the rest length, shape (E,)."""
    length, rest_length = (
        np.linalg.norm(points[edges[:, 1]] - points[edges[:, 0]], axis=1) for points in (goal, rest)
    )
    return np.abs(length / np.maximum(rest_length, np.finfo(float).tiny) - 1)


def _quadrics(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Sum of the squared distances to the planes that meet at each vertex, shape (V, 4, 4).

    A triangle's plane is weighted by its area. A boundary edge adds the plane through it at right
    angles to its triangle, so that the boundary keeps its place.
    """
    normals, _ = _normals(points[faces])
    area = np.linalg.norm(normals, axis=1) / 2
    quadrics = np.zeros((len(points), 4, 4))
    _add_planes(quadrics, points, faces, normals, area)
    edges, owner = boundary_edges(faces)
    along = points[edges[:, 1]] - points[edges[:, 0]]
    weight = BOUNDARY_WEIGHT * np.linalg.norm(along, axis=1)
    _add_planes(quadrics, points, edges, np.cross(along, normals[owner]), weight)
    _add_turns(quadrics, points, edges, along)
    return quadrics


def _add_turns(
    quadrics: np.ndarray, points: np.ndarray, edges: np.ndarray, along: np.ndarray
) -> None:
    """Hold a vertex where the boundary turns, in the direction of the turn.

    Where a folded boundary returns on itself, the planes of its edges coincide, and leave the end
    of the crease free to slide along them. The turn is the sum of the unit vectors of incoming
    edges less those of outgoing edges: zero on a straight boundary, of length two at a return.
    """
    length = np.linalg.norm(along, axis=1, keepdims=True)
    direction = along / np.maximum(length, np.finfo(float).tiny)
    turn = np.zeros_like(points)
    np.add.at(turn, edges[:, 1], direction)
    np.subtract.at(turn, edges[:, 0], direction)
    vertices = np.unique(edges)
    weight = TURN_WEIGHT * np.sum(turn[vertices] ** 2, axis=1)
    _add_planes(quadrics, points, vertices[:, None], turn[vertices], weight)


def _add_planes(
    quadrics: np.ndarray,
    points: np.ndarray,
    simplices: np.ndarray,
    normals: np.ndarray,
    weights: np.ndarray,
) -> None:
    """Add the weighted quadric of a plane through each simplex to the quadrics of its vertices."""
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    unit = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
    offset = -np.sum(unit * points[simplices[:, 0]], axis=1, keepdims=True)
    plane = np.concatenate([unit, offset], axis=1)
    quadric = weights[:, None, None] * plane[:, :, None] * plane[:, None, :]
    for vertices in simplices.T:
        np.add.at(quadrics, vertices, quadric)


def _normals(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normals of triangles, of length twice their area, and their longest edges squared."""
    edges = corners[:, [1, 2, 0]] - corners
    x, y = edges[:, 0], edges[:, 1]
    normals = x[:, [1, 2, 0]] * y[:, [2, 0, 1]] - x[:, [2, 0, 1]] * y[:, [1, 2, 0]]
    return normals, np.sum(edges**2, axis=2).max(axis=1)


def _homogeneous(points: np.ndarray) -> np.ndarray:
    return np.concatenate([points, np.ones((len(points), 1))], axis=1)
