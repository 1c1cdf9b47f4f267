"""How a body touches itself: what self-contact has to know of it, and the speeds it bears."""

import itertools
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxsimp.bodies import Body
from jaxsimp.bodies.meshes import face_areas
from jaxsimp.bodies.topology import connected_pieces, half_edges, neighbours

TOP_SPEED = 2.1
"""Default of the fastest that pickers may move, metres per second."""
LEVEL = 0.3
"""Layers closer than this, as a fraction of the thickness, count as side by side."""
SEARCH = 1.5
"""Search radius, as a multiple of the distance up to which pairs are listed."""
SPARE = 1.05
"""Times the thickness that layers are held apart: what presses them pushes them in a little."""
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
        "apart",
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
        apart: rest coordinates, unconnected parts moved away from each other, shape (3, N), metres.
        adjacent: pairs closer than that at rest do not collide, metres.
        thickness: distance that layers are held apart, `SPARE` times the body's, metres.
        lateral: particles touch that are not farther apart along their layers, metres.
        margin: how far is looked beyond what touches, metres.
        slack: how far one that touches may move until contacts are looked up again, metres.
        squash: weight that the squared distance across a sheet has on top of 1, where the nearest
            particle is looked for: `|d|^2 + squash across^2`.
        friction: Coulomb coefficient between layers.
        is_sheet: whether the body is a sheet, or else a rope; static.
    """

    frame: Int[Array, "... 4 N"]
    apart: Float[Array, "... 3 N"]
    adjacent: Float[Array, "..."]
    thickness: Float[Array, "..."]
    lateral: Float[Array, "..."]
    margin: Float[Array, "..."]
    slack: Float[Array, "..."]
    squash: Float[Array, "..."]
    friction: Float[Array, "..."]
    is_sheet: bool


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
    if not 0 <= friction < np.inf:
        raise ValueError(f"friction is {friction}; give a finite number, zero or more")
    is_sheet = len(body.faces) > 0
    layers = MOST_LAYERS_OF_SHEETS if is_sheet else MOST_LAYERS_OF_ROPES
    fastest = layers * thickness / time_step
    if not 0 < top_speed <= fastest:
        raise ValueError(
            f"pickers move at up to {top_speed:.3g} m/s; layers of {1e3 * thickness:.3g} mm touch "
            f"reliably at speeds above 0 and up to {fastest * (1 - 5e-4):.4g} m/s at time steps "
            f"of {1e3 * time_step:.3g} ms. Take smaller limits, longer actions, a smaller time "
            f"step, or a larger thickness; or leave self-contact out"
        )
    covering = _covering_radius(body) if is_sheet else np.sqrt(0.5) * _spacing(body)
    # Of the layers above, the next counts as nearest: (k d)^2 + covering^2 < (2 k d)^2.
    stretch = max(1.0, covering**2 / (3 * thickness**2)) if is_sheet else 1.0

    def array(value: float | np.ndarray) -> Array:
        return jnp.asarray(value, dtype=float)

    return SelfContact(
        frame=jnp.asarray(_frames(body), dtype=int),
        apart=array(_apart(body).T),
        adjacent=array(max(1.25 * body.rest_length.max(), 2 * thickness)),
        thickness=array(SPARE * thickness),
        lateral=array(1.2 * covering),
        margin=array(AHEAD * top_speed * time_step),
        slack=array(0.25 * covering),
        squash=array(stretch - 1),
        friction=array(friction),
        is_sheet=is_sheet,
    )


def _spacing(body: Body) -> float:
    """Longest distance to the nearest neighbour in a rope, metres."""
    shortest = np.full(body.num_particles, np.inf)
    np.minimum.at(shortest, body.springs, body.rest_length[:, None])
    return float(shortest.max())


def _covering_radius(body: Body) -> float:
    """Discs this large about the corners cover every triangle, metres."""
    corners = body.rest[body.faces]
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    area = face_areas(body.rest, body.faces)
    around = sides.prod(axis=1) / (4 * area)
    longest = sides.max(axis=1)
    obtuse = 2 * longest**2 > (sides**2).sum(axis=1)
    return float(np.where(obtuse, longest / 2, around).max())


def _apart(body: Body) -> np.ndarray:
    """Rest coordinates, each part that no spring joins to the others far from them."""
    _, part = connected_pieces(body.springs, body.num_particles)
    return body.rest + 10 * body.size * part[:, None] * np.array([1.0, 0.0, 0.0])


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


def _next(body: Body) -> Int[np.ndarray, "_ 2"]:
    """Pairs of next neighbours: along edges of triangles, or the shorter springs."""
    if len(body.faces):
        return half_edges(body.faces)[0]
    return body.springs[body.rest_length < 1.5 * _spacing(body)]
