"""Ropes: piecewise-linear fits with an increasing number of evenly spread key points.

Equation 3 of the paper, with breakpoints spread evenly along the rope: a fit is a quadratic
programme in the positions of the key points. The parameter of particle i of N is
(i - 1) / (N - 1), not the i / N of the paper's text, which would not fit even an exact V.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxsimp.bodies import Body
from jaxsimp.simplification.key_points import KeyPoints
from jaxsimp.simplification.ropes.fit import Workspace, feasible, fit_within, hat_weights, limits_of
from jaxsimp.simplification.ropes.models import (
    check_ropes,
    errors_by_size,
    rope_models,
    with_infeasible,
)
from jaxsimp.simplification.ropes.search import fill


def simplify_uniform(
    body: Body,
    goals: Float[np.ndarray, "B N 3"],
    tolerance: float | None = None,
    max_size: int | None = None,
    *,
    workspace: Workspace | None = None,
) -> list[KeyPoints]:
    """Key points of ropes: the fewest evenly spread breakpoints that fit the goal.

    Tries every size from 2 up: the error is not monotone in the number of evenly spread
    breakpoints (a V is exact with 3, and not with 4). The key particles are those at the
    breakpoints of the smallest fit. Its error is the root mean square distance between particles
    and fit, sqrt(E / N) of equation 3, which orders fits as E does.

    Args:
        body: a rope.
        goals: goal positions, shape (B, N, 3), metres.
        tolerance: error below which a fit is accepted, metres; 0.015 of the rope's length
            by default.
        max_size: largest number of key points tried, 20 by default; at most N.
        workspace: limits on the model; none by default.

    Returns:
        One model per goal, never certified: the last one tried where none fits.

    Raises:
        ValueError: if the body has triangles, a goal does not fit the body, the tolerance is
            not above zero, or `max_size` is below 2.
    """
    method = "uniform breakpoints"
    goals, tolerance, sizes = check_ropes(body, goals, tolerance, max_size, 20)
    limits = limits_of(body, workspace or Workspace())
    possible = feasible(goals, limits)
    goals = goals[possible]
    count, filled, centres = body.num_particles, fill(goals), goals.mean(axis=1, keepdims=True)

    def fit(size: int, indices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if limits.is_free:
            positions, errors = (np.asarray(each, dtype=float) for each in fit_rope(filled, size))
            return positions[indices] + centres[indices], errors[indices]
        return fit_within(goals[indices], breakpoints(size, len(indices)), limits)[:2]

    def breakpoints(size: int, number: int) -> np.ndarray:
        return np.broadcast_to(uniform_breakpoints(count, size), (number, size))

    def model(size: int, indices: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        particles = np.tile(breakpoint_particles(count, size), (len(indices), 1))
        return particles, breakpoints(size, len(indices)), fit(size, indices)[0]

    errors, columns = errors_by_size(
        lambda size, indices: fit(size, indices)[1], sizes, tolerance, len(goals)
    )
    models = rope_models(
        goals,
        sizes,
        errors,
        columns,
        model,
        np.zeros(len(goals), dtype=bool),
        tolerance=tolerance,
        method=method,
    )
    return with_infeasible(models, possible, count, tolerance=tolerance, method=method)


@partial(jax.jit, static_argnames="size")
def fit_rope(
    goals: Float[Array | np.ndarray, "B N 3"], size: int
) -> tuple[Float[Array, "B {size} 3"], Float[Array, " B"]]:
    """Best positions of evenly spread breakpoints, for a batch of goals (equation 3).

    The closed form of the unconstrained problem: one product with a pseudo-inverse that is
    constant when the function is compiled. Centred goals keep the float32 rounding relative to
    the rope's extent, not to its distance from the origin.

    Args:
        goals: shape (B, N, 3), metres.
        size: number of breakpoints, 2 to N.

    Returns:
        Positions of the breakpoints, shape (B, size, 3), and root mean square distances
        between particles and fit, shape (B,), both in metres.

    Raises:
        ValueError: if `size` is out of range.
    """
    W = interpolation_matrix(goals.shape[1], size)
    centre = jnp.mean(goals, axis=1, keepdims=True)
    centred = goals - centre
    product = partial(jnp.einsum, "ij,bjx->bix", precision="highest")
    positions = product(jnp.asarray(np.linalg.pinv(W), goals.dtype), centred)
    residual = product(jnp.asarray(W, goals.dtype), positions) - centred
    return positions + centre, jnp.sqrt(jnp.mean(jnp.sum(residual**2, axis=2), axis=1))


def uniform_breakpoints(num_particles: int, size: int) -> Float[np.ndarray, " K"]:
    """Evenly spread breakpoints, in particles from 0 to N - 1, shape (K,).

    Args:
        num_particles: number of particles, `N`.
        size: number of breakpoints, 2 to N.

    Raises:
        ValueError: if `size` is out of range.
    """
    if not 2 <= size <= num_particles:
        raise ValueError(
            f"size is {size}; a rope of {num_particles} particles has 2 to {num_particles} "
            f"breakpoints"
        )
    return np.arange(size) * (num_particles - 1) / (size - 1)


def interpolation_matrix(num_particles: int, size: int) -> Float[np.ndarray, "N K"]:
    """Weights W of evenly spread breakpoints, shape (N, K): particles = W breakpoints.

    Args:
        num_particles: number of particles, `N`.
        size: number of breakpoints, 2 to N.

    Raises:
        ValueError: if `size` is out of range.
    """
    return hat_weights(num_particles, uniform_breakpoints(num_particles, size)[None])[0]


def breakpoint_particles(num_particles: int, size: int) -> Int[np.ndarray, " K"]:
    """Ids of the particles nearest to evenly spread breakpoints along the rope, shape (K,).

    Nearest by id: on a goal that crosses itself the particle nearest in space may belong to
    another part of the rope.

    Args:
        num_particles: number of particles, `N`.
        size: number of breakpoints, 2 to N.
    """
    return np.floor(uniform_breakpoints(num_particles, size) + 0.5).astype(int)
