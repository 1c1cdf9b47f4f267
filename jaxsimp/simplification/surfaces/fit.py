"""Compiled: small models of a surface, and their least-squares fit to a goal: p ≈ W q."""

from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float

from jaxsimp.simplification.surfaces.collapse import Ids, compiled, nearest_triangle
from jaxsimp.simplification.surfaces.model import Points, Sheet, SurfaceModel, Triangles

OUTSIDE_WEIGHT = 10.0  # weight of squared distances at rest, relative to those in the goal
Mask = Bool[np.ndarray, " _"]


@compiled
@no_type_check
def start(sheet: Sheet, vertices: Ids, triangles: Triangles, owner: Ids) -> SurfaceModel:
    """The model whose triangles cover the particles according to `owner`, shape (N,)."""
    weights, sums = np.zeros((len(owner), 3)), np.zeros((len(triangles), 19))
    corners = np.empty_like(triangles)
    for t in range(len(triangles)):
        for c in range(3):
            corners[t, c] = vertices[triangles[t, c]]
    for i in range(len(owner)):
        if owner[i] >= 0:
            own = [owner[i]]
            _, weights[i], outside = nearest_triangle(sheet.rest, sheet.facing, i, corners, own)
            tally(sums[owner[i]], sheet, i, weights[i], outside)
    return SurfaceModel(vertices, triangles, owner, weights, sums)


@compiled
@no_type_check
def tally(
    sums: Float[np.ndarray, " 19"],
    sheet: Sheet,
    particle: int,
    weights: Float[np.ndarray, " 3"],
    outside: float,
) -> None:
    """Add a particle to the sums of its triangle, in place: (3, 3) of W'W, (3, 3) of W'p, p'p."""
    area = sheet.area[particle]
    for r in range(3):
        scaled = area * weights[r]
        for c in range(3):
            sums[3 * r + c] += scaled * weights[c]
            sums[9 + 3 * r + c] += scaled * sheet.goal[particle, c]
        sums[18] += area * sheet.goal[particle, r] ** 2
    # Particles outside the model's outline at rest add to the error, or the outline would shrink.
    sums[18] += OUTSIDE_WEIGHT * area * outside


@compiled
@no_type_check
def fit(model: SurfaceModel) -> tuple[Points, float]:
    """Least-squares positions q, shape (K, 3), and the weighted mean square of p - W q."""
    size = len(model.vertices)
    normal, right = np.zeros((size, size)), np.zeros((size, 3))
    total = 0.0
    for t in range(len(model.triangles)):
        if model.triangles[t, 0] < 0:
            continue
        corners, sums = model.triangles[t], model.sums[t]
        for r in range(3):
            for c in range(3):
                normal[corners[r], corners[c]] += sums[3 * r + c]
                right[corners[r], c] += sums[9 + 3 * r + c]
        total += sums[18]
    return solve(normal, right, total)


@compiled
@no_type_check
def solve(
    normal: Float[np.ndarray, "K K"], right: Float[np.ndarray, "K 3"], total: float
) -> tuple[Points, float]:
    """Solution of normal q = right by Cholesky, and total - right . q, at least 0."""
    size = len(normal)
    for j in range(size):
        for k in range(j):
            for i in range(j, size):
                normal[i, j] -= normal[i, k] * normal[j, k]
        # A removed vertex has a row of zeros.
        pivot = np.sqrt(normal[j, j]) if normal[j, j] > 1e-18 else 1.0
        normal[j, j] = pivot
        for i in range(j + 1, size):
            normal[i, j] /= pivot
        for x in range(3):
            for k in range(j):
                right[j, x] -= normal[j, k] * right[k, x]
            right[j, x] /= pivot
            total -= right[j, x] ** 2
    for j in range(size - 1, -1, -1):
        for x in range(3):
            for i in range(j + 1, size):
                right[j, x] -= normal[i, j] * right[i, x]
            right[j, x] /= normal[j, j]
    return right, max(total, 0.0)


@compiled
@no_type_check
def distances(
    sheet: Sheet, model: SurfaceModel, positions: Float[np.ndarray, "K 3"]
) -> Float[np.ndarray, " N"]:
    """Distance of each particle from the model, shape (N,); 0 for a particle of no triangle."""
    result = np.zeros(len(sheet.rest))
    for i in range(len(sheet.rest)):
        if model.owner[i] < 0:
            continue
        corners, w = model.triangles[model.owner[i]], model.weights[i]
        for x in range(3):
            off = -sheet.goal[i, x]
            for r in range(3):
                off += w[r] * positions[corners[r], x]
            result[i] += off**2
        result[i] = np.sqrt(result[i])
    return result


@compiled
@no_type_check
def changed(
    sheet: Sheet, model: SurfaceModel, vertices: Ids, triangles: Triangles, touched: Mask
) -> SurfaceModel:
    """The model with other vertices and triangles, and its particles assigned again.

    Only the particles of touched triangles are assigned again, to the touched triangles that
    remain: parts of the body that coincide at rest stay apart.
    """
    corners = np.full((len(triangles), 3), -1, dtype=np.int64)
    candidates = [0][:0]
    for t in range(len(triangles)):
        if touched[t] and triangles[t, 0] >= 0:
            candidates.append(t)
            for c in range(3):
                corners[t, c] = vertices[triangles[t, c]]
    owner, weights, sums = model.owner.copy(), model.weights.copy(), model.sums.copy()
    for t in range(len(triangles)):
        if touched[t]:
            for column in range(sums.shape[1]):
                sums[t, column] = 0.0
    for i in range(len(owner)):
        if owner[i] >= 0 and touched[owner[i]]:
            owner[i], weights[i], outside = nearest_triangle(
                sheet.rest, sheet.facing, i, corners, candidates
            )
            tally(sums[owner[i]], sheet, i, weights[i], outside)
    return SurfaceModel(vertices, triangles, owner, weights, sums)


@compiled
@no_type_check
def touching(triangles: Triangles, vertex: int) -> Mask:
    """True at the triangles of a vertex, shape (M,)."""
    touched = np.zeros(len(triangles), dtype=np.bool_)
    for t in range(len(triangles)):
        for c in range(3):
            touched[t] |= triangles[t, c] == vertex
    return touched


@compiled
@no_type_check
def neighbours(triangles: Triangles, vertex: int) -> Ids:
    """Number of triangles that each vertex shares with `vertex`, shape (K,); 0 for itself."""
    shared = np.zeros(triangles.max() + 1, dtype=np.int64)
    for t in range(len(triangles)):
        a, b, c = triangles[t]
        if vertex in (a, b, c):
            shared[a] += 1
            shared[b] += 1
            shared[c] += 1
    shared[vertex] = 0
    return shared


@compiled
@no_type_check
def spread(dirty: Mask, triangles: Triangles, vertex: int) -> None:
    """Mark a vertex and its neighbours, in place."""
    for t in range(len(triangles)):
        if vertex in triangles[t]:
            for c in range(3):
                dirty[triangles[t, c]] = True


@compiled
@no_type_check
def has_three(triangles: Triangles, vertex: int) -> bool:
    """Whether an inner vertex has three triangles: one fewer would leave two, back to back."""
    around, ring = 0, 0
    for shared in neighbours(triangles, vertex):
        around += shared
        ring += shared > 0
    return around == 6 and ring == 3
