"""Sections on rollouts: one sample, a population, gradients, and scaling."""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from experiments.benchmark.checks import check, compile_seconds, passes
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
from experiments.benchmark.peers import ENGINES, population_map
from experiments.benchmark.peers.population_map import Physics, final_position, physics, plans
from experiments.benchmark.peers.workload import (
    UnavailableError,
    Workload,
    make_body,
    make_workload,
)
from jaxsimp.dynamics import Actions, at_rest, settle
from jaxsimp.engines import Layout, PopulationMap, default_layout, spring_chunk_size
from jaxsimp.machine import num_cores

SWEPT_POPULATION, SWEPT_HORIZON = 64, 2
"""Common point of the sweeps of `scaling`, small enough for sweeps of minutes."""
SINGLE = Layout(chunk_size=1, num_workers=1)


def step(scale: Scale) -> Iterator[Row]:
    """Time steps of one sample with nothing held, on each kind of body."""
    steps = scale.num_actions * scale.action_steps

    def make(workload: Workload) -> Callable[[], Any]:
        simulation, _, start = physics(workload)

        def final(shared: Any, sample: Float[Array, "N 3"]) -> Array:
            return settle(shared, at_rest(sample), steps).position

        mapped = PopulationMap(final, simulation, start[None], SINGLE)
        return lambda: mapped(simulation, start[None])

    yield from _one_sample("step", scale, make)


def rollout(scale: Scale) -> Iterator[Row]:
    """Whole rollouts of one sample, on each kind of body."""
    yield from _one_sample("rollout", scale, partial(population_map.prepare, layout=SINGLE))


def _one_sample(
    name: str, scale: Scale, make: Callable[[Workload], Callable[[], Any]]
) -> Iterator[Row]:
    sides = {kind: scale.rope if kind == "rope" else scale.side for kind in scale.kinds}
    workloads = [
        make_workload(make_body(kind, side), 1, scale.num_actions, scale.action_steps)
        for kind, side in sides.items()
    ]
    checked = [check("jaxsimp", kind, side) for kind, side in sides.items()]
    ready = [prepare(partial(make, workload)) for workload in workloads]
    times = time_in_turns([each.run for each in ready], scale.repeats)
    for (kind, side), workload, found, each, seconds in zip(
        sides.items(), workloads, checked, ready, times.T, strict=True
    ):
        body = f"{kind}_{side}"
        yield make_row(name, engine="jaxsimp", body=body, population=1, layout="one sample") | (
            found | measured(each, seconds, workload.particle_steps)
        )


def population(scale: Scale) -> Iterator[Row]:
    """A population of each kind of body in every layout; errors: differences from the default."""
    for kind in scale.kinds:
        side = scale.rope if kind == "rope" else scale.side
        yield from _layouts(kind, side, scale)


def storage(scale: Scale) -> Iterator[Row]:
    """A population of the cloth, and of the same cloth with particles in random order, in turns."""
    kinds = ("cloth", "unstructured")
    workloads = [
        make_workload(
            make_body(kind, scale.side), scale.population, scale.num_actions, scale.action_steps
        )
        for kind in kinds
    ]
    ready = [prepare(partial(population_map.prepare, workload)) for workload in workloads]
    times = time_in_turns([each.run for each in ready], scale.repeats)
    for index, kind in enumerate(kinds):
        yield make_row(
            "population_storage",
            engine="jaxsimp",
            body=f"{kind}_{scale.side}",
            population=scale.population,
            layout="default layout",
            speed_over_grid=float(np.median(times[:, 0] / times[:, index])),
        ) | measured(ready[index], times[:, index], workloads[index].particle_steps)


def _layouts(kind: str, side: int, scale: Scale) -> Iterator[Row]:
    workload = make_workload(
        make_body(kind, side), scale.population, scale.num_actions, scale.action_steps
    )
    total = workload.population
    layouts = [_layout(workload, total), Layout(total, 1)]
    for workers in sorted({1, num_cores()}):
        chunks = (chunk for chunk in scale.chunk_sizes if chunk <= total // workers)
        layouts.extend(Layout(chunk, workers) for chunk in chunks)
    layouts = list(dict.fromkeys(layouts))
    ready = [prepare(partial(population_map.prepare, workload, layout)) for layout in layouts]
    times = time_in_turns([each.run for each in ready], scale.repeats)
    for layout, each, seconds in zip(layouts, ready, times.T, strict=True):
        yield make_row(
            "population_layout",
            engine="jaxsimp",
            body=f"{kind}_{side}",
            population=total,
            layout=describe(layout) + (", default" if layout is layouts[0] else ""),
            chunk_size=layout.chunk_size,
            workers=layout.num_workers,
            checked_against="default layout",
            error=float(np.abs(each.result - ready[0].result).max()),
        ) | measured(each, seconds, workload.particle_steps)


def _layout(workload: Workload, population: int) -> Layout:
    """The layout that was fastest in measurements."""
    return default_layout(population, spring_chunk_size(physics(workload)[0]))


def describe(layout: Layout) -> str:
    """A layout in words."""
    return f"chunks of {layout.chunk_size}, workers: {layout.num_workers}"


def engines(scale: Scale) -> Iterator[Row]:
    """A population by every engine, in turns, without engines that compute wrong positions."""
    workload = _cloth(scale)
    rows: dict[str, Row] = {}
    ready: dict[str, Prepared] = {}
    for name, (kind, layout, engine) in ENGINES.items():
        rows[name] = make_row(
            "population_rollout",
            engine=kind,
            body=f"cloth_{scale.side}",
            population=workload.population,
            layout=layout,
            ratio_to_jaxsimp=None,
            not_timed=None,
        )
        try:
            rows[name] |= check(name, "cloth", scale.side)
            if passes(rows[name]):
                ready[name] = prepare(partial(engine, workload))
            else:
                rows[name]["not_timed"] = "its positions are wrong"
        except UnavailableError as reason:
            rows[name]["not_timed"] = str(reason)
    times = time_in_turns([each.run for each in ready.values()], scale.repeats)
    seconds = dict(zip(ready, times.T, strict=True))
    for name, row in rows.items():
        if name in ready:
            row |= measured(ready[name], seconds[name], workload.particle_steps)
            checking = compile_seconds(name, "cloth", scale.side)
            row["compile_seconds"] = max(row["compile_seconds"], checking)
        if name in ready and "jaxsimp" in ready:
            # The ratio within each turn: the load of the machine changes between turns.
            row["ratio_to_jaxsimp"] = float(np.median(seconds["jaxsimp"] / seconds[name]))
        yield row


def gradient(scale: Scale) -> Iterator[Row]:
    """The cost of a rollout, with and without its gradient, as actions take more steps."""
    functions: dict[str, Callable[..., Any]] = {
        "forward": _squared_distance,
        "gradient": jax.value_and_grad(_squared_distance),
    }
    rows: list[tuple[Row, Row]] = []
    for factor in scale.growth:
        workload = _cloth(scale, population=1, steps=factor * scale.action_steps)
        maps = [_map_costs(function, workload) for function in functions.values()]
        arguments = physics(workload), plans(workload)
        ready = [prepare(partial(partial, mapped, *arguments)) for mapped in maps]
        times = time_in_turns([each.run for each in ready], scale.repeats)
        ratios = (None, float(np.median(times[:, 1] / times[:, 0])))
        forward, backward = (
            make_row(
                "gradient",
                engine="jaxsimp",
                body=f"cloth_{scale.side}",
                population=1,
                layout=name,
                steps=factor * scale.action_steps * scale.num_actions,
                ratio_to_forward=ratio,
                temporary_megabytes=mapped.temporary_bytes / 1e6,
                memory_exponent=None,
            )
            | measured(each, seconds, workload.particle_steps)
            | {"compile_seconds": mapped.compile_seconds}
            for name, mapped, each, seconds, ratio in zip(
                functions, maps, ready, times.T, ratios, strict=True
            )
        )
        rows.append((forward, backward))
    # The compiler's temporary memory: it is exact, unlike the peak of a process.
    exponent = _exponent([backward for _, backward in rows], "steps", "temporary_megabytes")
    for forward, backward in rows:
        yield forward
        yield backward | {"memory_exponent": exponent}


def _map_costs(function: Callable[..., Any], workload: Workload) -> PopulationMap:
    """A function of the moves of every rollout, compiled like a population."""

    def one(shared: Physics, actions: Actions) -> Any:
        return function(actions.displacement, shared, actions.pick)

    return PopulationMap(one, physics(workload), plans(workload), Layout())


def _squared_distance(
    displacement: Float[Array, "T G 3"], shared: Physics, pick: Array
) -> Float[Array, ""]:
    """Squared distance of the particles from their start: a cost that depends on every move."""
    return jnp.sum((final_position(shared, Actions(pick, displacement)) - shared[2]) ** 2)


def scaling(scale: Scale) -> Iterator[Row]:
    """Time by particles, by population, and by horizon, each with its fitted exponent."""
    side, population, horizon = scale.side, SWEPT_POPULATION, SWEPT_HORIZON
    sweeps = {
        "particles": [(each, population, horizon) for each in scale.sides],
        "population": [(side, each, horizon) for each in scale.populations],
        "horizon": [(side, population, each) for each in scale.horizons],
    }
    # The sweeps have a common point: compile it once.
    points = dict.fromkeys(point for sweep in sweeps.values() for point in sweep)
    workloads = {
        (side, population, horizon): make_workload(
            make_body("cloth", side), population, horizon, action_steps=50
        )
        for side, population, horizon in points
    }
    ready = {
        point: prepare(partial(population_map.prepare, workload))
        for point, workload in workloads.items()
    }
    times = time_in_turns([each.run for each in ready.values()], scale.repeats)
    seconds = dict(zip(ready, times.T, strict=True))
    for swept, sweep in sweeps.items():
        rows = [
            make_row(
                f"scaling_{swept}",
                engine="jaxsimp",
                body=f"cloth_{point[0]}",
                population=point[1],
                layout=describe(
                    default_layout(point[1], spring_chunk_size(physics(workloads[point])[0]))
                ),
                horizon=point[2],
                particle_steps=workloads[point].particle_steps,
            )
            | measured(ready[point], seconds[point], workloads[point].particle_steps)
            for point in sweep
        ]
        exponent = _exponent(rows, "particle_steps", "run_seconds")
        yield from (row | {"exponent": exponent} for row in rows)


def _exponent(rows: list[Row], size: str, value: str) -> float | None:
    """The fitted exponent, or None with too few rows to fit."""
    points = [(row[size], row[value]) for row in rows if row[value]]
    return fit_exponent(*zip(*points, strict=True)) if len(points) > 1 else None


def _cloth(scale: Scale, population: int | None = None, steps: int | None = None) -> Workload:
    return make_workload(
        make_body("cloth", scale.side),
        population or scale.population,
        scale.num_actions,
        steps or scale.action_steps,
    )
