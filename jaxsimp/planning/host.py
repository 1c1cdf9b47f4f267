"""The driver on the host: exchanges compiled ahead, evaluations by any function.

Costs may come from `Planner`, which evaluates plans on all cores, from an engine that is not in
JAX, or from a robot.
"""

from collections.abc import Callable, Generator
from dataclasses import dataclass
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, PRNGKeyArray

from jaxsimp.dynamics import Actions
from jaxsimp.dynamics.arrays import as_array
from jaxsimp.engines.rollouts import as_float
from jaxsimp.planning.algorithm import Algorithm, Sequence, Told, Wants
from jaxsimp.planning.archive import Archive, empty_archive
from jaxsimp.planning.loop import (
    Keys,
    Optimum,
    Progress,
    Question,
    Ran,
    Recorded,
    Search,
    absorb,
    answered,
    ask,
    begin,
    finish,
    search,
)
from jaxsimp.planning.space import ActionSpace, Plans

QUICK = {"xla_backend_optimization_level": 0}
"""Compiler options for random bits: they compile five times as fast unoptimised, and a round draws
them only once."""


@dataclass(frozen=True)
class Exchanges:
    """Compiled functions of one algorithm and one shape of its space.

    Each is the function of loop.py with the same name.
    """

    begin: Callable[[ActionSpace, Archive, Int[Array, ""]], Progress]
    ask: Callable[[ActionSpace, Progress, PRNGKeyArray], tuple[Progress, Plans, Actions]]
    absorb: Callable[[ActionSpace, Progress, Plans, Told], tuple[Progress, Recorded]]
    finish: Callable[[ActionSpace, Progress], Actions]


Evaluate = Callable[[Wants, Actions], Told]
"""Evaluates plans as the algorithm wants, leading axis `B`."""


def search_on_host(
    algorithm: Algorithm | Sequence,
    space: ActionSpace,
    key: PRNGKeyArray,
    evaluate: Evaluate,
    on_ask: Callable[[], None] = lambda: None,
    initial: Plans | None = None,
) -> Optimum:
    """Search for a plan of low cost: `optimize`, in a loop on the host.

    Args:
        algorithm: algorithm of the search, or a sequence of algorithms.
        space: space of plans to search.
        key: key of the random draws.
        evaluate: function that evaluates plans; costs may be NumPy arrays.
        on_ask: function called after each question of an algorithm.
        initial: plans to start from, leading axis `B`, as `space.plans` makes them of actions.

    Raises:
        ValueError: if `evaluate` returns no `Told`, or no number for each plan; numbers that are
            not finite count as failures. If the shapes of `initial` are not those of plans.
    """

    def answers(asked: list[Question]) -> list[Told]:
        return [_checked(evaluate(*each), *each) for each in asked]

    (found,) = answered([questions(algorithm, space, key, on_ask, initial)], answers)
    return found


def questions(
    algorithm: Algorithm | Sequence,
    space: ActionSpace,
    key: PRNGKeyArray,
    on_ask: Callable[[], None] = lambda: None,
    initial: Plans | None = None,
) -> Search:
    """A search on the host, which yields its questions; for the arguments see `search_on_host`."""

    def run_stage(
        stage: Algorithm, archive: Archive, failed: Int[Array, ""], keys: Keys
    ) -> Generator[Question, Any, Ran]:
        exchanges, records = compiled_exchanges(stage, space, len(archive.costs)), []
        progress = exchanges.begin(space, archive, failed)
        for each in keys:
            progress, plans, actions = exchanges.ask(space, progress, each)
            told = yield stage.wants, actions
            progress, recorded = exchanges.absorb(space, progress, plans, told)
            records.append(recorded)
            on_ask()
        recorded = jax.tree.map(lambda *leaves: np.stack(leaves), *records)
        return progress, exchanges.finish(space, progress), recorded

    return search(algorithm, space, key, run_stage, initial)


def _checked(told: Any, wants: Wants, actions: Actions) -> Told:
    """Evaluations of plans as floats on the host, with gradients if they are wanted."""
    if not isinstance(told, Told):
        raise ValueError(f"evaluate returns a {type(told).__name__}; return Told(costs)")
    shapes = {"costs": actions.pick.shape[:1]}
    if wants == "gradient":
        shapes["gradients"] = actions.displacement.shape
    found = {name: as_array(f"{name} of evaluate", getattr(told, name)) for name in shapes}
    for name, wanted in shapes.items():
        if found[name].shape != wanted:
            raise ValueError(
                f"evaluate returns {name} of shape {found[name].shape}; return shape {wanted}, for "
                f"{len(actions.pick)} plans"
            )
    return Told(**as_float(found))


def compiled_exchanges(algorithm: Algorithm, space: ActionSpace, archive_size: int) -> Exchanges:
    """The exchanges of an algorithm, compiled at the first call with these shapes."""
    shapes = len(space.candidates), space.num_actions, space.num_pickers, archive_size
    return _compile(algorithm, *shapes, jnp.result_type(float))


@cache
def _compile(
    algorithm: Algorithm,
    num_candidates: int,
    num_actions: int,
    num_pickers: int,
    archive_size: int,
    dtype: Any,  # separates caches of different precisions
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

    It takes leaves, so JAX never builds trees of shapes instead of arrays.
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
    """Evaluations of plans as the algorithm wants them, all zero."""
    costs = jnp.zeros(len(actions.pick), float)
    gradients = jnp.zeros_like(actions.displacement) if algorithm.wants == "gradient" else None
    return Told(costs, gradients)
