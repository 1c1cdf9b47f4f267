"""The step in Taichi on the CPU: threads share the samples, a sample runs its whole rollout.

Measured against a kernel launch a step, parallel over samples and particles, and against forms
that compute a spring's tension once: on the machine it was written on, none was faster.
"""

import contextlib
import io
from collections.abc import Callable
from typing import Any

import numpy as np
import taichi as ti

from experiments.engines.workload import GRAVITY, Workload, neighbours

# Once: it invalidates every field. Without a cache, so that compilation is timed as such.
with contextlib.redirect_stdout(io.StringIO()):  # a banner
    ti.init(arch=ti.cpu, fast_math=True, offline_cache=False, log_level=ti.ERROR)


def prepare(workload: Workload) -> Callable[[], np.ndarray]:
    """A function giving the final positions, shape (B, N, 3), metres."""
    body, dt, steps = workload.body, workload.time_step, workload.action_steps
    population, num_actions, num_pickers = workload.pick.shape
    springs = neighbours(body)
    count, width = springs.index.shape
    table = np.stack([springs.stiffness, springs.damping, springs.rest_length], axis=-1)
    spring, other = _vectors(table), _scalars(springs.index, ti.i32)
    pick, move = _scalars(workload.pick, ti.i32), _vectors(workload.displacement)
    scale, share = _scalars(dt / body.mass, ti.f32), _scalars(workload.shares / dt, ti.f32)
    floor, keep, fall = workload.shortest**2, 1 - dt * body.drag, dt * GRAVITY
    radius, friction = body.radius, body.friction
    # Two copies of the state: a step reads one and writes the other.
    x = ti.Vector.field(3, ti.f32, (2, population, count))
    v = ti.Vector.field(3, ti.f32, (2, population, count))
    start = np.broadcast_to(workload.start, (2, population, count, 3)).astype(np.float32)

    @ti.kernel
    def rollouts():
        ti.loop_config(block_dim=1)
        for b in range(population):
            for a in range(num_actions):
                for s in range(steps):
                    now = (a * steps + s) % 2
                    for i in range(count):
                        here, speed = x[now, b, i], v[now, b, i]
                        force = ti.Vector([0.0, 0.0, 0.0])
                        for n in range(width):
                            j = other[i, n]
                            k = spring[i, n]
                            along = x[now, b, j] - here
                            r = 1.0 / ti.sqrt(ti.max(along.dot(along), floor))
                            rate = along.dot(v[now, b, j] - speed)
                            force += (k[0] * (1.0 - k[2] * r) + k[1] * rate * r * r) * along
                        free = speed * keep + scale[i] * force
                        free[2] -= fall
                        normal = ti.max(free[2], (radius - here[2]) / dt)
                        sliding = ti.sqrt(ti.max(free[0] ** 2 + free[1] ** 2, 1e-12))
                        kept = ti.max(0.0, 1.0 - friction * (normal - free[2]) / sliding)
                        moved = ti.Vector([free[0] * kept, free[1] * kept, normal])
                        for g in ti.static(range(num_pickers)):
                            if pick[b, a, g] == i:
                                moved = move[b, a, g] * share[s]
                        v[1 - now, b, i] = moved
                        x[1 - now, b, i] = here + dt * moved

    def run() -> np.ndarray:
        x.from_numpy(start)
        v.fill(0.0)
        rollouts()
        return x.to_numpy()[num_actions * steps % 2]

    run()  # compiles
    return run


def _scalars(array: np.ndarray, dtype: Any) -> Any:
    field = ti.field(dtype, array.shape)
    field.from_numpy(array.astype(np.int32 if dtype == ti.i32 else np.float32))
    return field


def _vectors(array: np.ndarray) -> Any:
    field = ti.Vector.field(3, ti.f32, array.shape[:-1])
    field.from_numpy(array.astype(np.float32))
    return field
