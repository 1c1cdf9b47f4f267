"""The step in plain JAX: gather the ends of every spring, scatter-add the forces, `vmap` it all."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from experiments.benchmark.peers.workload import GRAVITY, Workload


def prepare(workload: Workload) -> Callable[[], np.ndarray]:
    """A function giving the final positions, shape (B, N, 3), metres."""
    body, dt = workload.body, workload.time_step
    first, second = jnp.asarray(body.springs.T)
    stiffness, damping, rest_length, mass, start, shares = (
        jnp.asarray(array, dtype=float)
        for array in (
            body.stiffness,
            body.damping,
            body.rest_length,
            body.mass,
            workload.start,
            workload.shares,
        )
    )

    def step(x: Array, v: Array, pick: Array, carried: Array) -> tuple[Array, Array]:
        along, speed = x[second] - x[first], v[second] - v[first]
        length = jnp.sqrt(jnp.maximum(jnp.sum(along**2, axis=1), workload.shortest**2))
        rate = jnp.sum(along * speed, axis=1)
        tension = stiffness * (1 - rest_length / length) + damping * rate / length**2
        pull = tension[:, None] * along
        force = jnp.zeros_like(x).at[first].add(pull).at[second].add(-pull)
        v = v * (1 - dt * body.material.drag) + dt * force / mass[:, None]
        v = v.at[:, 2].add(-dt * GRAVITY)
        normal = jnp.maximum(v[:, 2], (body.radius - x[:, 2]) / dt)
        sliding = jnp.sqrt(jnp.maximum(v[:, 0] ** 2 + v[:, 1] ** 2, 1e-12))
        kept = jnp.maximum(0.0, 1 - body.material.friction * (normal - v[:, 2]) / sliding)
        v = jnp.stack([v[:, 0] * kept, v[:, 1] * kept, normal], axis=1)
        v = v.at[pick].set(carried)
        return x + dt * v, v

    def rollout(pick: Array, displacement: Array) -> Array:
        def act(state: tuple[Array, Array], action: tuple[Array, Array]) -> tuple:
            ids, move = action

            def advance(state: tuple[Array, Array], share: Array) -> tuple:
                return step(*state, ids, move * (share / dt)), None

            return jax.lax.scan(advance, state, shares)

        state = start, jnp.zeros_like(start)
        return jax.lax.scan(act, state, (pick, displacement))[0][0]

    plans = jnp.asarray(workload.pick), jnp.asarray(workload.displacement, dtype=float)
    compiled = jax.jit(jax.vmap(rollout)).lower(*plans).compile()
    return lambda: np.asarray(compiled(*plans))
