"""Optimisation: algorithms run on a problem. The code that both drivers share.

`optimize` is a pure function, its loop a `lax.scan`: `jit` and `vmap` apply, over keys and over
episodes. `Planner` runs the same `search`, the exchanges of each stage in a loop on the host.
"""

from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree, Shaped

from jaxsimp.checks import require_count
from jaxsimp.dynamics import Actions
from jaxsimp.planning.algorithm import Algorithm, Sequence, Told, Wants, stages
from jaxsimp.planning.archive import Archive, archived, empty_archive
from jaxsimp.planning.problem import Problem
from jaxsimp.planning.screening import screened
from jaxsimp.planning.space import ActionSpace, Plans


@partial(
    jax.tree_util.register_dataclass, data_fields=["state", "archive", "failed"], meta_fields=[]
)
@dataclass(frozen=True)
class Progress:
    """Progress of an algorithm.

    Attributes:
        state: state of the algorithm.
        archive: best distinct plans so far.
        failed: number of plans so far whose cost was not finite.
    """

    state: PyTree[Any]
    archive: Archive
    failed: Int[Array, ""]


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["actions", "cost", "archive", "best_costs", "traces", "failed"],
    meta_fields=[],
)
@dataclass(frozen=True)
class Optimum:
    """Result of a search; `jax.vmap` may add axes before all shapes.

    Attributes:
        actions: the plan, shapes (T, G) and (T, G, 3).
        cost: cost of that plan; infinite if no rollout was finite.
        archive: best distinct plans, in units of the limits.
        best_costs: lowest cost so far after each question, shape (asks,).
        traces: results of `Algorithm.trace` after each question, by name, for each algorithm.
        failed: number of plans whose cost was not finite.
    """

    actions: Actions
    cost: Float[Array, "*E"]
    archive: Archive
    best_costs: Float[Array, "*E asks"]
    traces: tuple[Mapping[str, Array | np.ndarray], ...]
    failed: Int[Array, "*E"]


Keys = Shaped[Array, "asks *key"]
"""A key for each question."""
Question = tuple[Wants, Actions]
"""Plans to evaluate, leading axis `B`, and the kind of evaluation."""
Ran = tuple[Progress, Actions, "Recorded"]
"""Progress after the last exchange of an algorithm, its plan, and a record."""
RunStage = Callable[[Algorithm, Archive, Int[Array, ""], Keys], Generator[Question, Any, Ran]]
"""Runs one algorithm from an archive and a count of failures, one exchange per key. A generator: it
yields the questions that it does not answer itself."""
Search = Generator[Question, Any, Optimum]
"""A search: it yields questions, and is sent their answers."""
Recorded = tuple[Float[Array | np.ndarray, "*asks"], Mapping[str, Array | np.ndarray]]
"""Lowest cost so far, and the result of `Algorithm.trace`, after one exchange or after each."""


def optimize(
    problem: Problem,
    algorithm: Algorithm | Sequence,
    key: PRNGKeyArray,
    *,
    batch: int | None = None,
    initial: Plans | None = None,
) -> Optimum:
    """Search for a plan of low cost; pure, so that `jit` and `vmap` apply.

    A plan whose cost is not finite ranks last and counts as failed.

    Args:
        problem: problem to minimise.
        algorithm: algorithm of the search, or a sequence of algorithms.
        key: key of the random draws.
        batch: number of plans evaluated at a time under one `vmap`; by default all plans of a
            question.
        initial: plans to start from, leading axis `B`, as `space.plans` makes them of actions.

    Raises:
        ValueError: if the key is no key, `batch` is no number of plans, or the shapes of `initial`
            are not those of plans.
    """
    if batch is not None:
        require_count("batch", batch, 1)
    space, evaluate = problem.space, partial(_population, problem, batch)

    def run_stage(
        stage: Algorithm, archive: Archive, failed: Int[Array, ""], keys: Keys
    ) -> Generator[Question, Any, Ran]:
        yield from ()  # the questions of a loop are answered inside it

        def exchange(progress: Progress, key: PRNGKeyArray) -> tuple[Progress, Recorded]:
            progress, plans, actions = ask(stage, space, progress, key)
            return absorb(stage, space, progress, plans, evaluate(stage.wants, actions))

        first = begin(stage, space, archive, failed)
        progress, recorded = jax.lax.scan(exchange, first, keys)
        return progress, finish(stage, space, progress), recorded

    searching = search(algorithm, space, key, run_stage, initial)
    (found,) = answered([searching], lambda asked: [evaluate(*each) for each in asked])
    return found


def answered(
    searches: list[Search], evaluate: Callable[[list[Question]], list[Told]]
) -> list[Optimum]:
    """Results of searches side by side, of the same algorithm: a function answers all questions.

    Args:
        searches: the searches, which ask as many questions of the same kinds.
        evaluate: function from a question of each search to its answers.
    """
    asked = [_step(each, None) for each in searches]
    while not isinstance(asked[0], Optimum):
        told = evaluate(asked)
        asked = [_step(*each) for each in zip(searches, told, strict=True)]
    return asked


def _step(search: Search, told: Told | None) -> Any:
    """The next question of a search, or its result."""
    try:
        return search.send(told)
    except StopIteration as done:
        return done.value


def search(
    algorithm: Algorithm | Sequence,
    space: ActionSpace,
    key: PRNGKeyArray,
    run_stage: RunStage,
    initial: Plans | None = None,
) -> Search:
    """Run the algorithms one after another, for both drivers.

    Args:
        algorithm: algorithm of the search, or a sequence of algorithms.
        space: space of plans to search.
        key: key of the random draws.
        run_stage: function that runs the exchanges of one algorithm.
        initial: plans to start from, leading axis `B`; None for none.

    Yields:
        The plans to start from; the questions of `run_stage`; and the plan that is returned, for
        its cost, if an algorithm's answer is not the best plan.
    """
    _require_key(key)
    archive, failed = empty_archive(space, archive_size(algorithm)), jnp.zeros((), jnp.int32)
    if initial is not None:
        _require_plans(space, initial)
        told = finite((yield "cost", space.actions(initial)))
        archive = archived(archive, space, initial, told.costs)
        failed = failed + jnp.sum(jnp.isinf(told.costs), dtype=jnp.int32)
    records = []
    for index, stage in enumerate(stages(algorithm)):
        own = jax.random.fold_in(key, index) if index else key
        keys = jax.random.split(own, stage.num_asks)
        progress, actions, recorded = yield from run_stage(stage, archive, failed, keys)
        archive, failed = progress.archive, progress.failed
        records.append(recorded)
    cost = archive.costs[0]
    if jax.eval_shape(lambda: jax.tree.leaves(stage.answer(space, progress.state))):
        told = yield "cost", jax.tree.map(lambda leaf: leaf[None], actions)
        cost = jnp.asarray(finite(told).costs)[0]
        failed = failed + jnp.isinf(cost)
    best_costs = jnp.concatenate([costs for costs, _ in records])
    return Optimum(actions, cost, archive, best_costs, tuple(trace for _, trace in records), failed)


def _require_plans(space: ActionSpace, plans: Plans) -> None:
    """Raise a `ValueError` unless the shapes are those of several plans of a space."""
    shape = (space.num_actions, space.num_pickers)
    choice, direction = np.shape(plans.choice), np.shape(plans.direction)
    if len(choice) != 3 or choice[1:] != shape or not choice[0] or direction != (*choice, 3):
        raise ValueError(
            f"initial has choice of shape {choice} and direction of shape {direction}; give shapes "
            f"(B, {shape[0]}, {shape[1]}) and (B, {shape[0]}, {shape[1]}, 3)"
        )


def _require_key(key: Any) -> None:
    """Raise a `ValueError` unless it is one key, of the new or the old kind."""
    kind, shape = getattr(key, "dtype", None), np.shape(key)
    is_new = kind is not None and jnp.issubdtype(kind, jax.dtypes.prng_key) and shape == ()
    if not is_new and not (kind == jnp.uint32 and len(shape) == 1):
        told = f"{kind} of shape {shape}" if kind is not None else repr(key)
        raise ValueError(f"key is {told}; give one key, as made by jax.random.key(seed)")


def archive_size(algorithm: Algorithm | Sequence) -> int:
    """Size of the archive that the algorithms which start from it need."""
    return max(1, *(stage.num_starts for stage in stages(algorithm)))


def begin(
    algorithm: Algorithm, space: ActionSpace, archive: Archive, failed: Int[Array, ""]
) -> Progress:
    """Progress before the first question."""
    return Progress(algorithm.init(space, archive), archive, failed)


def ask(
    algorithm: Algorithm, space: ActionSpace, progress: Progress, key: PRNGKeyArray
) -> tuple[Progress, Plans, Actions]:
    """Ask a question: plans to evaluate, and their actions."""
    state, plans = algorithm.ask(space, progress.state, key)
    return Progress(state, progress.archive, progress.failed), plans, space.actions(plans)


def absorb(
    algorithm: Algorithm, space: ActionSpace, progress: Progress, plans: Plans, told: Told
) -> tuple[Progress, Recorded]:
    """Take in the evaluations of a question: the new progress, and a record."""
    failed = progress.failed + jnp.sum(~jnp.isfinite(told.costs), dtype=jnp.int32)
    told = finite(told)
    if told.gradients is not None:  # from metres to units of the limits
        limits = jnp.broadcast_to(space.limits, told.gradients.shape)
        told = Told(told.costs, told.gradients * limits)
    state = algorithm.tell(space, progress.state, plans, told)
    archive = progress.archive
    if algorithm.wants != "settled":  # settled scores are not costs
        archive = archived(archive, space, plans, told.costs)
    return Progress(state, archive, failed), (archive.costs[0], algorithm.trace(state))


def finish(algorithm: Algorithm, space: ActionSpace, progress: Progress) -> Actions:
    """The plan that an algorithm returns: its answer, or the best of the archive."""
    plan = algorithm.answer(space, progress.state)
    if plan is None:
        plan = jax.tree.map(lambda leaf: leaf[0], progress.archive.plans)
    return space.actions(plan)


def finite(told: Told) -> Told:
    """Replace costs that are not finite with infinity, and such gradients with zero."""
    gradients = told.gradients
    if gradients is not None:
        fine = jnp.isfinite(gradients).all(axis=(-3, -2, -1), keepdims=True)
        gradients = jnp.where(fine, gradients, 0.0)
    return Told(jnp.where(jnp.isfinite(told.costs), told.costs, jnp.inf), gradients)


def evaluation(problem: Problem, wants: Wants) -> Callable[[Actions], Told]:
    """Function that evaluates one plan as wanted; gradients are by its displacements.

    For "screened" that is the second look at one of the best plans.
    """
    if wants == "cost":
        return lambda actions: Told(problem.cost(actions))
    if wants == "screened":
        return lambda actions: Told(problem.evaluator_cost(actions))
    if wants == "settled":
        return lambda actions: Told(problem.settled_cost(actions))

    def cost(displacement: Float[Array, "T G 3"], pick: Int[Array, "T G"]) -> Float[Array, ""]:
        return problem.cost(Actions(pick, displacement))

    return lambda actions: Told(*jax.value_and_grad(cost)(actions.displacement, actions.pick))


def _population(problem: Problem, batch: int | None, wants: Wants, plans: Actions) -> Told:
    """Evaluate a population as wanted."""
    mapped = partial(_mapped, evaluation(problem, wants), batch=batch)
    if wants != "screened":
        return mapped(plans)
    return screened(partial(_mapped, evaluation(problem, "cost"), batch=batch), mapped, plans)


def _mapped(evaluate: Callable[[Actions], Told], plans: Actions, *, batch: int | None) -> Told:
    """Evaluate plans along a first axis."""
    if batch is None:
        return jax.vmap(evaluate)(plans)
    return jax.lax.map(evaluate, plans, batch_size=batch)
