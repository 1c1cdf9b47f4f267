"""Data of the compiled functions of the rest-aware collapse: plain tuples of arrays."""

from typing import NamedTuple

from jaxtyping import Float, Int
from numpy import ndarray

Points = Float[ndarray, "N 3"]
Triangles = Int[ndarray, "M 3"]
Vector = tuple[float, float, float]


class Sheet(NamedTuple):
    """A body and its goal, in units of the body's size; models are compared with these.

    Attributes:
        rest: rest coordinates, shape (N, 3), centred.
        facing: normals at rest, of any length, shape (N, 3).
        goal: goal positions, shape (N, 3), centred.
        area: area of each particle at rest, its weight, shape (N,), summing to 1.
        first: particle i has the neighbours `other[first[i] : first[i + 1]]`, shape (N + 1,).
        other: particle ids, shape (2 E,).
        rim: neighbours along the boundary, shape (N, 2); -1 for a particle inside.
    """

    rest: Points
    facing: Points
    goal: Points
    area: Float[ndarray, " N"]
    first: Int[ndarray, " N+1"]
    other: Int[ndarray, " 2*E"]
    rim: Int[ndarray, "N 2"]


class SurfaceModel(NamedTuple):
    """A piecewise-linear surface: triangles of particles that cover the body at rest.

    Attributes:
        vertices: particle ids, shape (K,); -1 for a removed one.
        triangles: indices into `vertices`, shape (M, 3); -1 for a removed one.
        owner: triangle of each particle, shape (N,); -1 for a particle of no triangle.
        weights: barycentric coordinates of each particle in its triangle, shape (N, 3).
        sums: sums over the particles of each triangle, shape (M, 19): their part of the normal
            equations of the fit, see `tally`.
    """

    vertices: Int[ndarray, " K"]
    triangles: Triangles
    owner: Int[ndarray, " N"]
    weights: Points
    sums: Float[ndarray, "M 19"]


class LinkedMesh(NamedTuple):
    """A triangle mesh under decimation; its arrays change in place.

    Corner `c` of triangle `f` is number `3 f + c`. The corners of a vertex are a linked list, and
    so are the particles of a triangle; -1 ends a list.

    Attributes:
        rest: rest coordinates, shape (N, 3).
        facing: normals at rest, of any length, shape (N, 3).
        triangles: particle ids, shape (F, 3); -1 for a removed one.
        first_corner: first corner of each vertex, shape (N,).
        next_corner: next corner of the same vertex, shape (3 F,).
        first_particle: first particle of each triangle, shape (F,).
        next_particle: next particle of the same triangle, shape (N,).
    """

    rest: Points
    facing: Points
    triangles: Triangles
    first_corner: Int[ndarray, " N"]
    next_corner: Int[ndarray, " 3*F"]
    first_particle: Int[ndarray, " F"]
    next_particle: Int[ndarray, " N"]
