"""Garments laid on the table and pressed flat: a body in three dimensions becomes one in layers.

The body is turned so that its thinnest extent is upright. Then it is pressed as between two plates:
particles move in the plane alone, drawn and pushed by the springs along the edges, until these have
their lengths again as nearly as they can. The order of the layers is that of the body in space.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxsimp.bodies import Body
from jaxsimp.bodies.topology import are_among, distinct_edges, half_edges, neighbours
from jaxsimp.checks import require_rows
from jaxsimp.dynamics.rollouts import settle
from jaxsimp.dynamics.simulation import Simulation, at_rest, largest_time_step, make_simulation

ROUNDS = 30
"""Number of times that the plates are closed."""
SECONDS = 0.1
"""Time of each round, seconds."""
DRAG = 5.0
"""Air drag while it is pressed, per second: the motion comes to rest."""
APART = 0.6
"""Distance in the plane, in edges, within which a particle lies above another."""
ONE_LAYER, ONE_FOLD = 3, 1
"""Number of edges up to which particles do not lie above each other: of those that face the same
way, and of those that face opposite ways, round a fold."""
SHRINKS = 0.1
"""Largest median change of the edges' lengths: 0.01 to 0.02 for garments, 0.2 for a ball."""


def press(body: Body, *, facing: tuple[float, float, float] | None = None) -> Body:
    """A garment pressed flat on the table: the same fabric, flat at rest, layer upon layer.

    For a body that stands or lies in space, as a T-shirt in the shape of its wearer, so that
    `goals.flat`, `goals.fold` and all tasks apply. Masses, stiffness and damping stay; rest lengths
    become those of the pressed body, as ironing sets them: edges change by 1 to 2 % in the median,
    and more where a fold runs across them.

    Args:
        body: a body with triangles.
        facing: direction at rest, x, y and z, that faces up on the table; by default that of the
            body's least extent.

    Raises:
        ValueError: if the body has no triangles, the direction has no length, or the body cannot be
            pressed: its edges would change by more than `SHRINKS` in the median.
    """
    if not len(body.faces):
        raise ValueError(
            f"the {body.name} has no triangles; a rope is laid by goals.polyline: give a garment"
        )
    upright = _turned(body, facing)
    flat = _in_the_plane(body, upright)
    rest = np.concatenate([flat, _heights(body, flat, upright)[:, None]], axis=1)
    middle = (rest[:, :2].min(axis=0) + rest[:, :2].max(axis=0)) / 2
    rest[:, :2] -= middle
    first, second = body.springs.T
    length = np.linalg.norm(rest[second] - rest[first], axis=1)
    change = float(np.median(np.abs(length / body.rest_length - 1)[body.families == 0]))
    if change > SHRINKS:
        raise ValueError(
            f"pressed flat, the edges of the {body.name} change by {change:.0%} in the median; "
            f"{SHRINKS:.0%} is the limit: mesh it finer, give a garment, or cut the body open"
        )
    least = 1e-3 * body.rest_length  # particles above each other on a crease
    return dataclasses.replace(body, rest=rest, rest_length=np.maximum(length, least))


def _turned(body: Body, facing: tuple[float, float, float] | None) -> Float[np.ndarray, "N 3"]:
    """The body turned so that a direction is up, and its longest extent across lies along y."""
    centred = body.rest - body.rest.mean(axis=0)
    axes = np.linalg.svd(centred, full_matrices=False)[2]
    up = axes[2] * np.sign(axes[2][np.abs(axes[2]).argmax()])
    if facing is not None:
        (up,) = require_rows("facing", [facing], 3)
        length = np.linalg.norm(up)
        if not length > 0:
            raise ValueError(f"facing is {facing}; give a direction with a length")
        up = up / length
    across = np.linalg.svd(centred - np.outer(centred @ up, up), full_matrices=False)[2][0]
    across = across * np.sign(across[np.abs(across).argmax()])
    return centred @ np.stack([np.cross(across, up), across, up], axis=1)


def _in_the_plane(body: Body, upright: np.ndarray) -> Float[np.ndarray, "N 2"]:
    """Places in the plane where the springs along the edges are at rest as nearly as they can."""
    soft = body.scaled(stiffness=np.where(body.families == 0, 1.0, 0.0))
    simulation = make_simulation(soft, min(2e-3, 0.9 * largest_time_step(body)), 0.0, obstacles=())
    simulation = dataclasses.replace(simulation, drag=jnp.asarray(DRAG, dtype=float))
    num_steps = int(SECONDS / float(simulation.time_step))

    # Out of the plane they would buckle: each round starts in the plane again, all but for a hint
    # of the heights, without which particles at one place could not part.
    highest = max(float(np.abs(upright[:, 2]).max()), body.radius)
    level = jnp.asarray(body.radius * upright[:, 2] / highest, dtype=float)

    @jax.jit
    def closed(simulation: Simulation, position: jax.Array) -> jax.Array:
        def close(_: jax.Array, position: jax.Array) -> jax.Array:
            start = position.at[:, 2].set(level)
            return settle(simulation, at_rest(start), num_steps).position

        return jax.lax.fori_loop(0, ROUNDS, close, position)

    pressed = closed(simulation, jnp.asarray(upright, dtype=float))
    return np.asarray(pressed, dtype=float)[:, :2]


def _heights(body: Body, flat: np.ndarray, upright: np.ndarray) -> Float[np.ndarray, " N"]:
    """Heights of particles: a thickness above the highest one below, where they cover others."""
    from scipy.spatial import cKDTree

    edges = distinct_edges(half_edges(body.faces)[0])[0]
    usual = float(np.median(np.linalg.norm(flat[edges[:, 1]] - flat[edges[:, 0]], axis=1)))
    pairs = cKDTree(flat).query_pairs(APART * usual, output_type="ndarray").astype(np.int64)
    faces_up = _faces_up(body, upright)
    alike = faces_up[pairs[:, 0]] == faces_up[pairs[:, 1]]
    near = np.where(
        alike,
        _are_near(edges, pairs, len(flat), ONE_LAYER),
        _are_near(edges, pairs, len(flat), ONE_FOLD),
    )
    first, other = neighbours(pairs[~near], len(flat))
    level, heights = upright[:, 2], np.zeros(len(flat))
    for particle in np.argsort(level, kind="stable"):
        covered = other[first[particle] : first[particle + 1]]
        below = covered[level[covered] < level[particle]]
        if len(below):
            heights[particle] = heights[below].max() + body.material.thickness
    return heights


def _faces_up(body: Body, upright: np.ndarray) -> Bool[np.ndarray, " N"]:
    """Whether the triangles of each particle face up, together."""
    a, b, c = upright[body.faces].transpose(1, 0, 2)
    up = np.repeat(np.cross(b - a, c - a)[:, 2], 3)
    return np.bincount(body.faces.ravel(), up, len(upright)) > 0


def _are_near(
    edges: np.ndarray, pairs: np.ndarray, count: int, most: int
) -> Bool[np.ndarray, " P"]:
    """Whether each pair is joined by at most so many edges."""
    from scipy.sparse import coo_array

    both = np.concatenate([edges, edges[:, ::-1]])
    graph = coo_array((np.ones(len(both)), both.T), shape=(count, count)).tocsr()
    reach = graph
    for _ in range(most - 1):
        reach = reach + reach @ graph
    reach = reach.tocoo()
    return are_among(pairs, np.stack([reach.row, reach.col], axis=1).astype(np.int64))
