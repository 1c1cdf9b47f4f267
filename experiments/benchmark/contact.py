"""Sections on self-contact: what it adds to a time step of a fold, and to a gradient."""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.benchmark.measure import (
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
from jaxsimp.engines import Layout, PopulationMap, default_layout, spring_chunk_size

ACTION_SECONDS = 0.25
CRUMPLED = 4
"""Plans that crumple a cloth: how much it touches itself differs from plan to plan."""
MakePlans = Callable[[int, Scale], Actions]
"""Plans for a cloth of so many particles along a side."""


def self_contact(scale: Scale) -> Iterator[Row]:
    """A cloth that is folded and settles, with and without self-contact, in turns."""
    yield from _with_and_without("self_contact", _folding, scale)


def crumpling(scale: Scale) -> Iterator[Row]:
    """The same for a cloth that is crumpled: random grasps, carried up to 0.2 m along each axis."""
    yield from _with_and_without("crumpling", _crumpling, scale)


def _with_and_without(name: str, make_plans: MakePlans, scale: Scale) -> Iterator[Row]:
    sides = scale.contact_sides
    plans = {side: make_plans(side, scale) for side in sides}
    steps = {side: plans[side].pick.shape[1] * _action_steps(side) for side in sides}
    population = len(plans[sides[0]].pick)
    ready = {
        (side, touches): prepare(partial(_rollouts, side, touches, plans[side]))
        for side in sides
        for touches in (False, True)
    }
    times = time_in_turns([each.run for each in ready.values()], scale.repeats)
    seconds = dict(zip(ready, times.T, strict=True))
    each_step = [float(np.median(seconds[side, True])) / steps[side] for side in sides]
    particles = [side**2 for side in sides]
    exponent = fit_exponent(particles, each_step) if len(sides) > 1 else None
    for (side, touches), prepared in ready.items():
        taken = seconds[side, touches]
        yield make_row(
            name,
            engine="jaxsimp",
            body=f"cloth_{side}",
            population=population,
            layout="self-contact" if touches else "passes through itself",
            steps=steps[side],
            ratio_to_without=(float(np.median(taken / seconds[side, False])) if touches else None),
            exponent=exponent if touches else None,
        ) | measured(prepared, taken, population * side**2 * steps[side])


def contact_population(scale: Scale) -> Iterator[Row]:
    """Many folds at a time, with and without self-contact, laid out as planners do on this device.

    The population is larger on a GPU, which is slow for few rollouts.
    """
    side, on_cpu = scale.contact_sides[0], jax.devices()[0].platform == "cpu"
    population = scale.population if on_cpu else max(scale.populations)
    fold = _folding(side, scale)
    # Folds that differ: samples that look up in the same steps would be no fair measure.
    shares = jnp.linspace(0.8, 1.0, population)[:, None, None, None]
    plans = Actions(jnp.repeat(fold.pick, population, axis=0), shares * fold.displacement)
    ready, layouts = {}, {}
    for touches in (False, True):
        shared = _shared(side, touches)
        layouts[touches] = default_layout(population, spring_chunk_size(shared[0]))
        ready[touches] = prepare(partial(_laid_out, shared, plans, layouts[touches]))
    times = time_in_turns([each.run for each in ready.values()], scale.repeats)
    ratio = float(np.median(times[:, 1] / times[:, 0]))
    steps = plans.pick.shape[1] * _action_steps(side)
    for (touches, prepared), seconds in zip(ready.items(), times.T, strict=True):
        yield make_row(
            "contact_population",
            engine="jaxsimp",
            body=f"cloth_{side}",
            population=population,
            layout="self-contact" if touches else "passes through itself",
            chunk_size=layouts[touches].chunk_size,
            workers=layouts[touches].num_workers,
            steps=steps,
            ratio_to_without=ratio if touches else None,
        ) | measured(prepared, seconds, population * side**2 * steps)


def contact_gradient(scale: Scale) -> Iterator[Row]:
    """The cost of a gradient through self-contact, of a fold of two actions, and of its value."""
    side = scale.contact_sides[0]
    functions: dict[str, Callable[..., Any]] = {
        "forward": _spread,
        "gradient": jax.value_and_grad(_spread),
    }
    shared = _shared(side, touches=True)
    plans = jax.tree.map(lambda each: each[:, :2], _folding(side, scale))
    maps = [_mapped(function, shared, plans) for function in functions.values()]
    ready = [prepare(partial(partial, mapped, shared, plans)) for mapped in maps]
    times = time_in_turns([each.run for each in ready], scale.repeats)
    ratios = (None, float(np.median(times[:, 1] / times[:, 0])))
    steps = 2 * _action_steps(side)
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


def _time_step(side: int) -> float:
    return min(2e-3, 0.9 * largest_time_step(cloth((side, side))))


def _action_steps(side: int) -> int:
    return round(ACTION_SECONDS / _time_step(side))


def _rollouts(side: int, touches: bool, plans: Actions) -> partial[object]:
    return _laid_out(_shared(side, touches), plans, Layout())


def _laid_out(shared: Any, plans: Actions, layout: Layout) -> partial[object]:
    return partial(PopulationMap(_final, shared, plans, layout), shared, plans)


def _shared(side: int, touches: bool) -> Any:
    """What rollouts of a cloth share: physics, pickers and the start."""
    body = cloth((side, side))
    simulation = make_simulation(body, _time_step(side), self_contact=touches)
    pickers = make_pickers((0.2, 0.2, 0.2), steps=_action_steps(side))
    return simulation, pickers, jnp.asarray(goals.flat(body), dtype=float)


def _folding(side: int, scale: Scale) -> Actions:
    """Two corners are carried over to the other two; then nothing is held for two actions."""
    moves, picks = np.zeros((4, 2, 3)), np.full((4, 2), NONE)
    moves[:2, :, 0], moves[0, :, 2], moves[1, :, 2] = 0.145, 0.1, -0.094
    picks[:2] = [0, side - 1]
    return Actions(jnp.asarray(picks[None]), jnp.asarray(moves[None], dtype=float))


def _crumpling(side: int, scale: Scale) -> Actions:
    rng, shape = np.random.default_rng(0), (CRUMPLED, scale.crumpling_actions, 2)
    moves = rng.uniform(-0.2, 0.2, (*shape, 3))
    picks = rng.integers(0, side**2, shape)
    return Actions(jnp.asarray(picks), jnp.asarray(moves, dtype=float))


def _final(shared: Any, actions: Actions) -> jax.Array:
    simulation, pickers, start = shared
    return rollout(simulation, pickers, at_rest(start), actions)[0].position
