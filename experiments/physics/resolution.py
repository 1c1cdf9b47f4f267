"""The same cloth at several resolutions: hanging from an edge, and folded."""

from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np

from experiments.physics.measure import hang, rms, run, upright
from jaxsimp import goals
from jaxsimp.bodies import cloth
from jaxsimp.dynamics import (
    NONE,
    Actions,
    at_rest,
    largest_time_step,
    make_pickers,
    make_simulation,
)
from jaxsimp.viz import COLORS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def folded(resolution: int, side: float = 0.3) -> np.ndarray:
    """Positions of a cloth after two pickers folded it in half, shape (n, n, 3), metres.

    Args:
        resolution: number of particles along a side, `n`.
        side: side of the square, metres.
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
    """Positions of a cloth that hangs at rest from its upper edge, shape (n, n, 3), metres.

    Args:
        resolution: number of particles along a side, `n`.
        seconds: time to come to rest, seconds, with five times the body's air drag.
        side: side of the square, metres.
    """
    body = cloth((resolution, resolution), (side, side), drag=15.0)
    edge = range(resolution * (resolution - 1), resolution**2)
    return hang(body, upright(body), edge, seconds).reshape(resolution, resolution, 3)


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
        1, 2, figsize=(8.4, 3.4), layout="constrained", width_ratios=[1, 1.7]
    )
    for color, n in zip(COLORS, resolutions, strict=False):
        _draw_outline(left, 1e3 * hung[n], color)
        x, _, z = 1e3 * folds[n][:, n // 2].T
        right.plot(x, z, ".-", color=color, ms=4, label=f"{n} × {n}")
    left.set(xlabel="y (mm)", ylabel="z (mm)", title="Hanging", aspect="equal")
    right.set(xlabel="x (mm)", ylabel="z (mm)", title="Folded, the crease, cut along the middle")
    right.set(aspect="equal", xlim=(-16, 62), ylim=(0, 37))
    right.legend(frameon=False)
    return figure, f"hanging: {apart(hung)}; folded: {apart(folds)}"


def _draw_outline(axes: "Axes", shape: np.ndarray, color: str) -> None:
    """Draw the four sides of a cloth, seen along x."""
    sides = np.concatenate([shape[0], shape[:, -1], shape[-1, ::-1], shape[::-1, 0]])
    axes.plot(*sides[:, 1:].T, color=color, lw=1)
