"""Exchanges of the loop on the host, compiled ahead: nothing is drawn to trigger compilation."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, PRNGKeyArray

from jaxsimp.dynamics import Actions
from jaxsimp.planning.algorithm import Algorithm, Told
from jaxsimp.planning.archive import Archive, empty_archive
from jaxsimp.planning.loop import Progress, Recorded, absorb, ask, begin, finish
from jaxsimp.planning.space import ActionSpace, Plans

QUICK = {"xla_backend_optimization_level": 0}
"""Random bits compile five times as fast unoptimised, and a round draws them once."""


@dataclass(frozen=True)
class Exchanges:
    """Compiled functions of one algorithm and one shape of its space.

    Each is the function of loop.py of its name.
    """

    begin: Callable[[ActionSpace, Archive, Int[Array, ""]], Progress]
    ask: Callable[[ActionSpace, Progress, PRNGKeyArray], tuple[Progress, Plans, Actions]]
    absorb: Callable[[ActionSpace, Progress, Plans, Told], tuple[Progress, Recorded]]
    finish: Callable[[ActionSpace, Progress], Actions]


def compiled_exchanges(algorithm: Algorithm, space: ActionSpace, archive_size: int) -> Exchanges:
    """The exchanges of an algorithm, compiled when they are first wanted for these shapes."""
    shapes = len(space.candidates), space.num_actions, space.num_pickers, archive_size
    return _compile(algorithm, *shapes, jnp.result_type(float))


@cache
def _compile(
    algorithm: Algorithm,
    num_candidates: int,
    num_actions: int,
    num_pickers: int,
    archive_size: int,
    dtype: Any,  # tells caches of different precisions apart
) -> Exchanges:
    ids, limits = jnp.zeros(num_candidates, int), jnp.zeros(3, float)
    space = ActionSpace(ids, limits, num_actions, num_pickers)
    archive = empty_archive(space, archive_size)
    failed, key = jnp.zeros((), jnp.int32), jax.random.key(0)
    lowered_begin = _lower(begin, algorithm, space, archive, failed, options=QUICK)
    lowered_ask = _lower(ask, algorithm, space, lowered_begin.out_info, key, options=QUICK)
    progress, plans, actions = lowered_ask.out_info
    told = _told(algorithm, actions)
    lowered_absorb = _lower(absorb, algorithm, space, progress, plans, told)
    lowered_finish = _lower(finish, algorithm, space, progress, options=QUICK)
    lowered = (lowered_begin, lowered_ask, lowered_absorb, lowered_finish)
    return Exchanges(*(each.compile() for each in lowered))


def _lower(
    fn: Callable[..., Any], algorithm: Algorithm, *arguments: Any, options: Any = None
) -> jax.stages.Lowered:
    """The function of arguments of these shapes, lowered."""
    return jax.jit(partial(fn, algorithm), compiler_options=options).lower(*arguments)


def _told(algorithm: Algorithm, actions: Any) -> Told:
    """The shapes of what the algorithm is told of plans."""
    costs = jax.ShapeDtypeStruct(actions.pick.shape[:1], jnp.result_type(float))
    return Told(costs, actions.displacement if algorithm.wants == "gradient" else None)
