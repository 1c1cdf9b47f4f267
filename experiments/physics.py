"""Figures of docs/physics.md: `python -m experiments.physics`."""

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Float

from jaxsimp import goals
from jaxsimp.body import Body, cloth, rope
from jaxsimp.dynamics import (
    NONE,
    Actions,
    State,
    at_rest,
    largest_time_step,
    make_pickers,
    make_simulation,
    rollout,
)
from jaxsimp.dynamics.step import Motion, pack, unpack
from jaxsimp.dynamics.steps import plain_steps
from jaxsimp.viz import COLORS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

GRAVITY = 9.81
HIGH = np.array([0.0, 0.0, 1.0])
"""Lift that keeps a swinging body off the table, metres."""

run = jax.jit(rollout, static_argnames=("observe", "adjoint"))


@dataclass(frozen=True)
class Options:
    """Figures of the physics page: convergence in time and in resolution, and energy."""

    out: Path = Path("docs/figures")
    """Folder of the figures, made where it is not there."""
    quick: bool = False
    """Smaller bodies and shorter motions: for tests."""
    only: tuple[str, ...] = ()
    """Names of the figures that are made; all by default."""


def swing(body: Body, time_step: float, seconds: float, frames: int) -> State:
    """States while the body swings from its first particle, off the table, a first axis `frames`.

    Args:
        body: flat and at rest at first.
        time_step: about what is taken, seconds: a whole number of them fills a frame.
        seconds: of the whole motion.
        frames: states that are kept.
    """
    steps = round(seconds / frames / time_step)
    simulation = make_simulation(body, seconds / frames / steps, GRAVITY)
    hold = Actions(jnp.zeros((frames, 1), dtype=int), jnp.zeros((frames, 1, 3)))
    start = at_rest(goals.flat(body) + HIGH)
    pickers = make_pickers(steps=steps)
    return run(simulation, pickers, start, hold, observe=_whole, adjoint=False)[1]


def _whole(state: State) -> State:
    return state


# --- the time step -------------------------------------------------------------------------------


def time_step_errors(
    body: Body, seconds: float, divisors: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Time steps, and RMS errors of a swing's end at each of them, metres.

    The truth is extrapolated from time steps 4 and 8 times shorter than the shortest, as from a
    method of first order, in float64.

    Args:
        body: that swings.
        seconds: of the swing.
        divisors: of nine tenths of the largest stable time step.
    """
    with jax.enable_x64(True):
        coarsest = seconds / np.ceil(seconds / (0.9 * largest_time_step(body)))

        def end(divisor: int) -> np.ndarray:
            return np.asarray(swing(body, coarsest / divisor, seconds, 1).position[0])

        last = max(divisors)
        truth = 2 * end(8 * last) - end(4 * last)
        errors = [rms(end(divisor) - truth) for divisor in divisors]
    return coarsest / np.array(divisors), np.array(errors)


def rms(difference: Float[np.ndarray, "*T N 3"]) -> float:
    """Root-mean-square length of differences, in their unit."""
    return float(np.sqrt((difference**2).sum(axis=-1).mean()))


def order(steps: np.ndarray, errors: np.ndarray) -> float:
    """Slope of the logarithm of errors over that of steps, by least squares."""
    return float(np.polyfit(np.log(steps), np.log(errors), 1)[0])


def plot_time_step(quick: bool) -> "tuple[Figure, str]":
    """Error over the time step, for a swinging rope and a swinging cloth."""
    import matplotlib.pyplot as plt
    from matplotlib.ticker import LogLocator, NullLocator

    bodies = {"rope": rope(9 if quick else 21), "cloth": cloth((5, 5) if quick else (13, 13))}
    divisors, seconds = ((1, 2, 4), 0.1) if quick else ((1, 2, 4, 8, 16), 0.4)
    figure, axes = plt.subplots(figsize=(4.6, 3.6), layout="constrained")
    lines = []
    for color, (name, body) in zip(COLORS, bodies.items(), strict=False):
        steps, errors = time_step_errors(body, seconds, divisors)
        axes.loglog(1e3 * steps, 1e3 * errors, "o-", color=color, label=name)
        lines.append(f"{name}: {errors[0]:.2g} m at {steps[0]:.2g} s, {_orders(steps, errors)}")
    ends = 1e3 * steps[[0, -1]]
    axes.loglog(ends, 0.5 * 1e3 * errors[0] * ends / ends[0], "k--", label="order 1")
    axes.set(xlabel="time step (ms)", ylabel="RMS error (mm)", title=f"{seconds:g} s of a swing")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_locator(NullLocator())
    axes.legend(frameon=False)
    return figure, "; ".join(lines)


def _orders(steps: np.ndarray, errors: np.ndarray) -> str:
    return f"order {order(steps[-3:], errors[-3:]):.2f} at the short steps"


# --- resolution ----------------------------------------------------------------------------------


def folded(resolution: int, side: float = 0.3) -> np.ndarray:
    """A cloth after two pickers carried one side over onto the other, shape (n, n, 3), metres.

    Args:
        resolution: particles a side, `n`.
        side: of the square, metres.
    """
    body = cloth((resolution, resolution), (side, side))
    time_step = min(2e-3, 0.9 * largest_time_step(body))
    corners = jnp.array([[0, resolution - 1]] * 2 + [[NONE, NONE]] * 4)
    carry = np.zeros((6, 2, 3))
    carry[:2] = np.array([[side / 2, 0.0, 0.1], [side / 2, 0.0, -0.1]])[:, None]
    pickers = make_pickers((side,) * 3, steps=round(0.4 / time_step))
    actions = Actions(corners, jnp.asarray(carry, dtype=float))
    start = at_rest(goals.flat(body))
    final, _ = run(make_simulation(body, time_step), pickers, start, actions, adjoint=False)
    return np.asarray(final.position).reshape(resolution, resolution, 3)


def hanging(resolution: int, seconds: float = 4.0, side: float = 0.3) -> np.ndarray:
    """A cloth that hangs at rest from its upper edge, shape (n, n, 3), metres.

    Args:
        resolution: particles a side, `n`.
        seconds: that it is given to come to rest, in air that slows it five times as much.
        side: of the square, metres.
    """
    body = cloth((resolution, resolution), (side, side), drag=15.0)
    time_step = min(2e-3, 0.9 * largest_time_step(body))
    simulation, x, y = make_simulation(body, time_step, GRAVITY), *body.rest.T[:2]
    start = at_rest(np.stack([0 * x, y, 1.0 + x], axis=1))
    motion = Motion(jnp.asarray(x > side / 2 - 1e-6), jnp.zeros((3, len(x))))
    shares = jnp.zeros(round(seconds / time_step))
    final = unpack(simulation, hold(simulation, pack(simulation, start), motion, shares))
    return np.asarray(final.position).reshape(resolution, resolution, 3)


hold = jax.jit(plain_steps)


def apart(shapes: dict[int, np.ndarray]) -> str:
    """RMS distances from the finest shape, at the particles of the coarsest, in words."""
    coarse, finest = min(shapes) - 1, max(shapes)
    shared = {n: shape[:: (n - 1) // coarse, :: (n - 1) // coarse] for n, shape in shapes.items()}
    return ", ".join(
        f"{n} × {n} to {finest} × {finest} {rms(shared[n] - shared[finest]):.2g} m"
        for n in shapes
        if n != finest
    )


def plot_resolution(quick: bool) -> "tuple[Figure, str]":
    """The same cloth at several resolutions: hanging from an edge, and folded."""
    import matplotlib.pyplot as plt

    resolutions = (5, 9, 17) if quick else (13, 25, 49)
    hung = {n: hanging(n, 0.5 if quick else 4.0) for n in resolutions}
    folds = {n: folded(n) for n in resolutions}
    figure, (left, right) = plt.subplots(
        1, 2, figsize=(8.4, 3.4), layout="constrained", width_ratios=[1, 2]
    )
    for color, n in zip(COLORS, resolutions, strict=False):
        _draw_outline(left, 1e3 * hung[n], color)
        x, _, z = 1e3 * folds[n][:, n // 2].T
        right.plot(x, z, ".-", color=color, ms=4, label=f"{n} × {n}")
    left.set(xlabel="y (mm)", ylabel="z (mm)", title="Hanging", aspect="equal")
    right.set(xlabel="x (mm)", ylabel="z (mm)", title="Folded, cut along the middle")
    right.legend(frameon=False)
    return figure, f"hanging: {apart(hung)}; folded: {apart(folds)}"


def _draw_outline(axes: "Axes", shape: np.ndarray, color: str) -> None:
    """The four sides of a cloth, seen along x."""
    sides = np.concatenate([shape[0], shape[:, -1], shape[-1, ::-1], shape[::-1, 0]])
    axes.plot(*sides[:, 1:].T, color=color, lw=1)


# --- energy --------------------------------------------------------------------------------------


def energy(body: Body, states: State) -> Float[np.ndarray, " T"]:
    """Kinetic, elastic and potential energy of states along a first axis, joules."""
    x, v = np.asarray(states.position, float), np.asarray(states.velocity, float)
    ends = x[:, body.springs]
    stretch = np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=-1) - body.rest_length
    elastic = (body.stiffness * stretch**2).sum(axis=-1) / 2
    kinetic = (body.mass * (v**2).sum(axis=-1)).sum(axis=-1) / 2
    return kinetic + elastic + GRAVITY * (body.mass * x[..., 2]).sum(axis=-1)


def energies(body: Body, part: float, seconds: float, frames: int) -> np.ndarray:
    """Energy of a swing less that of its start, over the weight times the body's size.

    Args:
        body: that swings.
        part: of the largest stable time step that is taken.
        seconds: of the swing.
        frames: at which energy is taken.
    """
    with jax.enable_x64(True):
        states = swing(body, part * largest_time_step(body), seconds, frames)
        found = energy(body, states)
        start = at_rest(goals.flat(body) + HIGH)
        first = energy(body, jax.tree.map(lambda leaf: leaf[None], start))
    return (found - first) / (GRAVITY * body.mass.sum() * body.size)


def plot_energy(quick: bool) -> "tuple[Figure, str]":
    """Energy of a swinging rope over time: undamped at several time steps, and damped."""
    import matplotlib.pyplot as plt

    damped = rope(9 if quick else 21)
    undamped = replace(damped, damping=0.0 * damped.damping, drag=0.0)
    seconds, frames = (0.5, 10) if quick else (10.0, 400)
    cases = {
        "undamped, 0.9 of the largest step": (undamped, 0.9),
        "undamped, 0.45": (undamped, 0.45),
        "undamped, 0.1": (undamped, 0.1),
        "default damping and drag, 0.9": (damped, 0.9),
    }
    time = seconds / frames * np.arange(1, frames + 1)
    figure, axes = plt.subplots(figsize=(6.4, 3.4), layout="constrained")
    lines = []
    for color, (name, (body, part)) in zip(COLORS, cases.items(), strict=True):
        found = energies(body, part, seconds, frames)
        axes.plot(time, found, color=color, lw=1, label=name)
        lines.append(f"{name}: from {found.min():.2g} to {found.max():.2g}, last {found[-1]:.2g}")
    axes.set(xlabel="time (s)", ylabel="change of energy / (weight × length)")
    axes.set_title("A rope that swings from one end")
    axes.legend(frameon=False, loc="center right", bbox_to_anchor=(1.0, 0.3))
    return figure, "; ".join(lines)


FIGURES: "dict[str, Callable[[bool], tuple[Figure, str]]]" = {
    "time_step": plot_time_step,
    "resolution": plot_resolution,
    "energy": plot_energy,
}
"""What is drawn, by the name of the figure; each comes with a line of its numbers."""


def main(options: Options | None = None) -> int:
    """Write the figures, and print their numbers; the exit status."""
    import matplotlib.pyplot as plt

    options = options or tyro.cli(Options, description=Options.__doc__)
    unknown = set(options.only) - FIGURES.keys()
    if unknown:
        print(f"no figure {', '.join(sorted(unknown))}; choose from {', '.join(FIGURES)}")
        return 2
    options.out.mkdir(parents=True, exist_ok=True)
    for name in options.only or FIGURES:
        figure, numbers = FIGURES[name](options.quick)
        figure.savefig(options.out / f"physics_{name}.png", dpi=110)
        plt.close(figure)
        print(f"{name}: {numbers}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
