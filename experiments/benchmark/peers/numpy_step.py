"""The step in NumPy: springs of one offset as slices, samples along the last axis."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int

from experiments.benchmark.peers.workload import GRAVITY, Workload, by_offset

CHUNK_SIZE = 32
"""Samples stepped together: the fastest of 1 to 32, by up to 6 times, for a 25 x 25 cloth."""
Array = np.ndarray


def prepare(workload: Workload) -> Callable[[], np.ndarray]:
    """A function giving the final positions, shape (B, N, 3), metres."""
    forces, contact = _forces_fn(workload), _contact_fn(workload)
    dt = np.float32(workload.time_step)
    start = workload.start.T.astype(np.float32)
    speed = workload.shares.astype(np.float32) / dt

    def run_chunk(pick: Int[Array, "b T G"], move: Float[Array, "b T G 3"]) -> Array:
        x = np.repeat(start[:, :, None], len(pick), axis=2)
        v = np.zeros_like(x)
        sample = np.arange(len(pick))[:, None]
        for ids, displacement in zip(pick.swapaxes(0, 1), move.swapaxes(0, 1), strict=True):
            for share in speed:
                v = contact(x, v, forces(x, v))
                v[:, ids, sample] = (displacement * share).transpose(2, 0, 1)
                x = x + dt * v
        return x.transpose(2, 1, 0)

    def run() -> np.ndarray:
        starts = range(0, workload.population, CHUNK_SIZE)
        chunks = [slice(first, first + CHUNK_SIZE) for first in starts]
        plans = workload.pick, workload.displacement
        return np.concatenate([run_chunk(*(array[chunk] for array in plans)) for chunk in chunks])

    return run


def _forces_fn(workload: Workload) -> Callable[[Array, Array], Array]:
    """Forces of the springs, newtons, from positions and velocities, all of shape (3, N, b)."""
    springs = by_offset(workload.body)
    tables = (springs.stiffness, springs.damping, springs.rest_length)
    k, c, length = (table.astype(np.float32)[:, :, None] for table in tables)
    floor = np.float32(workload.shortest**2)

    def forces(x: Array, v: Array) -> Array:
        force = np.zeros_like(x)
        for row, offset in enumerate(springs.offsets):
            here = slice(0, -offset)
            along, speed = x[:, offset:] - x[:, here], v[:, offset:] - v[:, here]
            # In place if possible: otherwise half the time goes into new arrays.
            speed *= along
            rate = speed[0] + speed[1]
            rate += speed[2]
            squared = along[0] * along[0]
            squared += along[1] * along[1]
            squared += along[2] * along[2]
            np.maximum(squared, floor, out=squared)
            tension = squared - length[row, here] * np.sqrt(squared)
            tension *= k[row, here]
            rate *= c[row, here]
            tension += rate
            tension /= squared
            along *= tension
            force[:, here] += along
            force[:, offset:] -= along
        return force

    return forces


def _contact_fn(workload: Workload) -> Callable[[Array, Array, Array], Array]:
    """Velocities after forces, drag, gravity and contact, all of shape (3, N, b)."""
    body, dt = workload.body, np.float32(workload.time_step)
    dt_over_mass = (workload.time_step / body.mass).astype(np.float32)[:, None]
    keep, fall = np.float32(1 - workload.time_step * body.material.drag), dt * np.float32(GRAVITY)
    radius, friction = np.float32(body.radius), np.float32(body.material.friction)

    def contact(x: Array, v: Array, force: Array) -> Array:
        force *= dt_over_mass
        v = v * keep
        v += force
        v[2] -= fall
        normal = np.maximum(v[2], (radius - x[2]) / dt)
        sliding = np.sqrt(np.maximum(v[0] * v[0] + v[1] * v[1], np.float32(1e-12)))
        v[:2] *= np.maximum(0, 1 - friction * (normal - v[2]) / sliding)
        v[2] = normal
        return v

    return contact
