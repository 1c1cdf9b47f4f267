"""Bodies that swing off the table: the order of the time step, and energy."""

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from experiments.physics.measure import GRAVITY, rms, run
from jaxsimp import goals
from jaxsimp.bodies import Body, cloth, rope
from jaxsimp.dynamics import (
    Actions,
    State,
    at_rest,
    largest_time_step,
    make_pickers,
    make_simulation,
)
from jaxsimp.viz import COLORS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

HIGH = np.array([0.0, 0.0, 1.0])
"""Displacement that keeps a swinging body off the table, metres."""


def swing(body: Body, time_step: float, seconds: float, frames: int) -> State:
    """States of a body that swings from its first particle, off the table, a first axis `frames`.

    Args:
        body: the body, flat and at rest at the start.
        time_step: approximate time step, seconds: a whole number of them fills a frame.
        seconds: duration of the motion, seconds.
        frames: number of states to keep.
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
    """Time steps, seconds, and the RMS error of a swing's end state at each, metres.

    The reference is extrapolated from time steps 4 and 8 times shorter than the shortest, as for a
    method of first order, in float64.

    Args:
        body: the swinging body.
        seconds: duration of the swing, seconds.
        divisors: divisors of nine tenths of the largest stable time step.
    """
    with jax.enable_x64(True):
        coarsest = seconds / np.ceil(seconds / (0.9 * largest_time_step(body)))

        def end(divisor: int) -> np.ndarray:
            return np.asarray(swing(body, coarsest / divisor, seconds, 1).position[0])

        last = max(divisors)
        truth = 2 * end(8 * last) - end(4 * last)
        errors = [rms(end(divisor) - truth) for divisor in divisors]
    return coarsest / np.array(divisors), np.array(errors)


def order(steps: np.ndarray, errors: np.ndarray) -> float:
    """Slope of the logarithm of errors over that of steps, by least squares."""
    return float(np.polyfit(np.log(steps), np.log(errors), 1)[0])


def plot_time_step(quick: bool) -> "tuple[Figure, str]":
    """Error over the time step, for a swinging rope and a swinging cloth."""
    import matplotlib.pyplot as plt
    from matplotlib.ticker import LogLocator, NullLocator

    bodies = {"rope": rope(9 if quick else 21), "cloth": cloth((5, 5) if quick else (13, 13))}
    divisors, seconds = ((1, 2, 4), 0.1) if quick else ((1, 2, 4, 8, 16), 0.4)
    found = {name: time_step_errors(body, seconds, divisors) for name, body in bodies.items()}
    figure, axes = plt.subplots(figsize=(4.6, 3.6), layout="constrained")
    for color, marker, (name, (steps, errors)) in zip(COLORS, "os", found.items(), strict=False):
        axes.loglog(1e3 * steps, 1e3 * errors, marker + "-", color=color, label=name)
    every = np.concatenate([steps for steps, _ in found.values()])
    ends = 1e3 * np.array([every.min(), every.max()])
    axes.loglog(ends, 0.5 * 1e3 * errors[0] * ends / (1e3 * steps[0]), "k--", label="order 1")
    axes.set(xlabel="time step (ms)", ylabel="RMS error (mm)", title=f"{seconds:g} s of a swing")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_locator(NullLocator())
    axes.legend(frameon=False)
    return figure, "; ".join(f"{name}: {_in_words(*each)}" for name, each in found.items())


def _in_words(steps: np.ndarray, errors: np.ndarray) -> str:
    slope = order(steps[-3:], errors[-3:])
    return f"{errors[0]:.2g} m at {steps[0]:.2g} s, order {slope:.2f} at the short steps"


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
    """Change of energy in a swing since its start, over the weight times the body's size.

    Args:
        body: the swinging body.
        part: time step, as a fraction of the largest stable one.
        seconds: duration of the swing, seconds.
        frames: number of states with energy.
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
    undamped = damped.scaled(damping=0.0, drag=0.0)
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
