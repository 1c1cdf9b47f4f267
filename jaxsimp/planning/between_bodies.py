"""One body at two resolutions: plans and positions carried over by rest coordinates."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from jaxsimp.bodies import Body
from jaxsimp.dynamics import NONE, Actions
from jaxsimp.dynamics.arrays import require_positions

MISFIT = 0.05
"""Largest difference of the extents of two bodies, as a fraction of the larger body's size: meshes
of one outline differ by part of a triangle."""
AROUND_SURFACE, AROUND_ROPE = 8, 2
"""Number of neighbours that tell how a body lies around a particle."""


def carry_over(actions: Actions, body: Body, to: Body) -> Actions:
    """A plan for one body, or several, as plans for another body of the same extent.

    Each particle picked becomes the nearest particle of the other body, see `nearest_particles`;
    displacements stay.

    Args:
        actions: the plans, shapes (*B, T, G) and (*B, T, G, 3); not under `jit`.
        body: body of the plans.
        to: the other body, of another resolution.

    Raises:
        ValueError: if the extents of the bodies differ, or a pick is no particle of the body.
    """
    pick, count = np.asarray(actions.pick), body.num_particles
    wrong = pick[(pick < NONE) | (pick >= count)]
    if wrong.size:
        raise ValueError(
            f"the plan picks particle {wrong[0]} of a body of {count}; give the body of the plan"
        )
    return renamed(actions, nearest_particles(body, to))


def renamed(actions: Actions, new_ids: Int[np.ndarray, " N"]) -> Actions:
    """Plans that pick particle `new_ids[i]` instead of `i`, and still `NONE` for `NONE`."""
    pick = np.append(new_ids, NONE)[np.asarray(actions.pick)]  # NONE is the last index
    return Actions(jnp.asarray(pick, int), jnp.asarray(actions.displacement, float))


def nearest_particles(body: Body, to: Body) -> Int[np.ndarray, " N"]:
    """Id of the particle of another body nearest to each of a body, by rest coordinates.

    Rest coordinates have their origin below the middle of a body (see `Body.rest`), so that two
    resolutions of one body lie on each other.

    Raises:
        ValueError: if the extents of the bodies differ by more than `MISFIT` of the size.
    """
    _require_same_extent(body, to)
    _, ids = KDTree(to.rest).query(body.rest)
    return np.asarray(ids, int)


def carried_positions(
    body: Body, positions: Float[np.ndarray, "N 3"], to: Body
) -> Float[np.ndarray, "M 3"]:
    """Positions of another body that lies where a body lies, shape (M, 3), metres.

    Each particle is laid beside its nearest of the body, by the affine map that fits how the
    neighbours of that one lie. Turned and sheared bodies are exact, and so is the same body; a
    sharp crease is rounded over a few spacings of the body.

    Args:
        body: the body.
        positions: positions of its particles, shape (N, 3), metres.
        to: the other body, of another resolution and of `M` particles.

    Raises:
        ValueError: if the extents of the bodies differ, or the positions are not of the body.
    """
    given = np.asarray(require_positions("positions", positions, body.num_particles), float)
    nearest = nearest_particles(to, body)
    around = AROUND_SURFACE if len(body.faces) else AROUND_ROPE
    _, neighbours = KDTree(body.rest).query(body.rest[nearest], min(1 + around, len(body.rest)))
    at_rest = body.rest[neighbours] - body.rest[nearest][:, None]
    as_lying = given[neighbours] - given[nearest][:, None]
    slopes = np.linalg.pinv(at_rest, rcond=1e-6) @ as_lying
    beside = (to.rest - body.rest[nearest])[:, None] @ slopes
    return given[nearest] + beside[:, 0]


def _require_same_extent(body: Body, to: Body) -> None:
    extents = np.ptp(body.rest, axis=0), np.ptp(to.rest, axis=0)
    if np.abs(extents[0] - extents[1]).max() > MISFIT * max(body.size, to.size):
        told = " and ".join(str(np.round(extent, 4).tolist()) for extent in extents)
        raise ValueError(
            f"the extents of the two bodies at rest are {told} m; give two resolutions of one body"
        )
