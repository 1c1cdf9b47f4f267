"""The space of plans: candidates, limits, and plans in units of the limits."""

import reprlib
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxsimp.dynamics import NONE, Actions

ROUNDING = 1e-5
"""Excess of a displacement over its limit that counts as rounding, in units of the limits."""


@partial(jax.tree_util.register_dataclass, data_fields=["choice", "direction"], meta_fields=[])
@dataclass(frozen=True)
class Plans:
    """Plans in the form for algorithms: indices of candidates, and dimensionless displacements.

    Attributes:
        choice: index of the grasped candidate, K for none, shape (*B, T, G).
        direction: displacement in units of the limits, in [-1, 1], shape (*B, T, G, 3).
    """

    choice: Int[Array, "*B T G"]
    direction: Float[Array, "*B T G 3"]


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["candidates", "limits"],
    meta_fields=["num_actions", "num_pickers"],
)
@dataclass(frozen=True)
class ActionSpace:
    """The space of plans to search.

    Attributes:
        candidates: ids of the particles that a picker may grasp, shape (K,).
        limits: largest displacement of one action along x, y, z, shape (3,), metres.
        num_actions: number of actions in a plan, `T`; static.
        num_pickers: number of pickers, `G`; static.
    """

    candidates: Int[Array, " K"]
    limits: Float[Array, " 3"]
    num_actions: int
    num_pickers: int

    def actions(self, plans: Plans) -> Actions:
        """The actions of plans."""
        ids = jnp.append(self.candidates, NONE)
        limits = jnp.broadcast_to(self.limits, plans.direction.shape)
        return Actions(ids[plans.choice], plans.direction * limits)

    def plans(self, actions: Actions) -> Plans:
        """Plans of given actions, the inverse of `actions`: for a search that starts from them.

        Args:
            actions: the plans, shapes (*B, T, G) and (*B, T, G, 3); not under `jit`.

        Raises:
            ValueError: if a shape is not of this space, a pick is neither a candidate nor `NONE`,
                or a displacement is beyond the limits.
        """
        pick, moves = np.asarray(actions.pick), np.asarray(actions.displacement)
        shape = (self.num_actions, self.num_pickers)
        if pick.shape[-2:] != shape or moves.shape != (*pick.shape, 3):
            raise ValueError(
                f"the plans have pick of shape {pick.shape} and displacement of shape "
                f"{moves.shape}; give shapes (*B, {shape[0]}, {shape[1]}), and those with 3"
            )
        ids = np.append(np.asarray(self.candidates), NONE)
        equal = pick[..., None] == ids
        if not equal.any(axis=-1).all():
            wrong = pick[~equal.any(axis=-1)][0]
            raise ValueError(
                f"a plan to start from picks particle {wrong}, which is no candidate; give plans "
                f"that pick of {reprlib.repr(ids[:-1].tolist())}, or this candidate, too"
            )
        direction = moves / np.asarray(self.limits)
        largest = np.abs(direction).max(initial=0.0)
        if not largest <= 1 + ROUNDING:
            raise ValueError(
                f"a plan to start from has a displacement of {largest:.4g} limits; give at most "
                f"the limits, {np.asarray(self.limits).tolist()} m along x, y, z"
            )
        direction = np.clip(direction, -1.0, 1.0)
        return Plans(jnp.asarray(equal.argmax(axis=-1)), jnp.asarray(direction, float))


def as_candidates(
    candidates: Int[np.ndarray, " K"] | Bool[np.ndarray, " N"], num_particles: int
) -> Int[np.ndarray, " K"]:
    """Ids of the candidates, from ids or from a mask of particles.

    Args:
        candidates: ids, shape (K,), or a mask that is True at the candidates, shape (N,).
        num_particles: number of particles of the body, `N`.

    Raises:
        ValueError: if there is no candidate, an id is not a particle of the body or occurs twice,
            or the array has another shape or type.
    """
    try:
        given = np.asarray(candidates)
    except ValueError as error:  # lists of several lengths
        raise ValueError(f"candidates is {candidates!r}; give ids of particles") from error
    if not given.size:
        given = np.zeros(0, dtype=int)  # an empty list is of floats
    if given.dtype == bool and given.shape == (num_particles,):
        given = np.flatnonzero(given)
    if given.ndim != 1 or not np.issubdtype(given.dtype, np.integer):
        raise ValueError(
            f"candidates is an array of {given.dtype} of shape {given.shape}; give the ids of "
            f"particles, shape (K,), or a mask of shape ({num_particles},)"
        )
    wrong = given[(given < 0) | (given >= num_particles)]
    if wrong.size or not given.size:
        named = f"names particle {wrong[0]}" if wrong.size else "is empty"
        raise ValueError(
            f"candidates {named}; give at least one of the ids 0 to {num_particles - 1} of a body "
            f"of {num_particles} particles"
        )
    given = given.astype(given.dtype.newbyteorder("="), copy=False)  # JAX takes no other order
    ids, counts = np.unique(given, return_counts=True)
    if counts.max() > 1:
        raise ValueError(
            f"candidates names particle {ids[counts.argmax()]} twice; give each id once"
        )
    return given
