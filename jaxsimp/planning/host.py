"""The driver on the host: exchanges compiled ahead, evaluations by any function.

Costs may come from anywhere: from `Planner`, which evaluates plans on all cores, from an engine
that is not in JAX, or from a robot.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, PRNGKeyArray

from jaxsimp.dynamics import Actions
from jaxsimp.engines.rollouts import as_float
from jaxsimp.planning.algorithm import Algorithm, Sequence, Told, Wants
from jaxsimp.planning.archive import Archive, empty_archive
from jaxsimp.planning.loop import (
    Keys,
    Optimum,
    Progress,
    Recorded,
    absorb,
    ask,
    begin,
    finish,
    search,
)
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


Evaluate = Callable[[Wants, Actions], Told]
"""What is wanted of plans, leading axis `B`."""


def search_on_host(
    algorithm: Algorithm | Sequence,
    space: ActionSpace,
    key: PRNGKeyArray,
    evaluate: Evaluate,
    on_ask: Callable[[], None] = lambda: None,
) -> Optimum:
    """Search for a plan of low cost: `optimize`, in a loop on the host.

    Args:
        algorithm: that searches, or several that follow one another.
        space: the plans that may be searched.
        key: of the random draws.
        evaluate: what is wanted of plans; costs may be NumPy arrays.
        on_ask: called after each question of an algorithm.
    """

    def run_stage(
        stage: Algorithm, archive: Archive, failed: Int[Array, ""], keys: Keys
    ) -> tuple[Progress, Actions, Recorded]:
        exchanges, records = compiled_exchanges(stage, space, len(archive.costs)), []
        progress = exchanges.begin(space, archive, failed)
        for each in keys:
            progress, plans, actions = exchanges.ask(space, progress, each)
            told = as_float(evaluate(stage.wants, actions))
            progress, recorded = exchanges.absorb(space, progress, plans, told)
            records.append(recorded)
            on_ask()
        recorded = jax.tree.map(lambda *leaves: np.stack(leaves), *records)
        return progress, exchanges.finish(space, progress), recorded

    def cost_of_one(actions: Actions) -> Told:
        one = jax.tree.map(lambda leaf: leaf[None], actions)
        return Told(jnp.asarray(evaluate("cost", one).costs)[0])

    return search(algorithm, space, key, run_stage, cost_of_one)


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
    begun = _compiled(begin, algorithm, space, archive, failed, options=QUICK)
    progress = begun(space, archive, failed)
    asked = _compiled(ask, algorithm, space, progress, key, options=QUICK)
    progress, plans, actions = asked(space, progress, key)
    told = _no_costs(algorithm, actions)
    absorbed = _compiled(absorb, algorithm, space, progress, plans, told)
    finished = _compiled(finish, algorithm, space, progress, options=QUICK)
    return Exchanges(begun, asked, absorbed, finished)


def _compiled(
    fn: Callable[..., Any], algorithm: Algorithm, *arguments: Any, options: Any = None
) -> Callable[..., Any]:
    """The function, compiled for arguments of these shapes.

    It is compiled of leaves: trees of shapes, and not of arrays, are never made.
    """
    tree, out = jax.tree.structure(arguments), []

    def of_leaves(leaves: list[Array]) -> list[Array]:
        results, out_tree = jax.tree.flatten(fn(algorithm, *jax.tree.unflatten(tree, leaves)))
        out.append(out_tree)
        return results

    jitted = jax.jit(of_leaves, compiler_options=options)
    compiled = jitted.lower(jax.tree.leaves(arguments)).compile()
    return lambda *arguments: jax.tree.unflatten(out[0], compiled(jax.tree.leaves(arguments)))


def _no_costs(algorithm: Algorithm, actions: Actions) -> Told:
    """What the algorithm is told of plans, all zero."""
    costs = jnp.zeros(len(actions.pick), float)
    gradients = jnp.zeros_like(actions.displacement) if algorithm.wants == "gradient" else None
    return Told(costs, gradients)
