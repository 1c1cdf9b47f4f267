"""Ropes: piecewise-linear fits with more and more key points, until one is close to the goal.

Equation 3 of the paper, with breakpoints spread evenly along the rope: a fit is a quadratic
programme in the positions of the key points. The parameter of particle i of N is
(i - 1) / (N - 1), not the i / N of the paper's text, which would miss even a perfect V.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxsimp.body import Body
from jaxsimp.goals import Positions, as_goal
from jaxsimp.simplify import qp
from jaxsimp.simplify.interpolation import model_errors
from jaxsimp.simplify.keypoints import KeyPoints, smallest_fit


def simplify_uniform(
    body: Body,
    goal: Positions,
    *,
    tolerance: float | None = None,
    max_size: int = 20,
    above_table: bool = False,
    workspace: Float[np.ndarray, "2 3"] | None = None,
    fixed_ends: bool = False,
) -> KeyPoints:
    """Key points of a rope: the fewest evenly spread breakpoints that fit the goal.

    Sizes are tried from 2 up, every one: the error is not monotone in the number of evenly
    spread breakpoints (a V is exact with 3, and not with 4). The key particles are those at
    the breakpoints of the smallest fit. Its error is the root mean square distance between
    particles and fit, sqrt(E / N) of equation 3: it orders fits as E does.

    Args:
        body: a rope.
        goal: goal positions, shape (N, 3), metres.
        tolerance: error below which a fit is accepted, metres; 0.015 of the rope's length
            by default.
        max_size: largest number of key points tried; no more than N are.
        above_table: keep the model a radius above z = 0.
        workspace: lowest and highest x, y, z of the model, shape (2, 3), metres.
        fixed_ends: keep the model's ends at the goal's.

    Raises:
        ValueError: if the body has triangles, the goal is not one of this body, the
            tolerance is not above zero, `max_size` is below 2, the constraints contradict
            each other, or no fit of up to `max_size` key points is close enough.
    """
    goal = as_goal(body, goal)
    tolerance = 0.015 * body.size if tolerance is None else tolerance
    _check_options(body, tolerance, max_size)
    lower, upper = _box(body, above_table, workspace)
    constrained = fixed_ends or bool(np.isfinite([lower, upper]).any())

    def fit(size: int) -> tuple[np.ndarray, float]:
        if constrained:
            return _fit_one_constrained(goal, size, lower, upper, fixed_ends)
        return _fit_one(goal, size)

    sizes = range(2, min(max_size, body.num_particles) + 1)
    size, errors = smallest_fit(lambda size: fit(size)[1], sizes, tolerance)
    if size is None:
        raise ValueError(
            f"no fit of up to {sizes[-1]} key points is within the tolerance of "
            f"{tolerance:.3g} m: the best is off by {min(errors.values()):.3g} m; raise "
            f"tolerance or max_size"
        )
    positions, _ = fit(size)
    largest, mean = model_errors(goal, interpolation_matrix(len(goal), size), positions)
    return KeyPoints(
        particles=breakpoint_particles(body.num_particles, size),
        positions=positions,
        elements=np.stack([np.arange(size - 1), np.arange(1, size)], axis=1),
        num_particles=body.num_particles,
        method="uniform breakpoints",
        sizes=tuple(errors),
        errors=tuple(errors.values()),
        tolerance=tolerance,
        max_error=largest,
        rms_error=mean,
    )


@partial(jax.jit, static_argnames="size")
def fit_rope(
    goals: Float[Array | np.ndarray, "B N 3"], size: int
) -> tuple[Float[Array, "B {size} 3"], Float[Array, " B"]]:
    """Best positions of evenly spread breakpoints, for a batch of goals (equation 3).

    The closed form of the unconstrained problem: one product with a pseudo-inverse that is
    known when the function is compiled. Goals are centred before, so that float32 errs by
    rounding of the rope's extent, not of its distance from the origin.

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


def fit_rope_constrained(
    goals: Float[np.ndarray, "B N 3"],
    size: int,
    lower: Float[np.ndarray, " 3"],
    upper: Float[np.ndarray, " 3"],
    fixed_ends: bool = False,
    backend: str = "proxsuite",
) -> tuple[Float[np.ndarray, "B {size} 3"], Float[np.ndarray, " B"], Int[np.ndarray, " B"]]:
    """Best positions of evenly spread breakpoints in a box, for a batch of goals (equation 3).

    Every point of a fit is between two breakpoints, so a box that holds the breakpoints
    holds the whole fit. The axes do not interact: each is a programme of its own.

    Args:
        goals: shape (B, N, 3), metres.
        size: number of breakpoints, 2 to N.
        lower: lowest x, y, z, shape (3,), metres; -inf for none.
        upper: highest x, y, z, shape (3,), metres; inf for none.
        fixed_ends: whether the first and the last breakpoint are the goal's ends.
        backend: as for `qp.solve`.

    Returns:
        Positions of the breakpoints, shape (B, size, 3), root mean square distances between
        particles and fit, shape (B,), both in metres, and a `qp.Status` per goal, shape (B,).
        Where it is not `SOLVED` the positions are NaN and the distance is infinite.

    Raises:
        ValueError: if `size` is out of range, a number is not one, or the backend cannot
            handle the box.
    """
    batch, count = goals.shape[:2]
    W = interpolation_matrix(count, size)
    centre = goals.mean(axis=1, keepdims=True)
    # One programme for each goal and axis, shape (B * 3, ...).
    centred = np.swapaxes(goals - centre, 1, 2).reshape(batch * 3, count).astype(float)
    shift = centre.reshape(batch * 3, 1)
    ends = np.eye(size)[[0, -1]]
    problem = qp.QuadraticProgram(
        H=np.broadcast_to(W.T @ W, (batch * 3, size, size)),
        g=-centred @ W,
        A=np.broadcast_to(ends, (batch * 3, 2, size)) if fixed_ends else None,
        b=centred[:, [0, -1]] if fixed_ends else None,
        lower=_bound(lower, shift, size),
        upper=_bound(upper, shift, size),
    )
    solution = qp.solve(problem, backend)
    residual = (solution.x @ W.T - centred).reshape(batch, 3, count)
    error = np.sqrt(np.sum(residual**2, axis=(1, 2)) / count)
    positions = np.swapaxes(solution.x.reshape(batch, 3, size), 1, 2) + centre
    # A goal is solved if its three axes are, and infeasible if one of them is.
    axes = solution.status.reshape(batch, 3)
    infeasible = (axes == qp.Status.INFEASIBLE).any(axis=1)
    status = np.where(infeasible, qp.Status.INFEASIBLE, axes.max(axis=1))
    solved = status == qp.Status.SOLVED
    positions = np.where(solved[:, None, None], positions, np.nan)
    return positions, np.where(solved, error, np.inf), status


def interpolation_matrix(num_particles: int, size: int) -> Float[np.ndarray, "N K"]:
    """Weights W of piecewise-linear interpolation, shape (N, K): particles = W breakpoints.

    Args:
        num_particles: number of particles, `N`.
        size: number of evenly spread breakpoints, 2 to N.

    Raises:
        ValueError: if `size` is out of range.
    """
    if not 2 <= size <= num_particles:
        raise ValueError(
            f"size is {size}; a rope of {num_particles} particles has 2 to {num_particles} "
            f"breakpoints"
        )
    along = np.arange(num_particles) * (size - 1) / (num_particles - 1)
    return np.maximum(0.0, 1.0 - np.abs(along[:, None] - np.arange(size)))


def breakpoint_particles(num_particles: int, size: int) -> Int[np.ndarray, " K"]:
    """Ids of the particles nearest to evenly spread breakpoints along the rope, shape (K,).

    Nearest by id: on a goal that crosses itself the nearest in space may be another part of
    the rope.

    Args:
        num_particles: number of particles, `N`.
        size: number of breakpoints, 2 to N.
    """
    exact = np.arange(size) * (num_particles - 1) / (size - 1)
    return np.floor(exact + 0.5).astype(int)


def _bound(limit: np.ndarray, shift: np.ndarray, size: int) -> np.ndarray | None:
    """A limit on x, y, z as a bound on the centred programmes, shape (B * 3, K)."""
    if np.isinf(limit).all():
        return None
    axes = np.tile(np.asarray(limit, dtype=float), len(shift) // 3)[:, None]
    return np.repeat(axes - shift, size, axis=1)


def _box(
    body: Body, above_table: bool, workspace: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest x, y, z of the model, metres."""
    lower, upper = np.array([[-np.inf] * 3, [np.inf] * 3])
    if workspace is not None:
        lower, upper = np.array(workspace, dtype=float)
    if above_table:
        lower[2] = max(lower[2], body.radius)
    return lower, upper


def _fit_one(goal: np.ndarray, size: int) -> tuple[np.ndarray, float]:
    """Positions, shape (K, 3), and error of the fit to one goal."""
    # Centred here too: on the host, before the default float32 rounds the distance away.
    centre = goal.mean(axis=0)
    positions, error = fit_rope((goal - centre)[None], size)
    return np.asarray(positions[0], dtype=float) + centre, float(error[0])


def _fit_one_constrained(
    goal: np.ndarray, size: int, lower: np.ndarray, upper: np.ndarray, fixed_ends: bool
) -> tuple[np.ndarray, float]:
    """Positions, shape (K, 3), and error of the fit to one goal in a box."""
    positions, error, status = fit_rope_constrained(goal[None], size, lower, upper, fixed_ends)
    if status[0] != qp.Status.SOLVED:
        raise ValueError(
            f"the fit of {size} key points is {qp.Status(status[0]).name}; widen the workspace, "
            f"raise the goal's ends above the table, or leave fixed_ends out"
        )
    return positions[0], float(error[0])


def _check_options(body: Body, tolerance: float, max_size: int) -> None:
    if len(body.faces):
        raise ValueError(f"the {body.name} has {len(body.faces)} triangles; give a rope")
    if not 0 < tolerance < np.inf:
        raise ValueError(f"tolerance is {tolerance:g}; give a distance above zero, in metres")
    if max_size < 2:
        raise ValueError(f"max_size is {max_size}; at least 2 is needed")
