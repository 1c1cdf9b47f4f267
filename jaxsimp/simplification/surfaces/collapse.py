"""Compiled: quadric edge collapse in goal and rest coordinates together.

Quadrics in more than three dimensions: Garland & Heckbert, "Simplifying surfaces with color
and texture using quadric error metrics", 1998. The rest coordinates keep layers apart that
coincide in the goal, and show where noise turns a triangle over.
"""

import heapq
from typing import no_type_check

import numpy as np
from jaxtyping import Float, Int

from jaxsimp.compiling import compiler
from jaxsimp.simplification.surfaces.model import LinkedMesh, Points, Triangles, Vector

DIMENSIONS = 6  # goal x, y, z and rest x, y, z
LEAST_HEIGHT = 1e-3  # least height of a triangle at rest, relative to its longest edge
THIN = 1e-6  # sine of an angle below which a triangle is degenerate
SAME = 1e-14  # squared distances that differ by less are equal: above rounding at size 1
LENGTH_WEIGHT = 1e-9  # weight of an edge's squared length in its price: decides at zero quadrics

compiled = compiler("the simplification of surfaces", nogil=True)
Ids = Int[np.ndarray, " _"]
Matrix = Float[np.ndarray, "7 7"]
Queue = list[tuple[float, int, int, int, int]]  # price, vertex that goes and one that stays, stamps


@compiled
@no_type_check
def decimate(
    points: Float[np.ndarray, "N 6"],
    quadrics: Float[np.ndarray, "N 7 7"],
    rest: Points,
    facing: Points,
    faces: Triangles,
    size: int,
) -> tuple[Triangles, Ids]:
    """Collapse edges until `size` vertices are left, or no collapse is sound.

    Args:
        points: goal and rest coordinates, shape (N, 6), scaled alike.
        quadrics: quadric of each vertex, a squared distance as a function of a point in
            homogeneous coordinates, shape (N, 7, 7); changed in place.
        rest: rest coordinates, shape (N, 3).
        facing: normals at rest, of any length, shape (N, 3).
        faces: particle ids of the triangles, shape (F, 3), consistently oriented.
        size: number of vertices at which to stop.

    Returns:
        Remaining triangles, shape (M, 3), and the index of the triangle that covers each particle
        at rest, shape (N,); -1 for a particle of no triangle.
    """
    mesh = linked(rest, facing, faces)
    stamps = np.zeros(len(rest), dtype=np.int64)
    queue = [(0.0, -1, -1, 0, 0)]
    left = 0
    for vertex in range(len(rest)):
        around = star(mesh, vertex)
        left += len(around) > 0
        offer(queue, mesh, points, quadrics, stamps, vertex, around)
    while left > size and len(queue) > 0:
        _, gone, kept, stamp_gone, stamp_kept = heapq.heappop(queue)
        if gone < 0 or stamps[gone] != stamp_gone or stamps[kept] != stamp_kept:
            continue
        if not (links(mesh, gone, kept) and keeps_sound(mesh, gone, kept)):
            continue
        collapse(mesh, gone, kept)
        add_to(quadrics[kept], quadrics[gone])
        stamps[gone] = -1
        left -= 1
        around = star(mesh, kept)
        changed = ring(mesh, kept, around)
        changed.append(kept)
        for vertex in changed:
            stamps[vertex] += 1
        for vertex in changed:
            offer(queue, mesh, points, quadrics, stamps, vertex, star(mesh, vertex))
    return survivors(mesh)


@compiled
@no_type_check
def linked(rest: Points, facing: Points, faces: Triangles) -> LinkedMesh:
    """The mesh with its linked lists; each particle belongs to one of its own triangles."""
    first_corner = np.full(len(rest), -1, dtype=np.int64)
    next_corner = np.full(3 * len(faces), -1, dtype=np.int64)
    first_particle = np.full(len(faces), -1, dtype=np.int64)
    next_particle = np.full(len(rest), -1, dtype=np.int64)
    for face in range(len(faces)):
        for c in range(3):
            vertex = faces[face, c]
            if first_corner[vertex] < 0:
                next_particle[vertex] = first_particle[face]
                first_particle[face] = vertex
            next_corner[3 * face + c] = first_corner[vertex]
            first_corner[vertex] = 3 * face + c
    return LinkedMesh(
        rest, facing, faces.copy(), first_corner, next_corner, first_particle, next_particle
    )


@compiled
@no_type_check
def offer(
    queue: Queue,
    mesh: LinkedMesh,
    points: Float[np.ndarray, "N 6"],
    quadrics: Float[np.ndarray, "N 7 7"],
    stamps: Ids,
    vertex: int,
    around: list[int],
) -> None:
    """Put the collapses of all edges at a vertex, in both directions, into the queue."""
    for other in ring(mesh, vertex, around):
        length = 0.0
        for x in range(DIMENSIONS):
            length += (points[vertex, x] - points[other, x]) ** 2
        for gone, kept in ((vertex, other), (other, vertex)):
            price = max(0.0, price_at(quadrics[gone], quadrics[kept], points[kept]))
            price += LENGTH_WEIGHT * length
            heapq.heappush(queue, (price, gone, kept, stamps[gone], stamps[kept]))


@compiled
@no_type_check
def add_to(first: Matrix, second: Matrix) -> None:
    """Add a matrix to another in place."""
    for i in range(first.shape[0]):
        for j in range(first.shape[1]):
            first[i, j] += second[i, j]


@compiled
@no_type_check
def price_at(first: Matrix, second: Matrix, point: Float[np.ndarray, " 6"]) -> float:
    """The sum of two quadrics at a point."""
    total = first[DIMENSIONS, DIMENSIONS] + second[DIMENSIONS, DIMENSIONS]
    for i in range(DIMENSIONS):
        row = 2 * (first[i, DIMENSIONS] + second[i, DIMENSIONS])
        for j in range(DIMENSIONS):
            row += (first[i, j] + second[i, j]) * point[j]
        total += row * point[i]
    return total


@compiled
@no_type_check
def star(mesh: LinkedMesh, vertex: int) -> list[int]:
    """Triangles at a vertex."""
    around = [0][:0]
    corner = mesh.first_corner[vertex]
    while corner >= 0:
        if mesh.triangles[corner // 3, 0] >= 0:
            around.append(corner // 3)
        corner = mesh.next_corner[corner]
    return around


@compiled
@no_type_check
def ring(mesh: LinkedMesh, vertex: int, around: list[int]) -> list[int]:
    """Neighbours of a vertex, given the triangles at it."""
    others = [0][:0]
    for triangle in around:
        for c in range(3):
            other = mesh.triangles[triangle, c]
            if other != vertex and other not in others:
                others.append(other)
    return others


@compiled
@no_type_check
def links(mesh: LinkedMesh, gone: int, kept: int) -> bool:
    """Whether the collapse keeps the topology, and boundary vertices on the boundary."""
    around_gone, around_kept = star(mesh, gone), star(mesh, kept)
    ring_gone, ring_kept = ring(mesh, gone, around_gone), ring(mesh, kept, around_kept)
    shared = 0
    for triangle in around_gone:
        shared += triangle in around_kept
    common = 0
    for other in ring_gone:
        if other in ring_kept:
            common += 1
            if len(star(mesh, other)) == 3 and len(ring(mesh, other, star(mesh, other))) == 3:
                return False  # it would keep only two triangles, back to back
    # A boundary vertex stays on the boundary: it may only move along an edge of one triangle.
    on_rim = len(ring_gone) != len(around_gone)
    return common == shared and (shared == 1 or not on_rim)


@compiled
@no_type_check
def keeps_sound(mesh: LinkedMesh, gone: int, kept: int) -> bool:
    """Whether the collapse leaves triangles, none of them degenerate or turned over at rest."""
    moving = 0
    for triangle in star(mesh, gone):
        a, b, c = mesh.triangles[triangle]
        if kept in (a, b, c):
            continue
        moving += 1
        old, _ = normal_at(mesh.rest, a, b, c)
        a, b, c = kept if a == gone else a, kept if b == gone else b, kept if c == gone else c
        if not is_sound(mesh.rest, a, b, c, old):
            return False
    return moving > 0


@compiled
@no_type_check
def normal_at(rest: Points, a: int, b: int, c: int) -> tuple[Vector, float]:
    """Normal of a triangle, of length twice its area, and its longest edge squared."""
    first, second, third = 0.0, 0.0, 0.0
    for x in range(3):
        first += (rest[b, x] - rest[a, x]) ** 2
        second += (rest[c, x] - rest[a, x]) ** 2
        third += (rest[c, x] - rest[b, x]) ** 2
    x0, x1, x2 = rest[b, 0] - rest[a, 0], rest[b, 1] - rest[a, 1], rest[b, 2] - rest[a, 2]
    y0, y1, y2 = rest[c, 0] - rest[a, 0], rest[c, 1] - rest[a, 1], rest[c, 2] - rest[a, 2]
    normal = (x1 * y2 - x2 * y1, x2 * y0 - x0 * y2, x0 * y1 - x1 * y0)
    return normal, max(first, second, third)


@compiled
@no_type_check
def is_sound(rest: Points, a: int, b: int, c: int, reference: Vector) -> bool:
    """Whether a triangle has some height at rest, and faces the same way as the reference."""
    normal, longest = normal_at(rest, a, b, c)
    squared = normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2
    along = normal[0] * reference[0] + normal[1] * reference[1] + normal[2] * reference[2]
    return squared > (LEAST_HEIGHT * longest) ** 2 and along > 0


@compiled
@no_type_check
def collapse(mesh: LinkedMesh, gone: int, kept: int) -> None:
    """Move `gone` onto `kept`, and assign the particles around it to the remaining triangles."""
    around = star(mesh, gone)
    particles, stay = [0][:0], [0][:0]
    for triangle in around:
        particle = mesh.first_particle[triangle]
        while particle >= 0:
            particles.append(particle)
            particle = mesh.next_particle[particle]
        mesh.first_particle[triangle] = -1
        corners = mesh.triangles[triangle]
        if kept in (corners[0], corners[1], corners[2]):
            corners[0] = corners[1] = corners[2] = -1
            continue
        stay.append(triangle)
        for c in range(3):
            if corners[c] == gone:
                corners[c] = kept
                mesh.next_corner[3 * triangle + c] = -1
    # Put the corners that moved at the front of the list of `kept`.
    mesh.first_corner[gone] = -1
    for triangle in stay:
        for c in range(3):
            if mesh.triangles[triangle, c] == kept:
                mesh.next_corner[3 * triangle + c] = mesh.first_corner[kept]
                mesh.first_corner[kept] = 3 * triangle + c
    for particle in particles:
        nearest = nearest_triangle(mesh.rest, mesh.facing, particle, mesh.triangles, stay)[0]
        mesh.next_particle[particle] = mesh.first_particle[nearest]
        mesh.first_particle[nearest] = particle


@compiled
@no_type_check
def nearest_triangle(
    rest: Points, facing: Points, particle: int, corners: Triangles, candidates: list[int]
) -> tuple[int, Vector, float]:
    """The nearest of some triangles to a particle at rest, with barycentric coordinates.

    Of triangles at the same distance, one that faces the same way as the particle, if any: two
    sides of a body may coincide at rest.

    Args:
        rest: rest coordinates, shape (N, 3).
        facing: normals at the particles at rest, of any length, shape (N, 3).
        particle: id of the particle.
        corners: particle ids of all triangles, shape (M, 3).
        candidates: ids of the triangles to choose from.

    Returns:
        Triangle id, barycentric coordinates of its point nearest to the particle, and the squared
        distance to that point.
    """
    best, least, best_faces = candidates[0], np.inf, False
    weights = (1.0, 0.0, 0.0)
    for triangle in candidates:
        a, b, c = corners[triangle]
        squared, first, second = nearest_point(rest[particle], rest[a], rest[b], rest[c])
        if squared > least + SAME or (best_faces and squared > least - SAME):
            continue
        normal = normal_at(rest, a, b, c)[0]
        along = 0.0
        for x in range(3):
            along += normal[x] * facing[particle, x]
        faces = along >= 0
        if faces or squared < least - SAME:
            best, least, best_faces = triangle, squared, faces
            weights = (1.0 - first - second, first, second)
            if faces and squared < SAME:
                break
    return best, weights, least


@compiled
@no_type_check
def nearest_point(
    p: Float[np.ndarray, " 3"],
    a: Float[np.ndarray, " 3"],
    b: Float[np.ndarray, " 3"],
    c: Float[np.ndarray, " 3"],
) -> Vector:
    """Squared distance of a point from a triangle, and weights of b and c at the nearest point."""
    e00, e01, e11, d0, d1, pp = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(3):
        u, v, w = b[i] - a[i], c[i] - a[i], p[i] - a[i]
        e00, e01, e11 = e00 + u * u, e01 + u * v, e11 + v * v
        d0, d1, pp = d0 + u * w, d1 + v * w, pp + w * w
    determinant = e00 * e11 - e01 * e01
    s, t = e11 * d0 - e01 * d1, e00 * d1 - e01 * d0
    upright = determinant > THIN**2 * e00 * e11  # otherwise treated as its edges
    if upright and s >= 0 and t >= 0 and s + t <= determinant:
        s, t = s / determinant, t / determinant
        inside = pp - s * d0 - t * d1
        return max(inside, 0.0), s, t
    # Outside: the nearest point is on one of the edges.
    s = min(max(d0 / e00, 0.0), 1.0) if e00 > 0 else 0.0
    best, first, second = pp - 2 * s * d0 + s * s * e00, s, 0.0
    t = min(max(d1 / e11, 0.0), 1.0) if e11 > 0 else 0.0
    squared = pp - 2 * t * d1 + t * t * e11
    if squared < best:
        best, first, second = squared, 0.0, t
    edge = e00 - 2 * e01 + e11
    t = min(max((d1 - d0 + e00 - e01) / edge, 0.0), 1.0) if edge > 0 else 0.0
    s = 1.0 - t
    squared = pp - 2 * (s * d0 + t * d1) + s * s * e00 + 2 * s * t * e01 + t * t * e11
    if squared < best:
        best, first, second = squared, s, t
    return max(best, 0.0), first, second


@compiled
@no_type_check
def survivors(mesh: LinkedMesh) -> tuple[Triangles, Ids]:
    """Remaining triangles, shape (M, 3), and the triangle of each particle, shape (N,)."""
    count = np.sum(mesh.triangles[:, 0] >= 0)
    triangles = np.empty((count, 3), dtype=np.int64)
    owner = np.full(len(mesh.rest), -1, dtype=np.int64)
    row = 0
    for triangle in range(len(mesh.triangles)):
        if mesh.triangles[triangle, 0] < 0:
            continue
        triangles[row] = mesh.triangles[triangle]
        particle = mesh.first_particle[triangle]
        while particle >= 0:
            owner[particle] = row
            particle = mesh.next_particle[particle]
        row += 1
    return triangles, owner
