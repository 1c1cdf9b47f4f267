"""Pickers: grasp particles and carry them along displacements, within limits."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxsimp.checks import keep, require_count, require_number, require_numbers
from jaxsimp.dynamics.arrays import as_array, require_known
from jaxsimp.dynamics.contact.obstacles import Obstacle, Table

NONE = -1
"""The particle id of a picker that grasps nothing (None in Eq. 1 of the paper)."""
IDS = f"ids of particles, as integers, and {NONE} for a picker that grasps nothing"
"""What to give for `Actions.pick`."""
GRAZE = 1e-5
"""Depth, metres, to which a path may enter an obstacle: paths along a surface have rounding."""
LEAST_LIMIT, MOST_LIMIT = 1e-6, 1e3
"""Range of the largest displacement of an action, metres."""
LEAST_STRETCH, MOST_STRETCH = 1.0001, 1e6
"""Range of `Pickers.max_stretch`; the largest is none."""
MOST_LAYERS = 1000
"""Most layers of a pinch."""
SPARE_LAYERS = 0.5
"""Height beyond those layers in which a pinch holds, in layers: they are seldom level."""
MOST_STEPS = 10_000_000
"""Most time steps of an action."""
TOUCHES = 16
"""Steps in the search for the first touch of a path; one that needs more ends before it."""


@partial(jax.tree_util.register_dataclass, data_fields=["pick", "displacement"], meta_fields=[])
@dataclass(frozen=True)
class Actions:
    """A plan: the particle and the displacement of each picker (Eq. 1 of the paper).

    `require_actions` refuses a plan with other ids or displacements where their values are known.
    Under `jit` and `vmap` they are not: there a picker with another id grasps nothing, and a
    displacement that is not finite makes the rollout not finite, which a search counts as failed.

    Attributes:
        pick: particle ids, or `NONE`, shape (T, G), or (G,) for one action.
        displacement: displacements of the pickers, shape (T, G, 3), or (G, 3), metres.
    """

    pick: Int[Array, "*T G"]
    displacement: Float[Array, "*T G 3"]


@dataclass(frozen=True)
class Pinch:
    """Fingers that hold what is between them, as grippers do, and not the named particle alone.

    A picker holds every particle that is, at the start of an action, within `radius` of the named
    one as seen from above, and at most `layers` layers above or below it.

    Attributes:
        radius: radius of a fingertip, metres.
        layers: number of layers held on either side of the named particle's own; 1 for both sheets
            of a garment, 3 for both of a garment folded once.

    Raises:
        ValueError: if a number is out of its range.
    """

    radius: float
    layers: int = 1

    def __post_init__(self) -> None:
        radius = require_number("radius", self.radius, 0.0, MOST_LIMIT, "m")
        keep(self, radius=radius, layers=require_count("layers", self.layers, 0, MOST_LAYERS))


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["limits", "max_stretch"],
    meta_fields=["steps", "pinch"],
)
@dataclass(frozen=True)
class Pickers:
    """Limits of the pickers' motion.

    Attributes:
        limits: largest displacement of one action along x, y, z, shape (3,), metres.
        max_stretch: upper bound on the distance of two named particles, as a multiple of their rest
            distance.
        steps: number of time steps of one action; static.
        pinch: what fingers hold besides the named particle; None for that particle alone; static.
    """

    limits: Float[Array, "... 3"]
    max_stretch: Float[Array, "..."]
    steps: int
    pinch: Pinch | None = None


def make_pickers(
    limits: tuple[float, float, float] = (0.08, 0.08, 0.08),
    max_stretch: float = 1.2,
    steps: int = 150,
    pinch: Pinch | None = None,
) -> Pickers:
    """Pickers with the stretch rule of SoftGym (1.2) and the limits of the paper's author.

    Raises:
        ValueError: if a number is out of its range, or `pinch` is none.
    """
    require_pinch(pinch)
    limits = require_limits(limits)
    require_number("max_stretch", max_stretch, LEAST_STRETCH, MOST_STRETCH)
    steps = require_count("steps", steps, 1, MOST_STEPS)
    found = jnp.asarray(limits, dtype=float), jnp.asarray(max_stretch, dtype=float)
    return Pickers(*found, steps, pinch)


def require_pinch(pinch: Any) -> None:
    """Raise a `ValueError` unless it is a `Pinch`, or None."""
    if pinch is not None and not isinstance(pinch, Pinch):
        raise ValueError(f"pinch is {pinch!r}; give Pinch(radius, layers), or None")


def require_limits(limits: Any) -> tuple[float, float, float]:
    """Three displacements above zero, metres, as floats.

    Raises:
        ValueError: if there are other than three, or one is out of its range.
    """
    array = require_numbers("limits", limits, LEAST_LIMIT, MOST_LIMIT, "m")
    if array.shape != (3,):
        raise ValueError(f"limits is {limits}; give three displacements in metres, along x, y, z")
    x, y, z = array.tolist()
    return x, y, z


def top_speed(limits: tuple[float, float, float], seconds: float) -> float:
    """Largest speed of a picker, metres per second: midway along its longest displacement.

    Args:
        limits: largest displacement along x, y, z, metres.
        seconds: duration of the action, seconds.
    """
    return 1.5 * float(np.linalg.norm(limits)) / seconds


def require_actions(actions: Any, num_particles: int, *, batch: bool = False) -> Actions:
    """A plan as arrays, or several with a first axis `B`, checked.

    Under `jit` and `vmap` shapes and types are checked; values are not known.

    Args:
        actions: what was given.
        num_particles: number of particles of the body, `N`.
        batch: whether there is an axis `B`.

    Raises:
        ValueError: if it is no `Actions`, its shapes do not match, `pick` is not of integers, an id
            is neither a particle nor `NONE`, or a displacement is not finite.
    """
    if not isinstance(actions, Actions):
        raise ValueError(
            f"the plan is a {type(actions).__name__}; give Actions(pick, displacement)"
        )
    return checked_actions(actions.pick, actions.displacement, num_particles, batch=batch)


def checked_actions(
    pick: Any, displacement: Any, num_particles: int, *, batch: bool = False
) -> Actions:
    """`require_actions`, of the two arrays of a plan."""
    pick, displacement = as_array("pick", pick, IDS), as_array("displacement", displacement)
    if pick.ndim != 2 + batch or 0 in pick.shape[-1:] or displacement.shape != (*pick.shape, 3):
        wanted = "B, T, G" if batch else "T, G"
        raise ValueError(
            f"the plan has pick of shape {pick.shape} and displacement of shape "
            f"{displacement.shape}; give shapes ({wanted}) and ({wanted}, 3)"
        )
    _require_ids(pick, num_particles)
    require_known("displacement", displacement)
    return Actions(jnp.asarray(pick), jnp.asarray(displacement))


def _require_ids(pick: Array | np.ndarray, num_particles: int) -> None:
    if not jnp.issubdtype(pick.dtype, jnp.integer):
        raise ValueError(f"pick is an array of {pick.dtype}; give {IDS}")
    if isinstance(pick, jax.core.Tracer):
        return
    ids = np.asarray(pick)
    wrong = np.argwhere((ids < NONE) | (ids >= num_particles))
    if len(wrong):
        place = tuple(wrong[0].tolist())
        raise ValueError(
            f"pick{list(place)} is {ids[place]}; a body of {num_particles} particles has ids 0 to "
            f"{num_particles - 1}, and {NONE} grasps nothing: give one of these"
        )


def speed_profile(steps: int) -> Float[Array, " steps"]:
    """Fraction of a displacement in each time step: starts and ends at rest, sums to 1.

    The parabola 6 t (1 - t) of a cubic position profile, sampled at the middle of each step.
    """
    middle = (jnp.arange(steps) + 0.5) / steps
    speed = middle * (1.0 - middle)
    return speed / speed.sum()


def grasp(
    pickers: Pickers,
    rest: Float[Array, "N 3"],
    obstacles: Sequence[Obstacle],
    radius: Float[Array, ""],
    position: Float[Array, "N 3"],
    action: Actions,
) -> tuple[Bool[Array, " N"], Float[Array, "N 3"]]:
    """Held particles during an action, and their displacements.

    `grasp` clips displacements to the limits, pushes targets out of obstacles along the normal,
    and ends straight paths at the limits, or where they first touch an obstacle. If several
    pickers name a particle, the first one holds it. Two pickers violate the stretch rule,
    C(a) < 0 of Eq. 2, if their particles would end at `max_stretch` times their rest distance or
    farther; both then hold still, so a third may violate the rule too. (On a straight path the
    distance of two particles is convex in time, so it is never larger than at both ends.) A picker
    holds nothing if its id is not that of a particle, be it `NONE` or out of range.

    With a pinch, what else is between the fingers moves as the named particle does; the lowest of
    it stays out of the obstacles, and a particle between the fingers of several pickers is held by
    the one that names it, or else by the first.

    Args:
        pickers: limits of the pickers' motion.
        rest: rest coordinates of the body, metres.
        obstacles: rigid bodies at rest.
        radius: least distance of a particle from an obstacle, metres.
        position: positions of the particles, metres.
        action: one action, shapes (G,) and (G, 3).

    Returns:
        held: whether a picker holds each particle, shape (N,).
        displacement: displacement of each held particle, zero elsewhere, shape (N, 3), metres.
    """
    holds = _holds(action.pick, len(position))
    start = position[action.pick]
    named = holds[:, None] & (action.pick[:, None] == jnp.arange(len(position))[None])
    chosen = named
    if pickers.pinch is not None:
        chosen = _pinched(pickers.pinch, named, 2 * radius, start, position)
        lowest = jnp.where(chosen, position[None, :, 2], start[:, None, 2]).min(axis=1)
        radius = radius + start[:, 2] - lowest
    target = start + jnp.clip(action.displacement, -pickers.limits[None], pickers.limits[None])
    target = _outside(obstacles, radius, target)
    if not all(isinstance(each, Table) for each in obstacles):  # no path is through the table alone
        target = _cut(pickers, obstacles, radius, start, target)
    for _ in range(max(1, len(holds) - 1)):  # each pass that changes anything stops a picker
        allowed = _allowed(pickers, rest[action.pick], target, holds)
        target = jnp.where(allowed[:, None], target, start)
    moves = target - start
    return chosen.any(axis=0), chosen.T.astype(moves.dtype) @ moves


def _pinched(
    pinch: Pinch,
    named: Bool[Array, "G N"],
    thickness: Float[Array, ""],
    start: Float[Array, "G 3"],
    position: Float[Array, "N 3"],
) -> Bool[Array, "G N"]:
    """Whether each picker holds each particle; no particle is held by two."""
    x, y, z = jnp.moveaxis(position[None] - start[:, None], 2, 0)
    between = (x**2 + y**2 <= pinch.radius**2) & (
        jnp.abs(z) <= (pinch.layers + SPARE_LAYERS) * thickness
    )
    holds = named.any(axis=1, keepdims=True)
    wanted = named | (between & holds & ~named.any(axis=0)[None])
    first = jnp.cumsum(wanted, axis=0) == 1
    return wanted & first


def _outside(
    obstacles: Sequence[Obstacle], radius: Float[Array, "*G"], target: Float[Array, "G 3"]
) -> Float[Array, "G 3"]:
    """Targets pushed out of obstacles, one after another."""
    for obstacle in obstacles:
        distance, normal = obstacle.distance(*target.T)
        lifted = jnp.maximum(distance, radius)
        # In this order a height above the table is exactly `lifted`.
        moved = [
            jnp.where(distance < radius, (at - part * distance) + part * lifted, at)
            for at, part in zip(target.T, normal, strict=True)
        ]
        target = jnp.stack(moved, axis=1)
    return target


def _cut(
    pickers: Pickers,
    obstacles: Sequence[Obstacle],
    radius: Float[Array, "*G"],
    start: Float[Array, "G 3"],
    target: Float[Array, "G 3"],
) -> Float[Array, "G 3"]:
    """Ends of straight paths to targets: at the limits, or where they first touch an obstacle."""
    way = target - start
    excess = (jnp.abs(way) / pickers.limits[None]).max(axis=1, keepdims=True)
    target = start + way / jnp.maximum(excess, 1.0)  # what pushed it out may have been large
    for obstacle in obstacles:
        share = _clear_share(obstacle, radius, start, target)[:, None]
        target = jnp.where(share < 1.0, start + share * (target - start), target)
    return target


def _clear_share(
    obstacle: Obstacle,
    radius: Float[Array, "*G"],
    start: Float[Array, "G 3"],
    target: Float[Array, "G 3"],
) -> Float[Array, " G"]:
    """Share of straight paths up to their first touch with an obstacle; 1 without a touch.

    Newton's method on the clearance along the path, which is convex as obstacles are: from the
    start it goes to where the path meets the plane at the nearest point of the surface, which is
    never beyond the touch, however few the steps. A path that leads away from that plane is clear.
    """
    way = target - start

    def ahead(share: Float[Array, " G"]) -> Float[Array, " G"]:
        place = start + share[:, None] * way
        distance, normal = obstacle.distance(*place.T)
        clearance = distance - radius + GRAZE
        speed = sum(part * along for part, along in zip(normal, way.T, strict=True))
        enters = speed < -0.1 * GRAZE  # less on the rest of the path is grazing
        step = clearance / jnp.where(enters, -speed, 1.0)
        return jnp.where(enters, jnp.clip(share + step, 0.0, 1.0), 1.0)

    def stop(_: Int[Array, ""], share: Float[Array, " G"]) -> Float[Array, " G"]:
        return jax.lax.stop_gradient(ahead(share))

    # The last step has the derivative of the touch by the path (implicit function theorem).
    return ahead(jax.lax.fori_loop(0, TOUCHES, stop, jnp.zeros_like(way[:, 0])))


def _holds(pick: Int[Array, " G"], count: int) -> Bool[Array, " G"]:
    """Whether each picker holds a particle: it names one, and no earlier picker does."""
    earlier = jnp.tril(pick[:, None] == pick[None, :], k=-1).any(axis=1)
    return (pick >= 0) & (pick < count) & ~earlier


def _allowed(
    pickers: Pickers,
    rest: Float[Array, "G 3"],
    target: Float[Array, "G 3"],
    holds: Bool[Array, " G"],
) -> Bool[Array, " G"]:
    """Whether each picker's motion keeps the stretch rule with every other picker."""

    def squared_distances(points: Float[Array, "G 3"]) -> Float[Array, "G G"]:
        return jnp.sum((points[:, None] - points[None, :]) ** 2, axis=-1)

    too_far = squared_distances(target) >= pickers.max_stretch**2 * squared_distances(rest)
    others = holds[:, None] & holds[None, :] & ~jnp.eye(len(holds), dtype=bool)
    return ~(too_far & others).any(axis=1)
