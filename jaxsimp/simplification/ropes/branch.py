"""Exact piecewise-linear fits of ropes, by branch and bound over breakpoints at particles.

Compiled by numba, in float64, on the host: the dynamic programmes of search.py seldom leave more
than a few hundred chains open. Segments and the costs of chains are defined there.
"""

from typing import no_type_check  # numba cannot compile functions wrapped in type checks

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsimp.compiling import compiler

compiled = compiler("the optimal fit of ropes")

TIE = 1e-9
"""Fits whose squared errors are this close, relative to their size, are equal."""


@compiled
@no_type_check
def settle(
    goals: Float[np.ndarray, "B N 3"],
    breakpoints: Int[np.ndarray, "B M M+1"],
    proven: Bool[np.ndarray, "B M"],
    limit: float,
    gains: Float[np.ndarray, "2 N 3"],
    stiffness: Float[np.ndarray, "2 N"],
    node_limit: int,
) -> tuple[Int[np.ndarray, " B"], Bool[np.ndarray, " B"], Float[np.ndarray, "B M"]]:
    """The smallest fit to each goal of a batch, with the best breakpoints.

    Args:
        goals: shape (B, N, 3), metres, centred.
        breakpoints: breakpoints of a fit of each size 2, 3, ..., M + 1, shape (B, M, M + 1), as
            in `RopeFits`; changed in place to smaller and better fits.
        proven: whether a proof exists that no fit of a size is below `limit`, shape (B, M).
        limit: squared error that a fit must be below, square metres.
        gains: `regression_gains` of segments, shape (2, N, 3).
        stiffness: `segment_stiffness`, shape (2, N).
        node_limit: largest number of chains evaluated for one goal and size.

    Returns:
        Index of the size of the smallest fit, M if there is none, shape (B,); whether a proof
        exists that no smaller fit is below `limit` and no fit of this size is better, shape (B,);
        and squared errors of the fits of all sizes, square metres, shape (B, M).
    """
    batch, most = breakpoints.shape[:2]
    places, certified = np.zeros(batch, np.int64), np.ones(batch, np.bool_)
    costs = np.zeros((batch, most))
    for index in range(batch):
        points, fits, cost = goals[index], breakpoints[index], costs[index]
        lines = _regression_lines(points, gains)
        bounds = _suffix_bounds(points, lines, stiffness, most)
        for row in range(most):
            cost[row] = _cost(points, lines, stiffness, fits[row, : row + 2])
        place = 0
        while place < most and cost[place] >= limit:
            place += 1
        finished = True
        while place > 0 and not proven[index, place - 1]:
            fit = fits[place - 1, : place + 1]
            least, finished = _branch(
                points, lines, stiffness, bounds, fit, cost[place - 1], limit, node_limit
            )
            if least >= limit:
                break
            place -= 1
            cost[place] = least
        certified[index] = finished
        if place < most:
            # Of equal fits take the first in order, independent of the fit known before.
            fit, least = fits[place, : place + 2], cost[place]
            below = min(limit, least + TIE * (least + TIE * limit))
            cost[place], finished = _branch(
                points, lines, stiffness, bounds, fit, least, below, node_limit
            )
            certified[index] &= finished
        places[index] = place
    return places, certified, costs


@compiled
@no_type_check
def _branch(
    points: Float[np.ndarray, "N 3"],
    lines: Float[np.ndarray, "N N 7"],
    stiffness: Float[np.ndarray, "2 N"],
    bounds: Float[np.ndarray, "M+1 N"],
    fit: Int[np.ndarray, " K"],
    least: float,
    below: float,
    node_limit: int,
) -> tuple[float, bool]:
    """Search, in order of breakpoints, for the best fit whose squared error is below `below`.

    Args:
        points: shape (N, 3).
        lines: `_regression_lines`.
        stiffness: shape (2, N).
        bounds: `_suffix_bounds`.
        fit: breakpoints of the fit known so far, shape (K,); changed in place to a better one.
        least: squared error of `fit`.
        below: squared error that a fit must be below; slightly above `least` to accept equal fits.
        node_limit: largest number of chains evaluated.

    Returns:
        The squared error of `fit`, and whether the search was complete.
    """
    size, last = len(fit), len(points) - 1
    ends, chains = np.zeros(size, np.int64), np.zeros((size, 5))
    _start(points, chains[0])
    depth, nodes = 1, 0
    while depth > 0:
        left = size - 1 - depth  # segments still to add
        ends[depth] = last if left == 0 else ends[depth] + 1
        if ends[depth] > last - left:
            depth -= 1
            continue
        nodes += 1
        if nodes > node_limit:
            return least, False
        start, end = ends[depth - 1], ends[depth]
        _extend(lines[start, end], stiffness[:, end - start], chains[depth - 1], chains[depth])
        if left == 0:
            cost = _close(chains[depth], points[last])
            if cost < below:
                fit[:] = ends
                least, below = cost, cost * (1 - TIE)
            depth -= 1
        elif chains[depth, 1] + bounds[left, end] < below:
            ends[depth + 1] = end
            depth += 1
    return least, True


@compiled
@no_type_check
def _cost(
    points: Float[np.ndarray, "N 3"],
    lines: Float[np.ndarray, "N N 7"],
    stiffness: Float[np.ndarray, "2 N"],
    fit: Int[np.ndarray, " K"],
) -> float:
    """Squared error of the best fit with breakpoints at the particles `fit`."""
    chain, longer = np.zeros(5), np.zeros(5)
    _start(points, chain)
    for place in range(1, len(fit)):
        start, end = fit[place - 1], fit[place]
        _extend(lines[start, end], stiffness[:, end - start], chain, longer)
        chain[:] = longer
    return _close(chain, points[-1])


# A chain's cost is a |x - c|² + e where it ends at x: its five numbers are a, e and c.


@compiled
@no_type_check
def _start(points: Float[np.ndarray, "N 3"], chain: Float[np.ndarray, " 5"]) -> None:
    """Write the chain without a segment: half the weight of the first particle."""
    chain[0], chain[1] = 0.5, 0.0
    chain[2:] = points[0]


@compiled
@no_type_check
def _extend(
    line: Float[np.ndarray, " 7"],
    stiffness: Float[np.ndarray, " 2"],
    chain: Float[np.ndarray, " 5"],
    longer: Float[np.ndarray, " 5"],
) -> None:
    """Write into `longer` the chain with one more segment."""
    a, (alpha, beta) = chain[0], stiffness
    share = a / (alpha * (a + alpha) - beta * beta)
    squared = 0.0
    for axis in range(3):
        off = chain[2 + axis] - line[1 + axis]
        squared += off * off
        longer[2 + axis] = line[4 + axis] - share * beta * off
    longer[0] = alpha - beta * beta / (a + alpha)
    longer[1] = chain[1] + line[0] + share * (alpha * alpha - beta * beta) * squared


@compiled
@no_type_check
def _close(chain: Float[np.ndarray, " 5"], last: Float[np.ndarray, " 3"]) -> float:
    """Squared error of a chain, with the second half of the last particle's weight."""
    squared = 0.0
    for axis in range(3):
        squared += (chain[2 + axis] - last[axis]) ** 2
    return chain[1] + 0.5 * chain[0] / (0.5 + chain[0]) * squared


@compiled
@no_type_check
def _regression_lines(
    points: Float[np.ndarray, "N 3"], gains: Float[np.ndarray, "2 N 3"]
) -> Float[np.ndarray, "N N 7"]:
    """Squared error, first and last point of the regression line of particles i..j, by [i, j]."""
    count = len(points)
    lines = np.zeros((count, count, 7))
    for first in range(count - 1):
        start, slope, cost = points[first].copy(), points[first + 1] - points[first], 0.0
        lines[first, first + 1, 1:4], lines[first, first + 1, 4:] = start, points[first + 1]
        for time in range(2, count - first):
            line, between, last = lines[first, first + time], gains[0, time], gains[1, time]
            squared = 0.0
            for axis in range(3):
                off = points[first + time, axis] - start[axis] - slope[axis] * time
                squared += off * off
                line[1 + axis] = start[axis] + last[0] * off
                line[4 + axis] = line[1 + axis] + (slope[axis] + last[1] * off) * time
                start[axis] += between[0] * off
                slope[axis] += between[1] * off
            line[0] = cost + last[2] * squared
            cost += between[2] * squared
    return lines


@compiled
@no_type_check
def _suffix_bounds(
    points: Float[np.ndarray, "N 3"],
    lines: Float[np.ndarray, "N N 7"],
    stiffness: Float[np.ndarray, "2 N"],
    most: int,
) -> Float[np.ndarray, "M+1 N"]:
    """Lower bound on the cost of m segments from a particle to the last, by [m, particle].

    The bound lets segments be disconnected, so each costs no more than in a chain.
    """
    count = len(points)
    bounds = np.full((most + 1, count), np.inf)
    chain = np.zeros(5)
    for first in range(count - 1):
        alpha, beta = stiffness[:, count - 1 - first]
        # The segment alone, its first end free.
        chain[0], chain[1] = alpha - beta * beta / alpha, lines[first, -1, 0]
        chain[2:] = lines[first, -1, 4:]
        bounds[1, first] = _close(chain, points[-1])
    for segments in range(2, most + 1):
        for first in range(count - 1):
            for end in range(first + 1, count - 1):
                cost = lines[first, end, 0] + bounds[segments - 1, end]
                bounds[segments, first] = min(bounds[segments, first], cost)
    return bounds
