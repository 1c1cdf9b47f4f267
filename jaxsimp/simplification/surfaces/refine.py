"""Compiled: moves, flips and removals that make a model of a surface smaller and better."""

from typing import no_type_check

import numpy as np

from jaxsimp.simplification.surfaces.collapse import Ids, compiled, is_sound, normal_at
from jaxsimp.simplification.surfaces.fit import (
    Mask,
    changed,
    distances,
    fit,
    has_three,
    neighbours,
    spread,
    touching,
)
from jaxsimp.simplification.surfaces.model import Points, Sheet, SurfaceModel, Triangles

LEAST_GAIN = 1e-4  # least reduction for a change, as a fraction of the sum of squares
ROUNDING = 1e-12  # rounding, as a fraction of the goal's own sum of squares


@compiled
@no_type_check
def remove(sheet: Sheet, model: SurfaceModel, enough: float) -> tuple[SurfaceModel, int]:
    """The best model with one vertex fewer, by the collapse of an edge.

    Models are compared by their largest distance from the goal, which depends on every small part,
    then by their mean square: all distances below `enough` count as equal.

    Returns:
        The model, with -1 for removed vertices and triangles, and the removed vertex; the same
        model and -1 if no vertex can be removed.
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


@compiled
@no_type_check
def collapsed(
    sheet: Sheet, model: SurfaceModel, gone: int, kept: int, touched: Mask, shared_by: Ids
) -> tuple[SurfaceModel, bool]:
    """The model with a vertex moved onto its neighbour, and whether the result is valid."""
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


@compiled
@no_type_check
def improve(sheet: Sheet, model: SurfaceModel, dirty: Mask, steps: Ids) -> SurfaceModel:
    """Moves and flips around dirty vertices while they lower the mean square error.

    Args:
        sheet: body and goal.
        model: initial model.
        dirty: vertices to try, shape (K,); changed in place.
        steps: lengths of moves, in neighbours, longest first.
    """
    _, error = fit(model)
    for _ in range(1000):  # the error falls, so the loop ends; the limit guards against rounding
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


@compiled
@no_type_check
def best_move(
    sheet: Sheet, model: SurfaceModel, error: float, vertex: int, steps: int
) -> tuple[SurfaceModel, float]:
    """The best move of a vertex by some steps: model and error, as given if none is better."""
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


@compiled
@no_type_check
def walk(sheet: Sheet, particle: int, toward: int, steps: int) -> int:
    """The particle `steps` steps from `particle` in the direction of the neighbour `toward`.

    A boundary particle moves along the boundary, an inner one stays inside.
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


@compiled
@no_type_check
def beyond(rest: Points, particle: int, toward: int, steps: int, candidate: int) -> float:
    """Squared distance of a candidate from the point `steps` steps from `particle` to `toward`."""
    squared = 0.0
    for x in range(3):
        target = rest[particle, x] + steps * (rest[toward, x] - rest[particle, x])
        squared += (rest[candidate, x] - target) ** 2
    return squared


@compiled
@no_type_check
def best_flip(
    sheet: Sheet, model: SurfaceModel, error: float, vertex: int
) -> tuple[SurfaceModel, float]:
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


@compiled
@no_type_check
def flip(model: SurfaceModel, first: int, second: int) -> tuple[Triangles, bool]:
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


@compiled
@no_type_check
def all_sound(
    sheet: Sheet, model: SurfaceModel, vertices: Ids, triangles: Triangles, touched: Mask
) -> bool:
    """Whether no remaining touched triangle is degenerate or turned over at rest."""
    for t in range(len(triangles)):
        if touched[t] and triangles[t, 0] >= 0:
            a, b, c = model.triangles[t]
            old = model.vertices
            reference = normal_at(sheet.rest, old[a], old[b], old[c])[0]
            a, b, c = triangles[t]
            if not is_sound(sheet.rest, vertices[a], vertices[b], vertices[c], reference):
                return False
    return True
