"""Sections on self-contact: what it adds to a time step of a fold, and to a gradient."""

from collections.abc import Callable, Iterator
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


def contact_gradient(scale: Scale) -> Iterator[Row]:
    """The cost of a gradient through self-contact, of a fold of two actions, and of its value."""
    side = scale.contact_sides[0]
    functions: dict[str, Callable[..., Any]] = {
        "forward": _spread,
        "gradient": jax.value_and_grad(_spread),
    }
    shared, plans = _carried_over(side, touches=True, num_actions=2)
    maps = [_mapped(function, shared, plans) for function in functions.values()]
    ready = [prepare(partial(partial, mapped, shared, plans)) for mapped in maps]
    times = time_in_turns([each.run for each in ready], scale.repeats)
    ratios = (None, float(np.median(times[:, 1] / times[:, 0])))
    steps = _num_steps(side) // 2
    for name, mapped, each, seconds, ratio in zip(
        functions, maps, ready, times.T, ratios, strict=True
    ):
        yield make_row(
            "contact_gradient",
            engine="jaxsimp",
            body=f"cloth_{side}",
            population=1,
            layout=name,
            steps=steps,
            ratio_to_forward=ratio,
            temporary_megabytes=mapped.temporary_bytes / 1e6,
        ) | measured(each, seconds, side**2 * steps)


def _mapped(function: Callable[..., Any], shared: Any, plans: Actions) -> PopulationMap:
    """A function of the moves of a plan, compiled like a population."""

    def one(shared: Any, actions: Actions) -> Any:
        return function(actions.displacement, shared, actions.pick)

    return PopulationMap(one, shared, plans, Layout())


def _spread(displacement: jax.Array, shared: Any, pick: jax.Array) -> jax.Array:
    """Squared distance of the particles from their start: a cost that depends on every move."""
    return jnp.sum((_final(shared, Actions(pick, displacement)) - shared[2]) ** 2)


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
    shared, plans = _carried_over(side, touches, num_actions=4)
    return partial(PopulationMap(_final, shared, plans, Layout()), shared, plans)


def _carried_over(side: int, touches: bool, num_actions: int) -> tuple[Any, Actions]:
    """What rollouts of a cloth share, and a plan that folds it in two actions, and then idles."""
    body = cloth((side, side))
    simulation = make_simulation(body, _time_step(side), self_contact=touches)
    pickers = make_pickers((0.2, 0.2, 0.2), steps=_num_steps(side) // 4)
    moves = np.zeros((num_actions, 2, 3))
    moves[:2, :, 0], moves[0, :, 2], moves[1, :, 2] = 0.145, 0.1, -0.094
    picks = np.full((num_actions, 2), NONE)
    picks[:2] = [0, side - 1]
    actions = Actions(jnp.asarray(picks), jnp.asarray(moves, dtype=float))
    shared = simulation, pickers, jnp.asarray(goals.flat(body), dtype=float)
    return shared, jax.tree.map(lambda each: each[None], actions)


def _final(shared: Any, actions: Actions) -> jax.Array:
    simulation, pickers, start = shared
    return rollout(simulation, pickers, at_rest(start), actions)[0].position
