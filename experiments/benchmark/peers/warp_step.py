"""The step in Warp on the CPU: a launch runs whole rollouts, sixteen side by side.

Warp runs a launch on one thread, so each of our threads launches its part. A vector holds one
number of each of sixteen samples, which compiles to vector instructions; forces are summed spring
by spring. Measured in turns: samples one by one with springs by neighbour have less than a tenth of
the speed, 8 side by side seven tenths; 32 side by side with -O3 and wider vector instructions
are 7 % faster.
"""

import atexit
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import warp as wp

from experiments.benchmark.peers.workload import (
    GRAVITY,
    Workload,
    from_lanes,
    in_lanes,
    sorted_springs,
)
from jaxsimp.machine import num_cores

LANES = 16
"""Samples side by side."""

_CACHE = tempfile.TemporaryDirectory()
atexit.register(_CACHE.cleanup)
# Our own cache, so that timings include compilation.
wp.config.kernel_cache_dir = _CACHE.name
wp.config.log_level = wp.LOG_ERROR
wp.init()
wp.set_module_options({"fast_math": True, "enable_backward": False})


Lanes = wp.types.vector(length=LANES, dtype=wp.float32)


@wp.struct
class Physics:
    """The numbers of a step."""

    time_step: float
    floor: float
    keep: float
    fall: float
    radius: float
    friction: float
    steps: int
    ends: wp.array2d(dtype=wp.int32)
    spring: wp.array(dtype=wp.vec3)
    scale: wp.array(dtype=wp.float32)
    share: wp.array(dtype=wp.float32)


@wp.struct
class Rollouts:
    """Plans by block, action, lane and picker; the state by block and particle.

    In the state, 0 to 2 is the position, 3 to 5 the velocity, 6 to 8 the force.
    """

    pick: wp.array4d(dtype=wp.int32)
    move: wp.array4d(dtype=wp.vec3)
    state: wp.array3d(dtype=Lanes)


@wp.func
def inverse_root(squares: Lanes, least: float) -> Lanes:
    """Inverse root of each lane, at most that of `least`."""
    found = Lanes()
    for n in range(wp.static(LANES)):
        found[n] = 1.0 / wp.sqrt(wp.max(squares[n], least))
    return found


@wp.func
def add_forces(physics: Physics, state: wp.array3d(dtype=Lanes), b: int) -> None:
    """The forces of all springs on the particles of a block."""
    for e in range(physics.spring.shape[0]):
        # Separate statements: unpacking from a tuple costs a sixth of the speed.
        i = physics.ends[e, 0]
        j = physics.ends[e, 1]
        k = physics.spring[e]
        dx = state[b, j, 0] - state[b, i, 0]
        dy = state[b, j, 1] - state[b, i, 1]
        dz = state[b, j, 2] - state[b, i, 2]
        rate = (
            wp.cw_mul(dx, state[b, j, 3] - state[b, i, 3])
            + wp.cw_mul(dy, state[b, j, 4] - state[b, i, 4])
            + wp.cw_mul(dz, state[b, j, 5] - state[b, i, 5])
        )
        squares = wp.cw_mul(dx, dx) + wp.cw_mul(dy, dy) + wp.cw_mul(dz, dz)
        r = inverse_root(squares, physics.floor)
        tension = Lanes(k[0]) - wp.cw_mul(r, Lanes(k[2]) - k[1] * wp.cw_mul(r, rate))
        fx, fy, fz = wp.cw_mul(tension, dx), wp.cw_mul(tension, dy), wp.cw_mul(tension, dz)
        state[b, i, 6] = state[b, i, 6] + fx
        state[b, i, 7] = state[b, i, 7] + fy
        state[b, i, 8] = state[b, i, 8] + fz
        state[b, j, 6] = state[b, j, 6] - fx
        state[b, j, 7] = state[b, j, 7] - fy
        state[b, j, 8] = state[b, j, 8] - fz


@wp.func
def accelerate(physics: Physics, state: wp.array3d(dtype=Lanes), b: int) -> None:
    """Update velocities, after contact with the table, and clear the forces."""
    for i in range(physics.scale.shape[0]):
        scale = physics.scale[i]
        u = state[b, i, 3] * physics.keep + scale * state[b, i, 6]
        v = state[b, i, 4] * physics.keep + scale * state[b, i, 7]
        w = state[b, i, 5] * physics.keep + scale * state[b, i, 8] - Lanes(physics.fall)
        normal = wp.max(w, (Lanes(physics.radius) - state[b, i, 2]) * (1.0 / physics.time_step))
        slowness = inverse_root(wp.cw_mul(u, u) + wp.cw_mul(v, v), 1.0e-12)
        lost = physics.friction * wp.cw_mul(normal - w, slowness)
        kept = wp.max(Lanes(0.0), Lanes(1.0) - lost)
        state[b, i, 3] = wp.cw_mul(u, kept)
        state[b, i, 4] = wp.cw_mul(v, kept)
        state[b, i, 5] = normal
        for c in range(6, 9):
            state[b, i, c] = Lanes(0.0)


@wp.kernel
def run_rollouts(physics: Physics, rollouts: Rollouts) -> None:
    """Run all rollouts of a launch, one block at a time."""
    b = wp.tid()
    for a in range(rollouts.pick.shape[1]):
        for s in range(physics.steps):
            add_forces(physics, rollouts.state, b)
            accelerate(physics, rollouts.state, b)
            for n in range(rollouts.pick.shape[2]):
                for g in range(rollouts.pick.shape[3]):
                    i = rollouts.pick[b, a, n, g]
                    moved = rollouts.move[b, a, n, g] * physics.share[s]
                    for c in range(3):
                        held = rollouts.state[b, i, 3 + c]
                        held[n] = moved[c]
                        rollouts.state[b, i, 3 + c] = held
            for i in range(physics.scale.shape[0]):
                for c in range(3):
                    change = physics.time_step * rollouts.state[b, i, 3 + c]
                    rollouts.state[b, i, c] = rollouts.state[b, i, c] + change


def prepare(workload: Workload) -> Callable[[], np.ndarray]:
    """A function giving the final positions, shape (B, N, 3), metres."""
    physics = _physics(workload)
    picks, moves = (in_lanes(each, LANES) for each in (workload.pick, workload.displacement))
    parts = [part for part in np.array_split(np.arange(len(picks)), num_cores()) if len(part)]
    batches = [_rollouts(picks[part], moves[part], workload.body.num_particles) for part in parts]
    at_first = np.zeros((workload.body.num_particles, 9, LANES), np.float32)
    at_first[:, :3] = workload.start[..., None]
    pool = ThreadPoolExecutor(len(parts))

    def run_part(rollouts: Any) -> np.ndarray:
        blocks = rollouts.state.shape[0]
        rollouts.state.assign(np.broadcast_to(at_first, (blocks, *at_first.shape)))
        wp.launch(run_rollouts, blocks, inputs=[physics, rollouts], device="cpu")
        return rollouts.state.numpy()[:, :, :3]

    def run() -> np.ndarray:
        return from_lanes(np.concatenate(list(pool.map(run_part, batches))), workload.population)

    wp.load_module(device="cpu")
    return run


def _physics(workload: Workload) -> Any:
    body, dt = workload.body, workload.time_step
    ends, numbers = sorted_springs(body)
    physics = Physics()
    physics.time_step, physics.floor = dt, workload.shortest**2
    physics.keep, physics.fall = 1 - dt * body.material.drag, dt * GRAVITY
    physics.radius, physics.friction = body.radius, body.material.friction
    physics.steps = workload.action_steps
    physics.ends, physics.spring = _array(ends, wp.int32), _array(numbers, wp.vec3)
    physics.scale = _array(dt / body.mass, wp.float32)
    physics.share = _array(workload.shares / dt, wp.float32)
    return physics


def _rollouts(pick: np.ndarray, move: np.ndarray, num_particles: int) -> Any:
    rollouts = Rollouts()
    rollouts.pick, rollouts.move = _array(pick, wp.int32), _array(move, wp.vec3)
    rollouts.state = wp.zeros((len(pick), num_particles, 9), dtype=Lanes, device="cpu")
    return rollouts


def _array(values: np.ndarray, dtype: type) -> wp.array:
    kind = np.int32 if dtype == wp.int32 else np.float32
    return wp.array(np.ascontiguousarray(values, kind), dtype=dtype, device="cpu")
