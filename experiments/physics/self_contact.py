"""A cloth folded twice, with self-contact and without, and the distances of its layers."""

from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from experiments.physics.measure import Positions, run
from jaxsimp import goals
from jaxsimp.bodies import Body, cloth
from jaxsimp.dynamics import (
    NONE,
    Actions,
    at_rest,
    largest_time_step,
    make_pickers,
    make_simulation,
)
from jaxsimp.viz import COLORS, GOAL_COLOR, draw_body

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d import Axes3D

LEAST = 0.8
"""Smallest distance wanted of particles in a settled stack, in thicknesses."""
STYLES = {False: ("without self-contact", COLORS[0]), True: ("with self-contact", COLORS[2])}
"""Name and color, by whether the cloth touches itself."""


def folded_twice(
    resolution: int, *, self_contact: bool, share: float = 0.95, lift: float = 0.1
) -> tuple[Positions, int]:
    """A square cloth folded along one diagonal, the x axis, then the other, and settled.

    Args:
        resolution: number of particles along a side.
        self_contact: whether the cloth touches itself.
        share: displacement of a corner, as a fraction of the way to the opposite corner.
        lift: height of the lift, metres.

    Returns:
        Positions, shape (N, 3), metres, and the number of tunnelled contacts.
    """
    body = cloth((resolution, resolution))
    time_step = min(2e-3, 0.9 * largest_time_step(body))
    simulation = make_simulation(body, time_step, self_contact=self_contact)
    pickers = make_pickers((0.2, 0.2, 0.2), steps=round(0.25 / time_step))
    corners = np.arange(resolution**2).reshape(resolution, resolution)[[0, 0, -1, -1], [0, -1] * 2]
    state = at_rest(goals.flat(body, np.pi / 4))
    for picked, target in ((corners[0], corners[3]), (corners[1], corners[2])):
        position = np.asarray(state.position, dtype=float)
        moves = np.zeros((8, 2, 3))
        moves[:4, 0] = over(share * (position[target] - position[picked]), lift, 3 * body.radius)
        picks = np.full((8, 2), NONE)
        picks[:4, 0] = picked
        actions = Actions(jnp.asarray(picks), jnp.asarray(moves, dtype=float))
        state, _ = run(simulation, pickers, state, actions)
    return np.asarray(state.position, dtype=float), int(state.missed)


def over(way: Float[np.ndarray, "3"], lift: float, gap: float) -> Float[np.ndarray, "4 3"]:
    """Displacements of four actions: up and half the way, then down to a gap above the end."""
    up, down = way / 2 + [0, 0, lift], way / 2 - [0, 0, lift - gap]
    return np.stack([up / 2, up / 2, down / 2, down / 2])


# --- distances -----------------------------------------------------------------------------------


def nearest_particles(
    body: Body, position: Positions, may_touch: Bool[np.ndarray, "N N"]
) -> Float[np.ndarray, " N"]:
    """Distance from each particle to the nearest one that can touch it, metres.

    Args:
        body: a sheet.
        position: positions, metres.
        may_touch: pairs of particles that are not adjacent.
    """
    return np.where(may_touch, _distances(position), np.inf).min(axis=1)


def nearest_triangles(
    body: Body, position: Positions, may_touch: Bool[np.ndarray, "N N"]
) -> Float[np.ndarray, " N"]:
    """Distance from each particle to the nearest triangle whose corners can all touch it, metres.

    Args:
        body: a sheet.
        position: positions, metres.
        may_touch: pairs of particles that are not adjacent.
    """
    from trimesh.triangles import closest_point

    particle, face = np.nonzero(may_touch[:, body.faces].all(axis=2))
    closest = closest_point(position[body.faces[face]], position[particle])
    found = np.full(len(position), np.inf)
    np.minimum.at(found, particle, np.linalg.norm(closest - position[particle], axis=1))
    return found


def _distances(points: Positions) -> Float[np.ndarray, "N N"]:
    return np.linalg.norm(points[:, None] - points[None], axis=-1)


def cut(
    body: Body,
    position: Positions,
    place: Float[np.ndarray, "3"],
    normal: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "M 2 3"]:
    """Line segments in which a plane cuts the triangles of a body: their ends, metres.

    Args:
        body: a sheet.
        position: positions, metres.
        place: point of the plane, metres.
        normal: normal of the plane.
    """
    from trimesh import Trimesh
    from trimesh.intersections import mesh_plane

    return np.asarray(mesh_plane(Trimesh(position, body.faces, process=False), normal, place))


# --- the figure ----------------------------------------------------------------------------------


def plot_self_contact(quick: bool) -> "tuple[Figure, str]":
    """The cloth in 3-D and cut, without and with self-contact; and the distances of its layers."""
    import matplotlib.pyplot as plt

    resolution = 9 if quick else 25
    body = cloth((resolution, resolution))
    figure = plt.figure(figsize=(9.6, 3.7), layout="constrained")
    parts = figure.add_gridspec(1, 2, width_ratios=[1.7, 1])
    left, shares = figure.add_subfigure(parts[0]), figure.add_subfigure(parts[1]).subplots()
    grid = left.add_gridspec(2, 2, height_ratios=[2.6, 1])
    lines = []
    for column, (touches, (name, color)) in enumerate(STYLES.items()):
        position, missed = folded_twice(resolution, self_contact=touches)
        _draw_body(left.add_subplot(grid[0, column], projection="3d"), body, position, name, color)
        _draw_cut(left.add_subplot(grid[1, column]), body, position, color)
        words = _draw_distances(shares, body, position, name, color)
        lines.append(
            f"{name}: {1e3 * np.ptp(position[:, 2]):.0f} mm high, {missed} tunnelled, {words}"
        )
    shares.axvline(LEAST, color=GOAL_COLOR, lw=1)
    shares.text(LEAST + 0.04, 0.97, f"{LEAST:.0%}", color="#666666", va="top")
    shares.set(xlim=(0, 3), ylim=(0, 1), xlabel="distance to the nearest / thickness")
    shares.set_ylabel("share of particles")
    shares.legend(frameon=False, fontsize="small", loc="lower right")
    return figure, "; ".join(lines)


def _draw_body(axes: "Axes3D", body: Body, position: Positions, name: str, color: str) -> None:
    """Draw the cloth, seen from the loose corners, with equal scales, without axes."""
    draw_body(axes, body, position, color)
    low, high = position.min(axis=0), position.max(axis=0)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(high - low, zoom=1.05)
    axes.view_init(elev=50, azim=-50)
    axes.set_axis_off()
    axes.set_title(name.capitalize(), fontsize="medium")


def _draw_cut(axes: "Axes", body: Body, position: Positions, color: str) -> None:
    """Draw the cut in the plane along the first crease through the mean of all particles."""
    place = position.mean(axis=0)
    for ends in 1e3 * cut(body, position, place, np.array([0.0, 1.0, 0.0])):
        axes.plot(*ends[:, [0, 2]].T, color=color, lw=1.2, solid_capstyle="round")
    axes.set(xlabel="along the first crease (mm)", ylabel="z (mm)", aspect="equal")
    axes.set(xlim=(-35, 160), ylim=(0, 30))


def _draw_distances(axes: "Axes", body: Body, position: Positions, name: str, color: str) -> str:
    """Draw the fraction of particles closer than each distance; and return it in words."""
    touching = make_simulation(body, 1e-3, self_contact=True).self_contact
    assert touching is not None
    words = []
    for line, what, measure in (
        ("-", "particle", nearest_particles),
        ("--", "triangle", nearest_triangles),
    ):
        found = measure(body, position, touching.may_touch) / (2 * body.radius)
        axes.ecdf(found, color=color, ls=line, label=f"{name.split()[0]}, {what}")
        words.append(
            f"nearest {what} at least {found.min():.2f} and in the median {np.median(found):.2f} "
            f"thicknesses off, closer than {LEAST:g} for {np.mean(found < LEAST):.1%}"
        )
    return ", ".join(words)
