"""The step in Warp on the CPU: a launch runs whole rollouts, and threads share the samples.

Warp runs a launch on one thread, so each of ours launches its part. Measured against a launch a
step, and against a form that computes a spring's tension once: on the machine it was
written on, neither was faster.
"""

import atexit
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import warp as wp

from experiments.engines.workload import GRAVITY, Workload, neighbours, num_cores

_CACHE = tempfile.TemporaryDirectory()
atexit.register(_CACHE.cleanup)
# Ours, so that compilation is timed as such.
wp.config.kernel_cache_dir = _CACHE.name
wp.config.log_level = wp.LOG_ERROR
wp.init()
wp.set_module_options({"fast_math": True, "enable_backward": False})


@wp.struct
class Physics:
    """The numbers of a step."""

    time_step: float
    floor: float
    keep: float
    fall: float
    radius: float
    friction: float
    width: int
    steps: int
    spring: wp.array2d(dtype=wp.vec3)
    other: wp.array2d(dtype=wp.int32)
    scale: wp.array(dtype=wp.float32)
    share: wp.array(dtype=wp.float32)


@wp.struct
class Rollouts:
    """Plans, and the state twice: a step reads one copy and writes the other."""

    pick: wp.array3d(dtype=wp.int32)
    move: wp.array3d(dtype=wp.vec3)
    x: wp.array3d(dtype=wp.vec3)
    v: wp.array3d(dtype=wp.vec3)


@wp.kernel
def run_rollouts(physics: Physics, rollouts: Rollouts) -> None:
    """All rollouts of a launch, each on one thread."""
    b = wp.tid()
    dt = physics.time_step
    now = wp.int32(0)
    for a in range(rollouts.pick.shape[1]):
        for s in range(physics.steps):
            for i in range(physics.scale.shape[0]):
                here = rollouts.x[now, b, i]
                speed = rollouts.v[now, b, i]
                force = wp.vec3(0.0, 0.0, 0.0)
                for n in range(physics.width):
                    j = physics.other[i, n]
                    k = physics.spring[i, n]
                    along = rollouts.x[now, b, j] - here
                    r = 1.0 / wp.sqrt(wp.max(wp.dot(along, along), physics.floor))
                    rate = wp.dot(along, rollouts.v[now, b, j] - speed)
                    force += (k[0] * (1.0 - k[2] * r) + k[1] * rate * r * r) * along
                free = speed * physics.keep + physics.scale[i] * force
                fall = free[2] - physics.fall
                normal = wp.max(fall, (physics.radius - here[2]) / dt)
                sliding = wp.sqrt(wp.max(free[0] * free[0] + free[1] * free[1], 1.0e-12))
                kept = wp.max(0.0, 1.0 - physics.friction * (normal - fall) / sliding)
                moved = wp.vec3(free[0] * kept, free[1] * kept, normal)
                rollouts.v[1 - now, b, i] = moved
                rollouts.x[1 - now, b, i] = here + dt * moved
            for g in range(rollouts.pick.shape[2]):
                i = rollouts.pick[b, a, g]
                moved = rollouts.move[b, a, g] * physics.share[s]
                rollouts.v[1 - now, b, i] = moved
                rollouts.x[1 - now, b, i] = rollouts.x[now, b, i] + dt * moved
            now = 1 - now


def prepare(workload: Workload) -> Callable[[], np.ndarray]:
    """A function giving the final positions, shape (B, N, 3), metres."""
    physics = _physics(workload)
    parts = np.array_split(np.arange(workload.population), num_cores())
    parts = [part for part in parts if len(part)]
    starts = [
        np.broadcast_to(workload.start, (2, len(part), *workload.start.shape)).astype(np.float32)
        for part in parts
    ]
    batches = [_rollouts(workload, part) for part in parts]
    last = workload.pick.shape[1] * workload.action_steps % 2
    pool = ThreadPoolExecutor(len(parts))

    def run_part(rollouts: Any, start: np.ndarray) -> np.ndarray:
        rollouts.x.assign(start)
        rollouts.v.zero_()
        wp.launch(run_rollouts, start.shape[1], inputs=[physics, rollouts], device="cpu")
        return rollouts.x.numpy()[last].copy()

    wp.load_module(device="cpu")
    return lambda: np.concatenate(list(pool.map(run_part, batches, starts)))


def _physics(workload: Workload) -> Any:
    body, dt, springs = workload.body, workload.time_step, neighbours(workload.body)
    table = np.stack([springs.stiffness, springs.damping, springs.rest_length], axis=-1)
    physics = Physics()
    physics.time_step, physics.floor = dt, workload.shortest**2
    physics.keep, physics.fall = 1 - dt * body.drag, dt * GRAVITY
    physics.radius, physics.friction = body.radius, body.friction
    physics.width, physics.steps = springs.index.shape[1], workload.action_steps
    physics.spring, physics.other = _array(table, wp.vec3), _array(springs.index, wp.int32)
    physics.scale = _array(dt / body.mass, wp.float32)
    physics.share = _array(workload.shares / dt, wp.float32)
    return physics


def _rollouts(workload: Workload, part: np.ndarray) -> Any:
    shape = (2, len(part), workload.body.num_particles)
    rollouts = Rollouts()
    rollouts.pick = _array(workload.pick[part], wp.int32)
    rollouts.move = _array(workload.displacement[part], wp.vec3)
    rollouts.x = wp.zeros(shape, dtype=wp.vec3, device="cpu")
    rollouts.v = wp.zeros(shape, dtype=wp.vec3, device="cpu")
    return rollouts


def _array(values: np.ndarray, dtype: type) -> wp.array:
    kind = np.int32 if dtype == wp.int32 else np.float32
    return wp.array(np.ascontiguousarray(values, kind), dtype=dtype, device="cpu")
