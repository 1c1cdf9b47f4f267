"""The step in Taichi on the CPU: a thread runs whole rollouts, sixteen side by side.

A vector holds one number of each of sixteen samples, which compiles to vector instructions; forces
are summed spring by spring. Slower, in turns: samples one by one with springs by neighbour, on one
thread (about a tenth of the speed), 8 samples side by side, ndarrays instead of fields, and
reciprocal roots by Newton's method. 32 side by side are 4 % faster and take three times as long to
compile.
"""

import contextlib
import io
from collections.abc import Callable
from typing import Any

import numpy as np
import taichi as ti

from experiments.benchmark.peers.workload import (
    GRAVITY,
    Workload,
    from_lanes,
    in_lanes,
    sorted_springs,
)

LANES = 16
"""Samples side by side."""
SHARE = 512
"""Smallest number of iterations per thread in Taichi: shorter loops would run on one thread."""

# Once: it invalidates every field. Without a cache, so that timings include compilation.
with contextlib.redirect_stdout(io.StringIO()):  # a banner
    ti.init(arch=ti.cpu, fast_math=True, offline_cache=False, log_level=ti.ERROR)

Lanes = ti.types.vector(LANES, ti.f32)


def prepare(workload: Workload) -> Callable[[], np.ndarray]:
    """A function giving the final positions, shape (B, N, 3), metres."""
    body, dt, steps = workload.body, workload.time_step, workload.action_steps
    pairs, numbers = sorted_springs(body)
    count, num_springs = body.num_particles, len(pairs)
    ends, spring = _scalars(pairs, ti.i32), _scalars(numbers, ti.f32)
    pick = _scalars(in_lanes(workload.pick, LANES), ti.i32)
    move = _scalars(in_lanes(workload.displacement, LANES), ti.f32)
    blocks, num_actions, _, num_pickers = pick.shape
    scale, share = _scalars(dt / body.mass, ti.f32), _scalars(workload.shares / dt, ti.f32)
    floor, keep, fall = workload.shortest**2, 1 - dt * body.material.drag, dt * GRAVITY
    radius, friction = body.radius, body.material.friction
    start = _scalars(workload.start, ti.f32)
    # Position, velocity and force of a particle lie side by side.
    x, y, z, u, v, w, fx, fy, fz = state = [ti.Vector.field(LANES, ti.f32) for _ in range(9)]
    ti.root.dense(ti.ij, (blocks, count)).place(*state)

    @ti.kernel
    def rollouts():
        for t in range(blocks * SHARE):
            # At most one block.
            for b in range((t + SHARE - 1) // SHARE, t // SHARE + 1):
                for i in range(count):
                    for c in ti.static(range(9)):
                        state[c][b, i] = Lanes(start[i, c] if ti.static(c < 3) else 0.0)
                for a in range(num_actions):
                    for s in range(steps):
                        for e in range(num_springs):
                            i, j = ends[e, 0], ends[e, 1]
                            dx, dy, dz = x[b, j] - x[b, i], y[b, j] - y[b, i], z[b, j] - z[b, i]
                            rate = dx * (u[b, j] - u[b, i]) + dy * (v[b, j] - v[b, i])
                            rate += dz * (w[b, j] - w[b, i])
                            r = 1.0 / ti.sqrt(ti.max(dx * dx + dy * dy + dz * dz, floor))
                            tension = spring[e, 0] - r * (spring[e, 2] - spring[e, 1] * r * rate)
                            for f, d in ti.static(((fx, dx), (fy, dy), (fz, dz))):
                                f[b, i] = f[b, i] + tension * d
                                f[b, j] = f[b, j] - tension * d
                        for i in range(count):
                            free_u = u[b, i] * keep + scale[i] * fx[b, i]
                            free_v = v[b, i] * keep + scale[i] * fy[b, i]
                            free_w = w[b, i] * keep + scale[i] * fz[b, i] - fall
                            normal = ti.max(free_w, (radius - z[b, i]) * (1.0 / dt))
                            sliding = ti.sqrt(ti.max(free_u * free_u + free_v * free_v, 1e-12))
                            kept = ti.max(0.0, 1.0 - friction * (normal - free_w) / sliding)
                            u[b, i], v[b, i], w[b, i] = free_u * kept, free_v * kept, normal
                            for f in ti.static((fx, fy, fz)):
                                f[b, i] = Lanes(0.0)
                        for n, g in ti.static(ti.ndrange(LANES, num_pickers)):
                            p = pick[b, a, n, g]
                            for c in ti.static(range(3)):
                                state[3 + c][b, p][n] = move[b, a, n, g, c] * share[s]
                        for i in range(count):
                            for c in ti.static(range(3)):
                                state[c][b, i] = state[c][b, i] + dt * state[3 + c][b, i]

    def run() -> np.ndarray:
        rollouts()
        positions = np.stack([each.to_numpy() for each in (x, y, z)], axis=2)
        return from_lanes(positions, workload.population)

    run()  # compiles
    return run


def _scalars(array: np.ndarray, dtype: Any) -> Any:
    field = ti.field(dtype, array.shape)
    field.from_numpy(np.ascontiguousarray(array, np.int32 if dtype == ti.i32 else np.float32))
    return field
