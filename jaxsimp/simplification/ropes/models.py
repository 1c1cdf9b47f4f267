"""Ropes: checks, search over sizes and results that all methods for ropes share."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsimp.bodies import Body
from jaxsimp.bodies.size import LARGEST
from jaxsimp.checks import require_count, require_number
from jaxsimp.goals import as_goal
from jaxsimp.simplification.key_points import (
    SIZES_BEYOND,
    SMALLEST_TOLERANCE,
    FitStatus,
    KeyPoints,
)
from jaxsimp.simplification.ropes.fit import hat_weights

NO_SIZE = -1
ErrorFn = Callable[[int, np.ndarray], np.ndarray]
ModelFn = Callable[[int, np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]


def check_ropes(
    body: Body,
    goals: Float[np.ndarray, "B N 3"],
    tolerance: float | None,
    max_size: int | None,
    default_max_size: int,
) -> tuple[Float[np.ndarray, "B N 3"], float, list[int]]:
    """Goals as floats, the tolerance, and the sizes to try.

    Args:
        body: a rope.
        goals: goal positions, shape (B, N, 3), metres.
        tolerance: metres; 0.015 of the rope's length by default.
        max_size: largest number of key points; at most N are tried.
        default_max_size: default of `max_size`.

    Raises:
        ValueError: if the body has triangles, a goal does not fit the body, the tolerance is
            not above zero, or `max_size` is below 2.
    """
    if len(body.faces):
        raise ValueError(f"the {body.name} has {len(body.faces)} triangles; give a rope")
    tolerance = 0.015 * body.size if tolerance is None else tolerance
    max_size = default_max_size if max_size is None else max_size
    tolerance = require_number("tolerance", tolerance, SMALLEST_TOLERANCE, LARGEST, "m")
    max_size = require_count("max_size", max_size, 2)
    checked = np.zeros((len(goals), *body.rest.shape))
    for index, goal in enumerate(goals):
        checked[index] = as_goal(body, goal)
    return checked, tolerance, list(range(2, min(max_size, body.num_particles) + 1))


def errors_by_size(
    error_fn: ErrorFn, sizes: list[int], tolerance: float, count: int
) -> tuple[Float[np.ndarray, "B M"], Int[np.ndarray, " B"]]:
    """`smallest_fit` of a batch: errors of the sizes tried, and the first size that fits.

    Args:
        error_fn: errors of the models of a size, metres, for the goals with given indices.
        sizes: in ascending order.
        tolerance: metres.
        count: number of goals, `B`.

    Returns:
        Errors, NaN where a size was not tried; and for each goal the column of the first size that
        fits, `NO_SIZE` where none fits.
    """
    errors = np.full((count, len(sizes)), np.nan)
    since_fit = np.zeros(count, dtype=int)
    for column, size in enumerate(sizes):
        wanted = np.flatnonzero(since_fit <= SIZES_BEYOND)
        if not wanted.size:
            break
        errors[wanted, column] = error_fn(size, wanted)
        since_fit[wanted] += (since_fit[wanted] > 0) | (errors[wanted, column] < tolerance)
    fits = errors < tolerance
    return errors, np.where(fits.any(axis=1), fits.argmax(axis=1), NO_SIZE)


def rope_models(
    goals: Float[np.ndarray, "B N 3"],
    sizes: list[int],
    errors: Float[np.ndarray, "B M"],
    columns: Int[np.ndarray, " B"],
    model_fn: ModelFn,
    certified: Bool[np.ndarray, " B"],
    *,
    tolerance: float,
    method: str,
) -> list[KeyPoints]:
    """Key points of goals whose sizes are chosen.

    Args:
        goals: shape (B, N, 3), metres.
        sizes: numbers of key points, `M` of them.
        errors: by size, metres, NaN where a size was not tried.
        columns: column of the size that was chosen, `NO_SIZE` where none fits.
        model_fn: particles, breakpoints and positions, shapes (B, K), (B, K) and (B, K, 3), of
            the models of a size, for the goals with given indices.
        certified: whether a proof exists that no smaller model fits.
        tolerance: metres.
        method: name of the method that found the models.
    """
    tried = np.sum(~np.isnan(errors), axis=1)
    shown = np.where(columns == NO_SIZE, tried - 1, columns)
    models: dict[int, KeyPoints] = {}
    for column in np.unique(shown):
        size, indices = sizes[column], np.flatnonzero(shown == column)
        particles, breakpoints, positions = model_fn(size, indices)
        fitted = hat_weights(goals.shape[1], breakpoints) @ positions
        distances = np.linalg.norm(fitted - goals[indices], axis=2)
        elements = np.stack([np.arange(size - 1), np.arange(1, size)], axis=1)
        for row, index in enumerate(indices.tolist()):
            rms = float(np.sqrt(np.mean(distances[row] ** 2)))
            # The error that is reported decides, too: that of the search may differ by rounding.
            fits = columns[index] != NO_SIZE and rms < tolerance
            models[index] = KeyPoints(
                particles=particles[row],
                positions=positions[row],
                elements=elements,
                num_particles=goals.shape[1],
                method=method,
                sizes=tuple(sizes[: tried[index]]),
                errors=tuple(errors[index, : tried[index]].tolist()),
                tolerance=tolerance,
                max_error=float(distances[row].max()),
                rms_error=rms,
                certified=bool(certified[index]),
                status=FitStatus.FITS if fits else FitStatus.NO_FIT,
            )
    return [models[index] for index in range(len(goals))]


def with_infeasible(
    models: list[KeyPoints],
    possible: Bool[np.ndarray, " B"],
    num_particles: int,
    *,
    tolerance: float,
    method: str,
) -> list[KeyPoints]:
    """Models of the feasible goals, and models without key points for the other goals."""
    nothing = KeyPoints(
        particles=np.zeros(0, dtype=int),
        positions=np.zeros((0, 3)),
        elements=np.zeros((0, 2), dtype=int),
        num_particles=num_particles,
        method=method,
        sizes=(),
        errors=(),
        tolerance=tolerance,
        max_error=np.inf,
        rms_error=np.inf,
        status=FitStatus.INFEASIBLE,
    )
    found = iter(models)
    return [next(found) if each else nothing for each in possible]
