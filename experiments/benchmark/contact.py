"""Section on self-contact: its additional cost per time step while a cloth is being folded."""

from collections.abc import Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.benchmark.measure import (
    Prepared,
    Row,
    Scale,
    fit_exponent,
    make_row,
    measured,
    prepare,
    time_in_turns,
)
from jaxsimp import goals
from jaxsimp.bodies import cloth
from jaxsimp.dynamics import (
    NONE,
    Actions,
    at_rest,
    largest_time_step,
    make_pickers,
    make_simulation,
    rollout,
)
from jaxsimp.engines import Layout, PopulationMap

ACTION_SECONDS = 0.25


def self_contact(scale: Scale) -> Iterator[Row]:
    """A cloth that is folded and settles, with and without self-contact, in turns."""
    sides = scale.contact_sides
    ready = {
        (side, touches): prepare(partial(_fold, side, touches))
        for side in sides
        for touches in (False, True)
    }
    times = time_in_turns([each.run for each in ready.values()], scale.repeats)
    seconds = dict(zip(ready, times.T, strict=True))
    each_step = [float(np.median(seconds[side, True])) / _num_steps(side) for side in sides]
    particles = [side**2 for side in sides]
    exponent = fit_exponent(particles, each_step) if len(sides) > 1 else None
    for (side, touches), prepared in ready.items():
        yield _row(side, touches, prepared, seconds) | {"exponent": exponent if touches else None}


def _row(
    side: int, touches: bool, prepared: Prepared, seconds: dict[tuple[int, bool], np.ndarray]
) -> Row:
    taken = seconds[side, touches]
    ratio = float(np.median(taken / seconds[side, False])) if touches else None
    return make_row(
        "self_contact",
        engine="jaxsimp",
        body=f"cloth_{side}",
        population=1,
        layout="self-contact" if touches else "passes through itself",
        steps=_num_steps(side),
        ratio_to_without=ratio,
    ) | measured(prepared, taken, side**2 * _num_steps(side))


def _time_step(side: int) -> float:
    return min(2e-3, 0.9 * largest_time_step(cloth((side, side))))


def _num_steps(side: int) -> int:
    """Number of time steps of two actions that fold, and two with nothing held."""
    return 4 * round(ACTION_SECONDS / _time_step(side))


def _fold(side: int, touches: bool) -> partial[object]:
    """A rollout that carries two corners over to the other two, and lets go."""
    body = cloth((side, side))
    simulation = make_simulation(body, _time_step(side), self_contact=touches)
    pickers = make_pickers((0.2, 0.2, 0.2), steps=_num_steps(side) // 4)
    moves = np.zeros((4, 2, 3))
    moves[:2, :, 0], moves[0, :, 2], moves[1, :, 2] = 0.145, 0.1, -0.094
    picks = np.full((4, 2), NONE)
    picks[:2] = [0, side - 1]
    actions = Actions(jnp.asarray(picks), jnp.asarray(moves, dtype=float))
    start = jnp.asarray(goals.flat(body), dtype=float)

    def final(shared: Any, actions: Actions) -> jax.Array:
        simulation, pickers, start = shared
        return rollout(simulation, pickers, at_rest(start), actions)[0].position

    shared = simulation, pickers, start
    plans = jax.tree.map(lambda each: each[None], actions)
    return partial(PopulationMap(final, shared, plans, Layout()), shared, plans)
