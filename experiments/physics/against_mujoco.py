"""The same cloth in ours and as a MuJoCo flex: hanging at rest, and folded by the same plan."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from experiments.physics.measure import Positions, hang, rms, upright
from experiments.scripted import scripted_plan
from jaxsimp import goals
from jaxsimp.bodies import Body, cloth
from jaxsimp.dynamics import Actions
from jaxsimp.engines import MassSprings, replay
from jaxsimp.engines.mujoco import make_model
from jaxsimp.tasks import Episode, Task, make_task, score
from jaxsimp.viz import COLORS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

OURS, TOUCHING, MUJOCO = "ours", "ours with self-contact", "MuJoCo (full)"
STYLES = {OURS: (COLORS[0], "-"), TOUCHING: (COLORS[2], "-"), MUJOCO: (COLORS[1], "--")}
"""Color and line of each engine."""
STIFFER = 10.0
"""Factor on stiffness in the second comparison of hanging cloths."""


# --- hanging -------------------------------------------------------------------------------------


def hang_in_mujoco(body: Body, start: Positions, held: Sequence[int], seconds: float) -> Positions:
    """Positions of a flex of the full variant after hanging from some of its particles, metres.

    Args:
        body: body to hang.
        start: positions at the start, at rest, metres.
        held: ids of particles that stay in place.
        seconds: duration, seconds.

    Raises:
        RuntimeError: if MuJoCo warned.
    """
    import mujoco

    model = make_model(body, "full", held, obstacles=())
    data = mujoco.MjData(model)
    data.qpos[:] = (start - body.rest).ravel()
    for particle in held:
        name = f"picker_{particle}"
        data.mocap_pos[model.body(name).mocapid[0]] = start[particle]
        data.eq_active[model.equality(name).id] = 1
    for _ in range(round(seconds / model.opt.timestep)):
        mujoco.mj_step(model, data)
    if any(warning.number for warning in data.warning):
        raise RuntimeError("MuJoCo warned while a cloth was hanging")
    return body.rest + data.qpos.reshape(-1, 3)


@dataclass(frozen=True, eq=False)
class Hanging:
    """A way to hang a cloth of n × n particles.

    Attributes:
        held: ids of the held particles.
        start: positions at the start, at rest, shape (N, 3), metres.
        across: direction to the right in the figure, shape (3,).
    """

    held: list[int]
    start: Positions
    across: Float[np.ndarray, "3"]


def ways_to_hang(body: Body) -> dict[str, Hanging]:
    """Hanging from an edge, two corners of one, and opposite corners; these two start flat."""
    grid = np.arange(body.num_particles).reshape(body.shape)
    flat = goals.flat(body) + np.array([0.0, 0.0, 1.0])
    along, diagonal = np.array([0.0, 1.0, 0.0]), np.array([1.0, 1.0, 0.0]) / np.sqrt(2)
    return {
        "an edge": Hanging(grid[-1].tolist(), upright(body), along),
        "two corners": Hanging(grid[-1, [0, -1]].tolist(), flat, along),
        "opposite corners": Hanging([int(grid[0, 0]), int(grid[-1, -1])], flat, diagonal),
    }


def stiffened(body: Body, factor: float) -> Body:
    """A body with stiffer springs, and the same ratio of damping to critical damping."""
    return body.scaled(stiffness=factor, damping=float(np.sqrt(factor)))


def hung(body: Body, seconds: float) -> dict[str, dict[str, Positions]]:
    """Positions by the way of hanging, and by engine, with five times the body's air drag."""
    slowed = body.scaled(drag=5.0)
    return {
        name: {
            OURS: hang(slowed, way.start, way.held, seconds),
            MUJOCO: hang_in_mujoco(slowed, way.start, way.held, seconds),
        }
        for name, way in ways_to_hang(body).items()
    }


# --- folding -------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Fold:
    """A cloth after a hand-made plan, settled.

    Attributes:
        position: positions, shape (N, 3), metres, in the frame of its flat start.
        score: score in its task.
    """

    position: Positions
    score: float


def folds(name: str, resolution: int, seed: int = 0) -> dict[str, Fold]:
    """The scripted plan of a task carried out in ours, ours with self-contact, and MuJoCo.

    Args:
        name: name of the task.
        resolution: number of particles along a side.
        seed: seed of the start, a random turn.
    """
    task = make_task(name, resolution)
    episode = task.episode_fn(seed)
    plan = scripted_plan(task, episode)
    found = {
        OURS: carry_out(task, episode, plan, self_contact=False),
        TOUCHING: carry_out(task, episode, plan, self_contact=True),
    }
    (replayed,) = replay(task, [episode], [plan], "full")
    found[MUJOCO] = replayed.positions[-1]
    start = np.asarray(episode.start, dtype=float)
    return {
        engine: Fold(
            unturned(task.body, start, position),
            float(score(task, episode, jnp.asarray(position, dtype=float))),
        )
        for engine, position in found.items()
    }


def carry_out(task: Task, episode: Episode, plan: Actions, *, self_contact: bool) -> Positions:
    """Settled positions after a plan in our dynamics, metres."""
    done = MassSprings(self_contact).executor(task)(episode, plan)
    return done.positions[-1].astype(float)


def unturned(body: Body, start: Positions, position: Positions) -> Positions:
    """Positions after the turn about the vertical that takes the start to the body at rest."""
    first, last = start[0, :2], start[-1, :2]
    rest = body.rest[-1, :2] - body.rest[0, :2]
    away = last - first
    angle = np.arctan2(rest[1], rest[0]) - np.arctan2(away[1], away[0])
    return goals.turn(position, float(angle))


def middle(body: Body, diagonal: bool) -> Int[np.ndarray, " n"]:
    """Particles along the cut perpendicular to the crease, through the middle of a square cloth."""
    grid = np.arange(body.num_particles).reshape(body.shape)
    return np.diagonal(grid) if diagonal else grid[:, len(grid) // 2]


def along_cut(
    body: Body, cut: Int[np.ndarray, " M"], position: Float[np.ndarray, "M 3"]
) -> Float[np.ndarray, " M"]:
    """Coordinate of positions along the line of a cut in the body at rest, from its middle.

    Args:
        body: a cloth.
        cut: ids of its particles along that line.
        position: positions of these particles, in any unit.
    """
    line = body.rest[cut[-1], :2] - body.rest[cut[0], :2]
    return position[:, :2] @ (line / np.linalg.norm(line))


# --- the figure ----------------------------------------------------------------------------------


def plot_mujoco(quick: bool) -> "tuple[Figure, str]":
    """Hanging cloths in a row, and cuts through folds below each other."""
    import matplotlib.pyplot as plt

    resolution, seconds = (5, 0.1) if quick else (25, 4.0)
    body = cloth((resolution, resolution))
    figure = plt.figure(figsize=(8.4, 7.2), layout="constrained")
    parts = figure.add_gridspec(2, 1, height_ratios=[1.35, 1])
    lines = _draw_hanging(figure.add_subfigure(parts[0]), body, seconds)
    names = ("cloth_side_folding", "cloth_diagonal_folding")[: 1 if quick else 2]
    rows = figure.add_subfigure(parts[1]).subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
    for axes, name in zip(rows, names, strict=True):
        lines.append(_draw_folds(axes, name, body))
    rows[-1].set_xlabel("along the cut (mm)")
    return figure, "; ".join(lines)


def _draw_hanging(figure: "SubFigure", body: Body, seconds: float) -> list[str]:
    """Draw the hanging cloth, one axes per way; and the engines' differences, in words."""
    ways, shapes = ways_to_hang(body), hung(body, seconds)
    stiff = hung(stiffened(body, STIFFER), seconds)
    half = [1e3 * 1.08 * np.abs(way.start @ way.across).max() for way in ways.values()]
    row = figure.subplots(1, len(ways), sharey=True, width_ratios=half)
    lines = []
    for axes, (name, way), width in zip(row, ways.items(), half, strict=True):
        top = way.start[way.held[0], 2]
        for engine, position in shapes[name].items():
            seen = np.stack([position @ way.across, position[:, 2] - top], axis=1)
            _draw_grid(axes, 1e3 * seen.reshape(*body.shape, 2), engine)
        soft, hard = (1e3 * rms(each[name][OURS] - each[name][MUJOCO]) for each in (shapes, stiff))
        axes.set_title(
            f"From {name}:\n{soft:.1f} mm RMS apart\n({hard:.1f} mm if {STIFFER:g} × as stiff)",
            fontsize="medium",
        )
        axes.set(xlabel="across (mm)", aspect="equal", xlim=(-width, width))
        lowest = [1e3 * (top - each[:, 2].min()) for each in shapes[name].values()]
        lines.append(
            f"from {name}: lowest {lowest[0]:.0f} mm below in ours, {lowest[1]:.0f} in MuJoCo, "
            f"{soft:.1f} mm RMS apart, {hard:.1f} if {STIFFER:g} times as stiff"
        )
    row[0].set_ylabel("height over what is held (mm)")
    row[-1].legend(frameon=False, loc="lower center", ncols=2, fontsize="small")
    return lines


def _draw_grid(axes: "Axes", seen: Float[np.ndarray, "n n 2"], engine: str) -> None:
    """Draw some lines of a cloth's grid, with its outline."""
    color, line = STYLES[engine]
    every = max(1, (len(seen) - 1) // 6)
    for lines in (seen[::every], seen[:, ::every].swapaxes(0, 1)):
        for points in lines:
            axes.plot(*points.T, line, color=color, lw=0.8)
    axes.lines[-1].set_label(engine)


def _draw_folds(axes: "Axes", name: str, body: Body) -> str:
    """Draw cuts through a fold in every engine; and scores and distances from MuJoCo, in words."""
    found = folds(name, body.shape[0])
    cut = middle(body, "diagonal" in name)
    words = []
    for engine, fold in found.items():
        color, line = STYLES[engine]
        place = 1e3 * fold.position[cut]
        along = along_cut(body, cut, place)
        label = f"{engine}: {fold.score:.3f}"
        axes.plot(along, place[:, 2], line, color=color, marker=".", ms=4, lw=1, label=label)
        apart = 1e3 * rms(fold.position - found[MUJOCO].position)
        words.append(label + (f" ({apart:.1f} mm RMS from MuJoCo)" if engine != MUJOCO else ""))
    title = f"{name.split('_')[1].capitalize()} fold"
    axes.set_title(f"{title}, cut through the middle, and scores", fontsize="medium")
    axes.set(ylabel="z (mm)", aspect="equal", ylim=(0, 32))
    axes.legend(frameon=False, fontsize="small", loc="upper right")
    return f"{title.lower()}, scores: " + ", ".join(words)
