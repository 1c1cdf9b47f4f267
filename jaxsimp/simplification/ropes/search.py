"""Piecewise-linear fits of ropes with every number of key points, by dynamic programming.

A fit is a chain of segments from particle to particle. The inner particles of a segment weigh 1,
its two ends 1/2 each: the other half belongs to the neighbouring segment. With the ends of the
segment at x and y its squared error is then

    C + α |x - X|² + 2 β (x - X)·(y - Y) + α |y - Y|²

where X and Y are the ends of the segment's own regression line, C is the error of that line,
and α and β depend only on the number of particles. The cost of the best chain up to a particle is
a|x - c|² + e as a function of the chain's end x, and keeps this form when a segment is added. No
term is subtracted, so float32 suffices. See `_extend`.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

ROUNDING = 1e-7
"""Safety margin of the bounds against float32, as a fraction of the sum of squares."""
BOUND_ROUNDING = 1e-4
"""Largest relative excess of a bound in float32 over the exact one: a generous value."""
CHUNK = 32
"""Number of goals per chunk, so that their tables of segments stay in the processor's cache."""


class RopeFits(NamedTuple):
    """Fits of a batch of goals with 2, 3, ..., M + 1 key points.

    Attributes:
        bounds: lower bound on the error of fits with breakpoints at particles, root mean square in
            metres, shape (B, M).
        free_bounds: the same with breakpoints anywhere, also between particles, shape (B, M).
        errors: error of the fit found, root mean square in metres, shape (B, M).
        breakpoints: its breakpoints, as particles, shape (B, M, M + 1); the last particle is
            repeated where a fit has fewer.
    """

    bounds: Float[Array | np.ndarray, "B M"]
    free_bounds: Float[Array | np.ndarray, "B M"]
    errors: Float[Array | np.ndarray, "B M"]
    breakpoints: Int[Array | np.ndarray, "B M M+1"]


def search_batch(goals: Float[np.ndarray, "B N 3"], max_size: int) -> RopeFits:
    """`search` for a batch of any number of goals, anywhere in space.

    Args:
        goals: shape (B, N, 3), metres.
        max_size: largest number of key points, 2 to N.
    """
    return RopeFits(*(np.asarray(each)[: len(goals)] for each in search(fill(goals), max_size)))


def fill(goals: Float[np.ndarray, "B N 3"]) -> Float[np.ndarray, "B2 N 3"]:
    """Goals, centred, in a batch whose size is a power of two: few batch sizes are compiled.

    Centred before the conversion to float32, which would round coordinates far from the origin.

    Args:
        goals: shape (B, N, 3), metres.
    """
    filled = np.zeros((1 << max(len(goals) - 1, 0).bit_length(), *goals.shape[1:]))
    filled[: len(goals)] = goals - goals.mean(axis=1, keepdims=True)
    return filled


def ruled_out(search: RopeFits, tolerance: float) -> Bool[np.ndarray, "B M"]:
    """Whether the bounds prove that no fit of a size is below the tolerance, shape (B, M).

    Entry [:, K - 3] thus proves, without branch and bound, that a model of K key points is the
    smallest.

    Args:
        search: the fits of a batch.
        tolerance: root mean square, metres.
    """
    bounds = np.maximum(search.bounds, search.free_bounds)
    return bounds * (1 - BOUND_ROUNDING) >= tolerance


@partial(jax.jit, static_argnames="max_size")
def search(goals: Float[Array | np.ndarray, "B N 3"], max_size: int) -> RopeFits:
    """Good fits of each number of key points up to `max_size`, and lower bounds on all fits.

    The fits keep, for every particle, the one cheapest chain that ends there. This is an
    approximation, since another chain may be cheaper with the next segment; it is seldom far off,
    and `branch` makes it exact.

    The bounds keep, for every particle, a paraboloid below the costs of all chains that end
    there. The free bounds drop the condition that segments meet: the particles of any fit form
    consecutive runs, one for each segment, and no segment is nearer to its run than the run's
    own regression line.

    Args:
        goals: shape (B, N, 3), metres, centred.
        max_size: largest number of key points, 2 to N.
    """
    one = partial(_search_one, max_size=max_size)
    return jax.lax.map(one, jnp.asarray(goals), batch_size=CHUNK)


def _search_one(points: Array, max_size: int) -> RopeFits:
    count, most = len(points), max_size - 1
    points = points.T  # x, y, z first: sums over a last axis of length three are slow
    runs, _, _ = _line_table(points, regression_gains(count, 1.0, 1.0))
    # A run may be a single particle; a segment has two.
    free = _cheapest_runs(jnp.where(jnp.eye(count, dtype=bool), 0.0, runs), most)
    segments = _segment_table(points)
    lowest, _ = _chains(points, segments, most, below_all=True)
    costs, starts = _chains(points, segments, most, below_all=False)
    bounds, free, errors = (jnp.sqrt(each / count) for each in (lowest, free, costs))
    return RopeFits(bounds, free, errors, _trace_back(starts))


def regression_gains(count: int, first: float, last: float) -> Float[np.ndarray, "2 N 3"]:
    """Gains of recursive least squares for a line, at times 0, 1, 2, ...

    A point with residual `r` at time t adds gain[0] r to the line's value at time 0, gain[1] r to
    its slope, and gain[2] r² to its squared error.

    Args:
        count: number of points.
        first: weight of the first point.
        last: weight of the last point; inner points weigh 1.

    Returns:
        Gains at time t, for an inner point ([0]) and for the last one ([1]).
    """
    gains = np.zeros((2, count, 3))
    normal = np.array([[first + 1.0, 1.0], [1.0, 1.0]])  # of the first two points
    for time in range(2, count):
        row = np.array([1.0, time])
        direction = np.linalg.solve(normal, row)
        for gain, weight in zip(gains[:, time], (1.0, last), strict=True):
            gain[2] = weight / (1.0 + weight * (row @ direction))
            gain[:2] = gain[2] * direction
        normal += np.outer(row, row)
    return gains


def segment_stiffness(count: int) -> Float[np.ndarray, "2 N"]:
    """α and β of segments that are 1, 2, ..., N - 1 particles long, shape (2, N).

    α is the sum of w (1 - s)² and β that of w s (1 - s) over the segment's particles, at
    s = 0, 1 / n, ..., 1, with the weights w of 1/2, 1, ..., 1, 1/2. Length 0 has no segment.
    """
    n = np.maximum(np.arange(count), 1.0)
    alpha, beta = n / 3.0 + 1.0 / (6.0 * n), (n - 1.0 / n) / 6.0
    return np.stack([alpha, beta])


def _line_table(points: Array, gains: np.ndarray) -> tuple[Array, Array, Array]:
    """Regression lines of all runs of particles i..j: their errors and ends, by [i, j].

    The error is infinite where j <= i. The lines of all starts grow in parallel, point by point.
    """
    count = points.shape[1]

    def grow(line: tuple, row: tuple) -> tuple[tuple, tuple]:
        start, slope, cost = line
        time, between, last = row
        off = jnp.roll(points, -time, axis=1) - start - slope * time
        squared = jnp.sum(off**2, axis=0)
        ends = start + last[0] * off
        ends = (ends, ends + (slope + last[1] * off) * time)
        line = (start + between[0] * off, slope + between[1] * off, cost + between[2] * squared)
        return line, (cost + last[2] * squared, *ends)

    following = jnp.roll(points, -1, axis=1)
    pair = (points, following - points, jnp.zeros_like(points[0]))
    times = jnp.arange(2, count)
    between, last = jnp.asarray(gains[:, 2:], points.dtype)
    _, longer = jax.lax.scan(grow, pair, (times, between, last))
    # By length and start; runs that wrap around the end are never used.
    tables = jax.tree.map(
        lambda short, long: jnp.concatenate([short[None], long]),
        (pair[2], points, following),
        longer,
    )
    start, end = np.indices((count, count))
    length = end - start
    cost, first, final = (
        jnp.moveaxis(table, 0, -2)[..., np.maximum(length - 1, 0), start] for table in tables
    )
    return jnp.where(jnp.asarray(length > 0), cost, jnp.inf), first, final


def _cheapest_runs(runs: Array, most: int) -> Array:
    """Lowest total error of 1, 2, ..., `most` runs that together contain all particles."""

    def add(costs: Array, _: None) -> tuple[Array, Array]:
        before = jnp.concatenate([jnp.full(1, jnp.inf, costs.dtype), costs[:-1]])
        return jnp.min(before[:, None] + runs, axis=0), costs[-1]

    return jax.lax.scan(add, runs[0], None, most)[1]


class _Segments(NamedTuple):
    """Segments from particle i to j, by i and j; the error is infinite where j <= i."""

    cost: Float[Array, "N N"]
    first: Float[Array, "3 N N"]
    final: Float[Array, "3 N N"]
    alpha: Float[Array, "N N"]
    beta: Float[Array, "N N"]


def _segment_table(points: Float[Array, "3 N"]) -> _Segments:
    count = points.shape[1]
    start, end = np.indices((count, count))
    stiffness = segment_stiffness(count)[:, np.maximum(end - start, 0)]
    lines = _line_table(points, regression_gains(count, 0.5, 0.5))
    return _Segments(*lines, *jnp.asarray(stiffness, points.dtype))


class _Chains(NamedTuple):
    """Costs stiffness |x - centre|² + cost of the chains to a particle; x is the chain's end."""

    stiffness: Float[Array, "*N"]
    centre: Float[Array, "3 *N"]
    cost: Float[Array, "*N"]


def _chains(
    points: Array, segments: _Segments, most: int, below_all: bool
) -> tuple[Float[Array, " M"], Int[Array, "M N"]]:
    """Costs of chains of 1, ..., `most` segments, and the start of each chain's last segment.

    Args:
        points: shape (3, N).
        segments: all segments.
        most: largest number of segments, `M`.
        below_all: whether to keep a paraboloid below the costs of all chains to a particle,
            instead of the cheapest chain.
    """
    count = points.shape[1]
    margin = ROUNDING * jnp.sum(points**2)

    def add(chains: _Chains, _: None) -> tuple[_Chains, tuple]:
        longer = _extend(chains, segments)
        best = _first_lowest(longer.cost)
        kept = _Chains(*(each[..., best, np.arange(count)] for each in longer))
        if below_all:
            kept = _below(longer, kept, margin)
        # The second half of the last particle's weight.
        a, c, e = (each[..., -1] for each in kept)
        closed = e + 0.5 * a / (0.5 + a) * jnp.sum((c - points[:, -1]) ** 2)
        return kept, (jnp.maximum(closed, 0.0), best)

    nothing = jnp.where(jnp.arange(count) == 0, 0.0, jnp.inf).astype(points.dtype)
    start = _Chains(jnp.full_like(nothing, 0.5), points, nothing)
    return jax.lax.scan(add, start, None, most)[1]


def _first_lowest(costs: Float[Array, "N N"]) -> Int[Array, " N"]:
    """The first row with the lowest cost, for each column: four times as fast as `argmin` here."""
    rows = jnp.arange(len(costs))[:, None]
    lowest = costs == jnp.min(costs, axis=0, keepdims=True)
    return jnp.min(jnp.where(lowest, rows, len(costs) - 1), axis=0)


def _extend(chains: _Chains, segments: _Segments) -> _Chains:
    """Chains to each particle i, extended by each segment i..j, by [i, j]."""
    a, e, alpha, beta = chains.stiffness[:, None], chains.cost[:, None], *segments[3:]
    off = chains.centre[:, :, None] - segments.first
    share = a / (alpha * (a + alpha) - beta**2)
    gap = share * (alpha**2 - beta**2) * jnp.sum(off**2, axis=0)
    return _Chains(
        stiffness=alpha - beta**2 / (a + alpha),
        centre=segments.final - (share * beta)[None] * off,
        cost=e + segments.cost + gap,
    )


def _below(longer: _Chains, cheapest: _Chains, margin: Array) -> _Chains:
    """For each particle j the steepest paraboloid at the cheapest chain that is below all others.

    a |x - c|² + e is below A |x - C|² + E everywhere if 1 / a >= 1 / A + |c - C|² / (E - e).
    The margin keeps the quotient away from 0 / 0, where chains differ by rounding.
    """
    apart = jnp.sum((longer.centre - cheapest.centre[:, None]) ** 2, axis=0)
    dearer = longer.cost - cheapest.cost[None] + margin
    # Where no chain reaches a particle the cost is infinite, and the other numbers are unused.
    reached = jnp.isfinite(longer.cost)
    softness = 1.0 / longer.stiffness + apart / jnp.where(reached, dearer, 1.0)
    softest = jnp.max(jnp.where(reached, softness, 0.0), axis=0)
    softest = jnp.maximum(softest, 1.0 / cheapest.stiffness)
    return _Chains(1.0 / softest, cheapest.centre, cheapest.cost - margin)


def _trace_back(pointers: Int[Array, "M N"]) -> Int[Array, "M M+1"]:
    """Breakpoints of the chains of every number of segments, from the starts of segments."""
    most, count = pointers.shape
    sizes = jnp.arange(most)

    def step(ends: Array, row: tuple) -> tuple[Array, Array]:
        segment, starts = row
        return jnp.where(segment <= sizes, starts[ends], ends), ends

    last = jnp.full(most, count - 1, pointers.dtype)
    first, later = jax.lax.scan(step, last, (sizes, pointers), reverse=True)
    return jnp.concatenate([first[None], later]).T
