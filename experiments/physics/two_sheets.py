"""A T-shirt of two sheets: dropped, folded by hand once across, and cut."""

from dataclasses import replace
from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from experiments.physics.measure import Positions, run
from experiments.physics.self_contact import cut
from jaxsimp import goals
from jaxsimp.bodies import Garment, t_shirt
from jaxsimp.dynamics import (
    NONE,
    Actions,
    Simulation,
    at_rest,
    largest_time_step,
    make_pickers,
    make_simulation,
)
from jaxsimp.viz import COLORS, draw_body

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d import Axes3D

CHILD = {
    "length": 0.5,
    "chest": 0.34,
    "sleeve_length": 0.14,
    "sleeve_width": 0.13,
    "neck_width": 0.14,
    "neck_depth": 0.05,
}
"""Dimensions of a child's T-shirt, metres."""
LINE = 0.1
"""Height of the fold's line below the middle of the T-shirt, as a fraction of its length."""
LAYERS = ("back, lower", "front, lower", "front, upper", "back, upper")
"""The layers of a folded T-shirt, from the table up."""
SPEED = 0.15
"""Mean speed of the hem while it is folded over, metres per second."""


def shirt(num_particles: int, size: float = 1.0) -> Garment:
    """A T-shirt of two sheets.

    Args:
        num_particles: number of particles of both sheets.
        size: factor on the dimensions of a child's: 0.5 for a doll's.
    """
    dimensions = {name: size * value for name, value in CHILD.items()}
    return t_shirt(**dimensions, num_particles=num_particles, sheets=2)


def simulation_of(garment: Garment, *, self_contact: bool = True) -> Simulation:
    """The simulation, at time steps of nine tenths of the largest, or 2 ms."""
    time_step = min(2e-3, 0.9 * largest_time_step(garment.body))
    return make_simulation(garment.body, time_step, self_contact=self_contact)


def on_seam(garment: Garment) -> Bool[np.ndarray, " N"]:
    """Whether front and back share each particle."""
    return garment.opposite == np.arange(garment.body.num_particles)


def is_front(garment: Garment) -> Bool[np.ndarray, " N"]:
    """Whether each particle is one of the front or of a seam; these have the lower ids."""
    count = garment.body.num_particles
    return np.arange(count) < (count + on_seam(garment).sum()) // 2


def from_seam(
    garment: Garment, position: Float[np.ndarray, "N D"], points: Float[np.ndarray, "P D"]
) -> Float[np.ndarray, " P"]:
    """Distances of points from the nearest particle of a seam, metres."""
    from scipy.spatial import cKDTree

    return cKDTree(position[on_seam(garment)]).query(points)[0]


# --- dropped -------------------------------------------------------------------------------------


def in_the_air(garment: Garment, seed: int) -> Positions:
    """A T-shirt of a smooth, random shape, turned and tilted, its lowest point 5 to 10 cm up.

    Front and back have the same waves, so that neither passes through the other: along each axis
    four of random directions, 0.7 to 2 times as long as the T-shirt is large, of 12 mm RMS across
    and 5 mm along the sheets. The front bulges by up to 0.4 of the distance from the seam, 2 cm
    at most. Tilted by up to 0.6 radians about either axis.
    """
    rng, body = np.random.default_rng(seed), garment.body
    flat = body.rest[:, :2]

    def waves(amplitude: float) -> np.ndarray:
        total = np.zeros(len(flat))
        for _ in range(4):
            along = rng.normal(size=2)
            along *= 2 * np.pi / body.size * rng.uniform(0.5, 1.5) / np.linalg.norm(along)
            total += rng.normal() * np.cos(flat @ along + rng.uniform(0, 2 * np.pi))
        return amplitude * total / np.sqrt(2)

    position = goals.flat(body)
    position[:, 2] += waves(0.012)
    position[:, :2] += np.stack([waves(0.005), waves(0.005)], axis=1)
    away = np.minimum(from_seam(garment, flat, flat), 0.05)
    position[:, 2] += np.where(is_front(garment), 0.2 * away * (1 + np.tanh(waves(1.0))), 0.0)
    turn, *tilt = rng.uniform(-1, 1, 3) * np.array([np.pi, 0.6, 0.6])
    position = goals.turn(position, turn)
    for axis, angle in enumerate(tilt):
        other = 1 - axis
        y, z = position[:, other].copy(), position[:, 2].copy()
        position[:, other] = np.cos(angle) * y - np.sin(angle) * z
        position[:, 2] = np.sin(angle) * y + np.cos(angle) * z
    position[:, 2] += rng.uniform(0.05, 0.10) + body.radius - position[:, 2].min()
    return position


def settled(simulation: Simulation, position: Positions, seconds: float) -> Positions:
    """Positions after being let lie, metres."""
    steps = round(seconds / float(simulation.time_step))
    pickers = make_pickers(steps=steps)
    nothing = Actions(jnp.full((1, 2), NONE), jnp.zeros((1, 2, 3)))
    final, _ = run(simulation, pickers, at_rest(position), nothing)
    return np.asarray(final.position, dtype=float)


# --- folded --------------------------------------------------------------------------------------


def fold_line(garment: Garment) -> float:
    """The y of the line about which `folded` folds a T-shirt that lies flat, metres."""
    return -LINE * float(np.ptp(garment.body.rest[:, 1]))


def folded(garment: Garment, simulation: Simulation) -> Positions:
    """A T-shirt laid flat and folded once across, its hem to its shoulders, and let lie.

    Two pickers grasp the hem at both sides, where front and back are sewn together, and carry it
    along half a circle about a line across the T-shirt, half-way up the four layers.

    Returns:
        Positions one second after they let go, shape (N, 3), metres.
    """
    body, landmarks, line = garment.body, garment.landmarks, fold_line(garment)
    start = settled(simulation, goals.flat(body), 1.0)
    picks = np.array([landmarks["left_hem"], landmarks["right_hem"]])
    y, z = (start[picks, 1:] - np.array([line, 2.1 * body.material.thickness])).T
    seconds = np.pi * np.abs(y).max() / SPEED
    pickers = make_pickers((0.2, 0.2, 0.2), steps=round(seconds / 16 / float(simulation.time_step)))
    angle = np.linspace(0, np.pi, 17)[:, None]
    over, up = np.cos(angle) * y + np.sin(angle) * z, np.cos(angle) * z - np.sin(angle) * y
    moves = np.diff(np.stack([np.zeros_like(over), over, up], axis=-1), axis=0)
    actions = Actions(jnp.tile(jnp.asarray(picks), (16, 1)), jnp.asarray(moves, dtype=float))
    state, _ = run(simulation, pickers, at_rest(start), actions)
    return settled(simulation, np.asarray(state.position), 1.0)


def layers(garment: Garment) -> list[Int[np.ndarray, "_ 3"]]:
    """Triangles of the `LAYERS` of a T-shirt folded by `folded`."""
    faces = garment.body.faces
    is_front = np.arange(len(faces)) < len(faces) // 2
    turned = garment.body.rest[faces, 1].mean(axis=1) < fold_line(garment)
    members = (~turned & ~is_front, ~turned & is_front, turned & is_front, turned & ~is_front)
    return [faces[each] for each in members]


def heights(
    faces: Int[np.ndarray, "F 3"], position: Positions, points: Float[np.ndarray, "P 2"]
) -> Float[np.ndarray, " P"]:
    """Height of a layer over each point of the table, metres; not a number where there is none.

    Where the layer covers a point more than once, its mean height.
    """
    a, b, c = position[faces][:, :, None].transpose(1, 0, 2, 3)
    away, first, second = points[None] - a[..., :2], (b - a)[..., :2], (c - a)[..., :2]

    def cross(one: np.ndarray, other: np.ndarray) -> np.ndarray:
        return one[..., 0] * other[..., 1] - one[..., 1] * other[..., 0]

    with np.errstate(divide="ignore", invalid="ignore"):
        v = cross(away, second) / cross(first, second)
        w = cross(first, away) / cross(first, second)
        covers = (v >= 0) & (w >= 0) & (v + w <= 1)
        height = a[..., 2] + v * (b - a)[..., 2] + w * (c - a)[..., 2]
        return np.where(covers, height, 0).sum(axis=0) / covers.sum(axis=0)


def gaps_of_layers(
    garment: Garment, position: Positions
) -> tuple[Float[np.ndarray, "P 2"], Float[np.ndarray, "3 P"]]:
    """Where all four layers of a folded T-shirt lie, and the gaps between them.

    Returns:
        Points of a lattice of 1 cm, and the height of each of the `LAYERS` but the lowest above
        the one below it, metres.
    """
    low, high = position[:, :2].min(axis=0), position[:, :2].max(axis=0)
    x, y = (np.arange(*ends, 0.01) for ends in zip(low, high, strict=True))
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    height = np.stack([heights(layer, position, points) for layer in layers(garment)])
    covered = np.isfinite(height).all(axis=0)
    return points[covered], np.diff(height[:, covered], axis=0)


# --- the figure ----------------------------------------------------------------------------------


def plot_two_sheets(quick: bool) -> "tuple[Figure, str]":
    """A T-shirt in the air, dropped and folded, and the fold cut."""
    import matplotlib.pyplot as plt

    garment = shirt(900, 0.5) if quick else shirt(6000)
    simulation = simulation_of(garment)
    air = in_the_air(garment, 0)
    dropped, fold = settled(simulation, air, 2.0), folded(garment, simulation)
    figure = plt.figure(figsize=(9.6, 3.9), layout="constrained")
    grid = figure.add_gridspec(2, 3, height_ratios=[2.2, 1])
    shown = {"In the air": air, "Dropped": dropped, "Folded once across": fold}
    for column, (name, position) in enumerate(shown.items()):
        axes = figure.add_subplot(grid[0, column], projection="3d")
        _draw(axes, garment, position, name)
    _draw_cut(figure.add_subplot(grid[1, :]), garment, fold)
    points, gaps = gaps_of_layers(garment, fold)
    in_order = (gaps > 0).all(axis=0)
    median = ", ".join(f"{1e3 * gap:.1f}" for gap in np.median(gaps, axis=1))
    return figure, (
        f"{garment.body.num_particles} particles; folded, layers are in order at {in_order.sum()} "
        f"of {len(points)} points, median gaps {median} mm"
    )


def _draw(axes: "Axes3D", garment: Garment, position: Positions, name: str) -> None:
    """Draw a T-shirt with equal scales, without axes."""
    draw_body(axes, garment.body, position, COLORS[0])
    low, high = position.min(axis=0), position.max(axis=0)
    high[2] = max(high[2], low[2] + 0.02)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(high - low, zoom=1.05)
    axes.view_init(elev=40, azim=-60)
    axes.set_axis_off()
    axes.set_title(name, fontsize="medium")


def _draw_cut(axes: "Axes", garment: Garment, position: Positions) -> None:
    """Draw the cut in the middle plane of the T-shirt, front and back in two colours."""
    body, half = garment.body, len(garment.body.faces) // 2
    place, normal = np.array([0.001, 0.0, 0.0]), np.array([1.0, 0.0, 0.0])  # beside particles
    sheets = ("front", slice(half), COLORS[1]), ("back", slice(half, None), COLORS[2])
    for name, part, color in sheets:
        sheet = replace(body, faces=body.faces[part])
        for number, ends in enumerate(1e3 * cut(sheet, position, place, normal)):
            label = name if number == 0 else None
            axes.plot(*ends[:, 1:].T, color=color, lw=1.2, solid_capstyle="round", label=label)
    axes.set(xlabel="y (mm), in the middle plane", ylabel="z (mm), × 3", aspect=3, ylim=(0, None))
    axes.legend(frameon=False, fontsize="small", loc="center left", bbox_to_anchor=(1, 0.5))
