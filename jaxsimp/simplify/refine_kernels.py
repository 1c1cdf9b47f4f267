"""Compiled: a small surface model made smaller and better by moves, flips and removals.

A model has vertices that are particles, and triangles of them that cover the body at rest.
Its positions are the least-squares fit to the goal of all particles: p ≈ W q.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from jaxsimp.simplify.collapse_kernels import is_sound, nearest_triangle, normal_at

OUTSIDE_WEIGHT = 10.0  # of squared distances at rest, relative to those in the goal
LEAST_GAIN = 1e-4  # of the sum of squares, for a change to be made
ROUNDING = 1e-12  # of the goal's own sum of squares: differences below it are rounding


class Sheet(NamedTuple):
    """A body and its goal: what models are compared with."""

    rest: np.ndarray  # (N, 3), scaled
    goal: np.ndarray  # (N, 3), scaled and centred
    area: np.ndarray  # (N,), at rest: weight of each particle, summing to 1
    first: np.ndarray  # (N + 1,): particle i has the neighbours other[first[i] : first[i + 1]]
    other: np.ndarray  # (2 E,)
    rim: np.ndarray  # (N, 2): neighbours along the boundary; -1 for a particle inside


class Model(NamedTuple):
    """A piecewise-linear surface."""

    vertices: np.ndarray  # (K,) particle ids; -1 for one that is gone
    triangles: np.ndarray  # (M, 3) indices into vertices; -1 for one that is gone
    owner: np.ndarray  # (N,) triangle of each particle; -1 for a particle of no triangle
    weights: np.ndarray  # (N, 3) barycentric coordinates in it
    sums: np.ndarray  # (M, 19) of each triangle: its part of the normal equations, see `tally`


@njit(cache=True, nogil=True)
def start(sheet, vertices, triangles, owner):
    """The model whose triangles cover the particles as given by `owner`, shape (N,)."""
    weights, sums = np.zeros((len(owner), 3)), np.zeros((len(triangles), 19))
    corners = np.empty_like(triangles)
    for t in range(len(triangles)):
        for c in range(3):
            corners[t, c] = vertices[triangles[t, c]]
    for i in range(len(owner)):
        if owner[i] >= 0:
            own = [owner[i]]
            _, weights[i], outside = nearest_triangle(sheet.rest, i, corners, own)
            tally(sums[owner[i]], sheet, i, weights[i], outside)
    return Model(vertices, triangles, owner, weights, sums)


@njit(cache=True, nogil=True)
def tally(sums, sheet, particle, weights, outside):
    """Add a particle to the sums of its triangle, in place: (3, 3) of W'W, (3, 3) of W'p, p'p."""
    area = sheet.area[particle]
    for r in range(3):
        scaled = area * weights[r]
        for c in range(3):
            sums[3 * r + c] += scaled * weights[c]
            sums[9 + 3 * r + c] += scaled * sheet.goal[particle, c]
        sums[18] += area * sheet.goal[particle, r] ** 2
    # What the model leaves uncovered is an error too, or the outline would shrink.
    sums[18] += OUTSIDE_WEIGHT * area * outside


@njit(cache=True, nogil=True)
def fit(model):
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


@njit(cache=True, nogil=True)
def solve(normal, right, total):
    """Solution of normal q = right by Cholesky, and total - right . q, at least 0."""
    size = len(normal)
    for j in range(size):
        for k in range(j):
            for i in range(j, size):
                normal[i, j] -= normal[i, k] * normal[j, k]
        # A vertex that is gone has a row of zeros.
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


@njit(cache=True, nogil=True)
def distances(sheet, model, positions):
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


@njit(cache=True, nogil=True)
def changed(sheet, model, vertices, triangles, touched):
    """The model with other vertices and triangles, its particles covered anew.

    Only particles of the touched triangles are, by those of them that are left: parts of the
    body that lie on each other at rest stay apart.
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
            owner[i], weights[i], outside = nearest_triangle(sheet.rest, i, corners, candidates)
            tally(sums[owner[i]], sheet, i, weights[i], outside)
    return Model(vertices, triangles, owner, weights, sums)


@njit(cache=True, nogil=True)
def all_sound(sheet, model, vertices, triangles, touched):
    """No touched triangle that is left is degenerate or turned over at rest."""
    for t in range(len(triangles)):
        if touched[t] and triangles[t, 0] >= 0:
            a, b, c = model.triangles[t]
            old = model.vertices
            reference = normal_at(sheet.rest, old[a], old[b], old[c])[0]
            a, b, c = triangles[t]
            if not is_sound(sheet.rest, vertices[a], vertices[b], vertices[c], reference):
                return False
    return True


@njit(cache=True, nogil=True)
def touching(triangles, vertex):
    """True at the triangles of a vertex, shape (M,)."""
    touched = np.zeros(len(triangles), dtype=np.bool_)
    for t in range(len(triangles)):
        for c in range(3):
            touched[t] |= triangles[t, c] == vertex
    return touched


@njit(cache=True, nogil=True)
def neighbours(triangles, vertex):
    """Number of triangles that each vertex shares with one, shape (K,); 0 with itself."""
    shared = np.zeros(triangles.max() + 1, dtype=np.int64)
    for t in range(len(triangles)):
        a, b, c = triangles[t]
        if vertex in (a, b, c):
            shared[a] += 1
            shared[b] += 1
            shared[c] += 1
    shared[vertex] = 0
    return shared


@njit(cache=True, nogil=True)
def walk(sheet, particle, toward, steps):
    """The particle that lies from `particle` in the direction of a neighbour, `steps` as far.

    A particle of the boundary goes along it, one inside stays inside.
    """
    before = particle
    if sheet.rim[particle, 0] >= 0:
        for _ in range(steps):
            ahead = sheet.rim[toward, 0]
            before, toward = toward, (ahead if ahead != before else sheet.rim[toward, 1])
        return before
    least = beyond(sheet.rest, particle, toward, steps, particle)
    last, found = particle, True
    while found:
        found = False
        for n in range(sheet.first[before], sheet.first[before + 1]):
            candidate = sheet.other[n]
            distance = beyond(sheet.rest, particle, toward, steps, candidate)
            if distance < least and sheet.rim[candidate, 0] < 0:
                last, least, found = candidate, distance, True
        before = last
    return last


@njit(cache=True, nogil=True)
def beyond(rest, particle, toward, steps, candidate):
    """Squared distance of a candidate from where `steps` steps lead from particle `toward`."""
    squared = 0.0
    for x in range(3):
        target = rest[particle, x] + steps * (rest[toward, x] - rest[particle, x])
        squared += (rest[candidate, x] - target) ** 2
    return squared


@njit(cache=True, nogil=True)
def best_move(sheet, model, error, vertex, steps):
    """The best move of a vertex by some steps: the model and its error, or what was given."""
    touched = touching(model.triangles, vertex)
    best = model
    particle = model.vertices[vertex]
    on_rim = sheet.rim[particle, 0] >= 0
    for n in range(sheet.first[particle], sheet.first[particle + 1]):
        toward = sheet.other[n]
        if on_rim and toward != sheet.rim[particle, 0] and toward != sheet.rim[particle, 1]:
            continue
        goal = walk(sheet, particle, toward, steps)
        if goal in model.vertices:
            continue
        vertices = model.vertices.copy()
        vertices[vertex] = goal
        if all_sound(sheet, model, vertices, model.triangles, touched):
            trial = changed(sheet, model, vertices, model.triangles, touched)
            trial_error = fit(trial)[1]
            if trial_error < (1 - LEAST_GAIN) * error - ROUNDING:
                best, error = trial, trial_error
    return best, error


@njit(cache=True, nogil=True)
def flip(model, first, second):
    """Triangles after the edge that two of them share is replaced by the other diagonal."""
    triangles = model.triangles.copy()
    for c in range(3):
        apex = triangles[first, c]
        b, a = triangles[first, (c + 1) % 3], triangles[first, (c + 2) % 3]
        for d in range(3):
            if triangles[second, (d + 1) % 3] == a and triangles[second, (d + 2) % 3] == b:
                other = triangles[second, d]
                triangles[first, 0], triangles[first, 1], triangles[first, 2] = apex, b, other
                triangles[second, 0], triangles[second, 1], triangles[second, 2] = apex, other, a
                return triangles, neighbours(model.triangles, apex)[other] == 0
    return triangles, False


@njit(cache=True, nogil=True)
def best_flip(sheet, model, error, vertex):
    """The best flip of an edge of a triangle at a vertex: the model and its error."""
    at_vertex = touching(model.triangles, vertex)
    best = model
    rest, old = sheet.rest, model.vertices
    for first in range(len(at_vertex)):
        for second in range(len(at_vertex)):
            if first == second or not at_vertex[first] or (at_vertex[second] and second < first):
                continue
            triangles, possible = flip(model, first, second)
            if not possible:
                continue
            a, b, c = model.triangles[first]
            d, e, f = model.triangles[second]
            one = normal_at(rest, old[a], old[b], old[c])[0]
            two = normal_at(rest, old[d], old[e], old[f])[0]
            up = (one[0] + two[0], one[1] + two[1], one[2] + two[2])
            a, b, c = triangles[first]
            d, e, f = triangles[second]
            sound = is_sound(rest, old[a], old[b], old[c], up)
            if not (sound and is_sound(rest, old[d], old[e], old[f], up)):
                continue
            touched = np.zeros(len(at_vertex), dtype=np.bool_)
            touched[first] = touched[second] = True
            trial = changed(sheet, model, old, triangles, touched)
            trial_error = fit(trial)[1]
            if trial_error < (1 - LEAST_GAIN) * error - ROUNDING:
                best, error = trial, trial_error
    return best, error


@njit(cache=True, nogil=True)
def improve(sheet, model, dirty, steps):
    """Moves and flips around dirty vertices while they lower the mean square error.

    Args:
        sheet: body and goal.
        model: where to start.
        dirty: vertices to look at, shape (K,); changed in place.
        steps: lengths of moves, in neighbours, longest first.
    """
    _, error = fit(model)
    for _ in range(1000):  # the error falls, so it ends; this is a guard against rounding
        if True not in dirty:
            break
        for vertex in range(len(dirty)):
            if not dirty[vertex]:
                continue
            dirty[vertex] = False
            better, lower = best_flip(sheet, model, error, vertex)
            for step in steps:
                if lower < error:
                    break
                better, lower = best_move(sheet, model, error, vertex, step)
            if lower < error:
                # A move changes the triangles of the vertex, a flip those of its ring.
                spread(dirty, model.triangles, vertex)
                spread(dirty, better.triangles, vertex)
                model, error = better, lower
    return model


@njit(cache=True, nogil=True)
def spread(dirty, triangles, vertex):
    """Mark a vertex and its neighbours, in place."""
    for t in range(len(triangles)):
        if vertex in triangles[t]:
            for c in range(3):
                dirty[triangles[t, c]] = True


@njit(cache=True, nogil=True)
def remove(sheet, model, enough):
    """The best model with a vertex less: one of its edges is collapsed.

    Models are compared by their largest distance from the goal, which sees every small part,
    then by their mean square: all distances below `enough` count as equal.

    Returns:
        The model, where vertices and triangles that are gone are -1, and the vertex; -1 and the
        same model if none can be removed.
    """
    best, best_gone = model, -1
    best_largest, best_error = np.inf, np.inf
    for gone in range(len(model.vertices)):
        shared_by = neighbours(model.triangles, gone)
        touched = touching(model.triangles, gone)
        on_rim = 1 in shared_by
        for kept in range(len(shared_by)):
            if shared_by[kept] == 0 or (on_rim and shared_by[kept] != 1):
                continue
            trial, possible = collapsed(sheet, model, gone, kept, touched, shared_by)
            if not possible:
                continue
            positions, error = fit(trial)
            largest = max(enough, np.max(distances(sheet, trial, positions)))
            if largest < best_largest - 1e-9 or (
                largest < best_largest + 1e-9 and error < best_error - ROUNDING
            ):
                best, best_gone, best_largest, best_error = trial, gone, largest, error
    return best, best_gone


@njit(cache=True, nogil=True)
def collapsed(sheet, model, gone, kept, touched, shared_by):
    """The model with a vertex moved onto its neighbour, and whether that is a model."""
    common = neighbours(model.triangles, kept)
    both = 0
    for vertex in range(len(shared_by)):
        if shared_by[vertex] > 0 and common[vertex] > 0:
            both += 1
            if has_three(model.triangles, vertex):
                return model, False
    triangles = model.triangles.copy()
    left = 0
    for t in range(len(triangles)):
        if touched[t] and kept in triangles[t]:
            triangles[t, 0] = triangles[t, 1] = triangles[t, 2] = -1
        elif touched[t]:
            left += 1
            for c in range(3):
                if triangles[t, c] == gone:
                    triangles[t, c] = kept
    vertices = model.vertices.copy()
    vertices[gone] = -1
    sound = left > 0 and both == shared_by[kept]
    if not (sound and all_sound(sheet, model, vertices, triangles, touched)):
        return model, False
    return changed(sheet, model, vertices, triangles, touched), True


@njit(cache=True, nogil=True)
def has_three(triangles, vertex):
    """A vertex inside has three triangles: one fewer, and the two would lie back to back."""
    around, ring = 0, 0
    for shared in neighbours(triangles, vertex):
        around += shared
        ring += shared > 0
    return around == 6 and ring == 3
