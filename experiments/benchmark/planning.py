"""Sections on planning: CEM, line fits, cold starts."""

import dataclasses
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from experiments.benchmark.measure import (
    Row,
    Scale,
    make_row,
    measured,
    prepare,
    time_in_turns,
)
from jaxsimp.bodies import rope
from jaxsimp.machine import num_cores
from jaxsimp.planning import CEM, Plan, Planner
from jaxsimp.simplification import qp, simplify
from jaxsimp.simplification.ropes import (
    Limits,
    fit_rope,
    fit_within,
    interpolation_matrix,
    uniform_breakpoints,
)
from jaxsimp.tasks import make_task

PLANNED_STEPS = (4, 150)
"""Number of actions of a planned rollout, the last with nothing held, and of time steps of each."""
LINE_SIZE = 6
"""Number of key points of the lines."""


def cem(scale: Scale) -> Iterator[Row]:
    """An iteration of CEM, and a whole plan of a diagonal fold, with the fraction of cores busy."""
    start = time.perf_counter()
    planner = fold_planner(scale.cem_side)
    algorithm = CEM(scale.cem_iterations, scale.population, initial_populations=1)
    compiling = time.perf_counter() - start
    task = planner.task
    marks: list[tuple[float, float]] = []

    def mark() -> None:
        marks.append((time.perf_counter(), time.process_time()))

    ready = prepare(lambda: lambda: plan_fold(planner, algorithm, mark))
    compiling += ready.result.compile_seconds
    seconds, iterations, busy = [], [], []
    for _ in range(scale.cem_plans):
        marks.clear()
        seconds.append(ready.run().seconds)
        wall, processor = np.diff(marks, axis=0).T
        iterations.extend(wall)
        busy.append(processor.sum() / wall.sum() / num_cores())
    ready = dataclasses.replace(ready, compile_seconds=compiling)
    actions, steps = PLANNED_STEPS
    work = algorithm.population * actions * steps * task.body.num_particles
    fields = {
        "engine": "jaxsimp",
        "body": f"cloth_{scale.cem_side}",
        "population": algorithm.population,
        "layout": "default layout",
        "cpu_share": float(np.median(busy)),
    }
    score = planner.execute(task.episode_fn(0), ready.result.actions).score
    rounds = algorithm.num_asks
    yield make_row("cem_iteration", **fields) | measured(ready, np.array(iterations), work)
    yield make_row("cem_plan", **fields, rollouts=rounds * algorithm.population, score=score) | (
        measured(ready, np.array(seconds), rounds * work)
    )


def fold_planner(side: int) -> Planner:
    """A planner of the diagonal fold, with rollouts of `PLANNED_STEPS`."""
    task = make_task("cloth_diagonal_folding", side)
    actions, steps = PLANNED_STEPS
    task = dataclasses.replace(task, num_actions=actions - 1, action_seconds=steps * task.time_step)
    return Planner(task)


def plan_fold(planner: Planner, algorithm: CEM, on_ask: Callable[[], None] = lambda: None) -> Plan:
    """Key points of the fold's goal, and a plan over them."""
    task = planner.task
    key_points = simplify(task.body, task.goal)
    return planner.plan(task.episode_fn(0), key_points, algorithm, 0, on_ask)


def line_fit(scale: Scale) -> Iterator[Row]:
    """Lines of a few key points fitted to goals of a rope, by each backend."""
    body = rope(scale.rope)
    breakpoints = uniform_breakpoints(scale.rope, LINE_SIZE)[None]

    def by_backend(backend: str, goals: np.ndarray) -> Callable[[], np.ndarray]:
        each = np.repeat(breakpoints, len(goals), axis=0)
        return lambda: fit_within(goals, each, Limits(), backend)[0]

    def by_product(goals: np.ndarray) -> Callable[[], np.ndarray]:
        return lambda: np.asarray(fit_rope(goals, LINE_SIZE)[0])

    makes = {name: partial(by_backend, name) for name in qp.BACKENDS}
    for count in scale.goals:
        goals = _curves(body.rest, count)
        expected = np.linalg.pinv(interpolation_matrix(scale.rope, LINE_SIZE)) @ goals
        ready = [
            prepare(partial(_compiled, make(goals)))
            for make in (*makes.values(), partial(by_product))
        ]
        times = time_in_turns([each.run for each in ready], scale.repeats)
        for name, each, seconds in zip((*makes, "fit_rope"), ready, times.T, strict=True):
            yield make_row(
                "line_fit",
                engine=name,
                body=f"rope_{scale.rope}",
                goals=count,
                goals_per_second=count / float(np.median(seconds)),
                checked_against="pseudo-inverse, float64",
                error=float(np.abs(each.result - expected).max()),
            ) | measured(each, seconds)


def _compiled(run: Callable[[], Any]) -> Callable[[], Any]:
    run()
    return run


def _curves(rest: np.ndarray, count: int) -> np.ndarray:
    """Goals: the rope along smooth random curves, shape (count, N, 3), metres."""
    random = np.random.default_rng(0)
    along = np.linspace(0.0, np.pi, len(rest))
    waves = np.sin(np.arange(1, 4)[:, None] * along)
    goals = rest + np.einsum("bwa,wn->bna", random.normal(0.0, 0.05, (count, 3, 3)), waves)
    return goals.astype(np.float32)


COLD_START = """
import json, sys, time
start = time.perf_counter()
import jaxsimp
imported = time.perf_counter()
import jaxsimp.planning
planning = time.perf_counter()
from experiments.benchmark.planning import fold_planner, plan_fold
from jaxsimp.planning import CEM
side, population, num_iterations = map(int, sys.argv[1:])
planner = fold_planner(side)
plan = plan_fold(planner, CEM(num_iterations, population, initial_populations=1))
print(json.dumps({
    "jaxsimp": imported - start,
    "jaxsimp.planning": planning - start,
    "compile": plan.compile_seconds,
    "all": time.perf_counter() - start,
}))
"""


def cold_start(scale: Scale) -> Iterator[Row]:
    """New processes: the time of the import, and the time until a plan is found."""
    found: dict[str, list[dict[str, float]]] = {}
    for _ in range(scale.cold_starts):
        with tempfile.TemporaryDirectory() as folder:
            for cache in scale.caches:
                path = None if cache == "no cache" else folder
                found.setdefault(cache, []).append(_start_cold(scale, path))
    fields = {"engine": "jaxsimp", "body": f"cloth_{scale.cem_side}"}
    every = [times for all_times in found.values() for times in all_times]
    for module in ("jaxsimp", "jaxsimp.planning"):
        yield make_row(
            "cold_start_import",
            engine="jaxsimp",
            layout=f"import {module}",
            run_seconds=float(np.median([times[module] for times in every])),
        )
    for cache, all_times in found.items():
        yield make_row(
            "cold_start_plan",
            **fields,
            population=scale.population,
            rollouts=scale.cem_iterations * scale.population,
            layout=cache,
            compile_seconds=float(np.median([times["compile"] for times in all_times])),
            run_seconds=float(np.median([times["all"] for times in all_times])),
        )


def _start_cold(scale: Scale, cache: str | None) -> dict[str, float]:
    """Seconds of a new process that compiles and plans."""
    sizes = scale.cem_side, scale.population, scale.cem_iterations
    enabled = "false" if cache is None else "true"
    environment = os.environ | {"JAX_ENABLE_COMPILATION_CACHE": enabled}
    if cache is not None:
        environment |= {
            "JAX_COMPILATION_CACHE_DIR": cache,
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
        }
    done = subprocess.run(
        [sys.executable, "-c", COLD_START, *map(str, sizes)],
        cwd=Path(__file__).parents[2],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    return json.loads(done.stdout.splitlines()[-1])
