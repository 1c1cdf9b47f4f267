"""How a body touches itself: what self-contact has to know of it, and the speeds it bears."""

import itertools
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxsimp.bodies import Body
from jaxsimp.bodies.meshes import covering_radii
from jaxsimp.bodies.topology import half_edges, neighbours
from jaxsimp.checks import require_number

TOP_SPEED = 2.1
"""Default of the fastest that pickers may move, metres per second."""
LEAST_SPEED, MOST_SPEED = 1e-12, 1e9
"""Range of the fastest that pickers may move, metres per second: a task of any limits is in it."""
LEVEL = 0.3
"""Layers closer than this, as a fraction of the thickness, count as side by side."""
SEARCH = 1.5
"""Search radius, as a multiple of the distance up to which pairs are listed."""
SPARE = 1.05
"""Times the thickness that layers are held apart: what presses them pushes them in a little."""
NEIGHBOURHOOD = 1.25
"""Particles nearer than this along the body, as a multiple of the longest spring of each, do not
touch."""
DETOUR = 1.1
"""Ratio of the distance along springs to that along the body, at most: 1.08 on a square grid."""
FEW = 16
"""Particles that are due are looked up alone if they are at most one in so many, else all are."""
ALONE = 40
"""Most particles that are looked up alone: each is compared with all, without cells."""
SLACK = 0.25
"""Distance that a particle in contact may move until the next lookup, in radii of its disc."""
AHEAD = 1
"""Look-ahead, in time steps: with more, lookups list more pairs, and their lists last longer."""
MOST_LAYERS_OF_SHEETS = 1.1
"""Longest move of a picker in a time step, in thicknesses."""
MOST_LAYERS_OF_ROPES = 0.75
"""The same for ropes: struck faster, they stretch until their gaps let others through."""


@partial(
    jax.tree_util.register_dataclass,
    data_fields=[
        "frame",
        "framed",
        "adjacent",
        "thickness",
        "lateral",
        "margin",
        "slack",
        "squash",
        "friction",
    ],
    meta_fields=["is_sheet"],
)
@dataclass(frozen=True)
class SelfContact:
    """How a body touches itself.

    Attributes:
        frame: ids `a, b, c, d` for each particle: its sheet's normal is along
            `(x_a - x_b) x (x_c - x_d)`, its rope's tangent along `x_a - x_b`, shape (4, N).
        framed: places of each particle in the flattened `frame`, shape (D, N); 4 N after the last.
        adjacent: ids of the particles too near along the body to touch each particle, itself
            included and repeated after the last, shape (N, K).
        thickness: distance that layers are held apart, `SPARE` times the body's, metres.
        lateral: a particle touches others up to this far along its layer, shape (N,), metres.
        margin: lookups list pairs up to this far beyond touching, metres.
        slack: distance that a particle in contact may move until the next lookup, shape (N,),
            metres.
        squash: weight of the squared distance across a sheet, on top of 1, in the search for the
            nearest particle, `|d|^2 + squash across^2`, shape (N,).
        friction: Coulomb coefficient between layers.
        is_sheet: whether the body is a sheet, or else a rope; static.
    """

    frame: Int[Array, "... 4 N"]
    framed: Int[Array, "... D N"]
    adjacent: Int[Array, "... N K"]
    thickness: Float[Array, "..."]
    lateral: Float[Array, "... N"]
    margin: Float[Array, "..."]
    slack: Float[Array, "... N"]
    squash: Float[Array, "... N"]
    friction: Float[Array, "..."]
    is_sheet: bool

    @property
    def may_touch(self) -> Bool[np.ndarray, "N N"]:
        """Pairs of particles that are not adjacent."""
        adjacent = np.asarray(self.adjacent)
        found = np.ones((len(adjacent),) * 2, dtype=bool)
        found[np.arange(len(adjacent))[:, None], adjacent] = False
        return found


def listing_distances(
    settings: SelfContact,
) -> tuple[Float[Array, " N"], Float[Array, " N"], Float[Array, ""]]:
    """Distances up to which particles touch each one, and are listed, and the search radius.

    The first two as the search for the nearest measures them, see `SelfContact.squash`; metres.
    """
    stretch, lateral = jnp.sqrt(1 + settings.squash), settings.lateral.max()
    touching = jnp.hypot(lateral, stretch * settings.thickness)
    reach = jnp.hypot(lateral, stretch * (settings.thickness + settings.margin))
    return touching, reach, SEARCH * reach.max()


def longest_contact_step(body: Body, top_speed: float) -> float:
    """Longest time step, seconds, at which layers touch reliably.

    Args:
        body: the body.
        top_speed: fastest that a picker moves, metres per second, above 0.
    """
    return _most_layers(body) * body.material.thickness / top_speed


def _most_layers(body: Body) -> float:
    """Largest distance that a picker may move in a time step, in thicknesses."""
    return MOST_LAYERS_OF_SHEETS if len(body.faces) else MOST_LAYERS_OF_ROPES


def make_self_contact(
    body: Body,
    time_step: float,
    *,
    top_speed: float = TOP_SPEED,
    friction: float | None = None,
) -> SelfContact:
    """How a body touches itself.

    Args:
        body: a sheet, or, where it has no triangles, one or several ropes.
        time_step: of the simulation, seconds.
        top_speed: fastest that a picker moves, metres per second.
        friction: Coulomb coefficient between layers; by default that with the table.

    Raises:
        ValueError: if the body has no thickness, pickers are too fast for it, or a number is out
            of its range.
    """
    thickness = body.material.thickness
    if not thickness > 0:
        raise ValueError(
            "thickness is 0; self-contact holds layers that far apart: give metres above zero"
        )
    friction = body.material.friction if friction is None else friction
    require_number("friction", friction, 0.0, 1e3)
    require_number("top_speed", top_speed, 0.0, MOST_SPEED, "m/s")
    is_sheet = len(body.faces) > 0
    fastest = _most_layers(body) * thickness / time_step
    if not 0 < top_speed <= fastest:
        raise ValueError(
            f"pickers move at up to {top_speed:.3g} m/s; layers of {1e3 * thickness:.3g} mm touch "
            f"reliably at speeds above 0 and up to {fastest * (1 - 5e-4):.4g} m/s at time steps "
            f"of {1e3 * time_step:.3g} ms. Take smaller limits, longer actions, a smaller time "
            f"step, or a larger thickness; or leave self-contact out"
        )
    covering = _disc_radii(body) if is_sheet else np.sqrt(0.5) * _spacings(body)
    # Of the layers above, the next counts as nearest: (k d)^2 + covering^2 < (2 k d)^2.
    stretch = (
        np.maximum(1.0, covering**2 / (3 * thickness**2)) if is_sheet else np.ones(len(covering))
    )

    def array(value: float | np.ndarray) -> Array:
        return jnp.asarray(value, dtype=float)

    frames = _frames(body)
    return SelfContact(
        frame=jnp.asarray(frames, dtype=int),
        framed=jnp.asarray(_places(frames), dtype=int),
        adjacent=jnp.asarray(_adjacent(body), dtype=int),
        thickness=array(SPARE * thickness),
        lateral=array(1.2 * covering),
        margin=array(AHEAD * top_speed * time_step),
        slack=array(SLACK * covering),
        squash=array(stretch - 1),
        friction=array(friction),
        is_sheet=is_sheet,
    )


def _spacings(body: Body) -> Float[np.ndarray, " N"]:
    """Longest distance to the nearest neighbour in a rope, for every particle, metres."""
    shortest = np.full(body.num_particles, np.inf)
    np.minimum.at(shortest, body.springs, body.rest_length[:, None])
    return np.full(body.num_particles, shortest.max())


def _disc_radii(body: Body) -> Float[np.ndarray, " N"]:
    """Radii of discs about the particles that cover every triangle, metres."""
    radius = covering_radii(body.rest, body.faces)
    largest = np.zeros(body.num_particles)
    np.maximum.at(largest, body.faces, radius[:, None])
    return np.where(largest > 0, largest, radius.max())


def _adjacent(body: Body) -> Int[np.ndarray, "N K"]:
    """Ids for `SelfContact.adjacent`."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import dijkstra

    count, (first, second) = body.num_particles, body.springs.T
    longest = np.zeros(count)
    np.maximum.at(longest, body.springs, body.rest_length[:, None])
    own = np.maximum(NEIGHBOURHOOD * longest, 2 * body.material.thickness)
    springs = csr_array((body.rest_length, (first, second)), shape=(count, count))

    def near(sources: Int[np.ndarray, " _"]) -> Int[np.ndarray, "_ 2"]:
        along = dijkstra(springs, directed=False, indices=sources, limit=DETOUR * own.max())
        rows, others = np.nonzero(np.isfinite(along))
        limit = np.minimum(own[sources[rows]], own[others])
        straight = np.linalg.norm(body.rest[sources[rows]] - body.rest[others], axis=1)
        chosen = (along[rows, others] < DETOUR * limit) & (straight < limit)
        return np.stack([sources[rows], others], axis=1)[chosen]

    # In parts: distances between all pairs would take memory by the square of their number.
    parts = np.array_split(np.arange(count), 1 + count // 256)
    pairs = np.concatenate([near(part) for part in parts])
    starts, others = neighbours(pairs, count)
    number = np.diff(starts)
    place = np.minimum(np.arange(number.max()), number[:, None] - 1)
    return others[starts[:-1, None] + place]


def _frames(body: Body) -> np.ndarray:
    """Ids for `SelfContact.frame`: the farthest apart, and the most square to them, around each."""
    starts, others = neighbours(_next(body), body.num_particles)
    frames = np.zeros((4, body.num_particles), dtype=int)
    for particle, (start, end) in enumerate(itertools.pairwise(starts)):
        ids = np.append(others[start:end], particle)
        first, second = np.triu_indices(len(ids), k=1)
        along = body.rest[ids[first]] - body.rest[ids[second]]
        best = np.argmax(np.linalg.norm(along, axis=1))
        square = np.argmax(np.linalg.norm(np.cross(along[best], along), axis=1))
        frames[:, particle] = ids[[first[best], second[best], first[square], second[square]]]
    return frames


def _places(frames: Int[np.ndarray, "4 N"]) -> Int[np.ndarray, "D N"]:
    """Places for `SelfContact.framed`."""
    particles = frames.ravel()
    order = np.argsort(particles, kind="stable")
    number = np.bincount(particles, minlength=frames.shape[1])
    first = np.cumsum(number) - number
    places = np.full((number.max(), frames.shape[1]), frames.size)
    rank = np.arange(frames.size) - first[particles[order]]
    places[rank, particles[order]] = order
    return places


def _next(body: Body) -> Int[np.ndarray, "_ 2"]:
    """Pairs of next neighbours: along edges of triangles, or the shorter springs."""
    if len(body.faces):
        return half_edges(body.faces)[0]
    return body.springs[body.rest_length < 1.5 * _spacings(body).max()]
