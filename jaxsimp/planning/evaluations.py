"""Evaluations of plans of a task on this machine: each kind and size is compiled once."""

import dataclasses
from collections.abc import Sequence as Seq
from functools import cached_property, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxsimp.dynamics import NONE, Actions
from jaxsimp.engines import Engine, Layout, PopulationMap, SearchEngine, default_layout
from jaxsimp.engines.rollouts import as_float
from jaxsimp.planning.algorithm import Algorithm, Told, Wants
from jaxsimp.planning.loop import evaluation
from jaxsimp.planning.problem import TaskProblem, make_problem
from jaxsimp.planning.screening import num_again, screened
from jaxsimp.tasks import Episode, Task


class Evaluations:
    """Functions that evaluate plans, compiled when they are first needed."""

    def __init__(
        self, task: Task, engine: SearchEngine, evaluator: Engine, layout: Layout | None
    ) -> None:
        """Make them; for the arguments see `jaxsimp.planning.Planner`.

        Raises:
            ValueError: if the engine cannot carry out plans of the task.
        """
        self._task, self._engine, self._evaluator = task, engine, evaluator
        self._given_layout = layout
        self._maps: dict[tuple[Wants, int], tuple[TaskProblem, PopulationMap]] = {}
        # Evaluations do not depend on the candidates.
        self._problem = self._host_problem(None)

    def __call__(
        self, wants: Wants, episodes: Seq[Episode], asked: Seq[Actions], size: int
    ) -> list[Told]:
        """Evaluate plans of each episode, at most `size` of each, on all cores.

        Args:
            wants: kind of evaluation.
            episodes: starts and goals, on the host.
            asked: plans for each episode, leading axis at most `size`.
            size: number of plans for which the evaluation is compiled.
        """
        if wants != "screened":
            return self._together(wants, episodes, asked, size)
        return [
            screened(
                partial(self._one, "cost", episode, size),
                partial(self._one, wants, episode, num_again(size)),
                plans,
            )
            for episode, plans in zip(episodes, asked, strict=True)
        ]

    def prepare(self, wants: Wants, size: int) -> None:
        """Compile an evaluation, unless that is done.

        An evaluation compiled for another size does not serve: rounding depends on the size, and
        must not depend on earlier plans.

        Raises:
            ValueError: if the evaluation is one of the evaluator's and that is not in JAX.
        """
        if (wants, size) not in self._maps:
            in_evaluator = wants in ("settled", "screened")
            problem = self._evaluator_problem if in_evaluator else self._problem
            self._maps[wants, size] = problem, self._compiled(problem, wants, size)

    def sizes(self, wants: Wants) -> list[int]:
        """Sizes for which a kind of evaluation is compiled, in order."""
        return sorted(size for kind, size in self._maps if kind == wants)

    def layout(self, wants: Wants, size: int) -> Layout:
        """Layout of an evaluation on this machine."""
        self.prepare(wants, size)
        problem, _ = self._maps[wants, size]
        return self._layout(problem, wants, size)

    def _one(self, wants: Wants, episode: Episode, size: int, plans: Actions) -> Told:
        (told,) = self._together(wants, [episode], [plans], size)
        return told

    def _together(
        self, wants: Wants, episodes: Seq[Episode], asked: Seq[Actions], size: int
    ) -> list[Told]:
        """Evaluate in one fidelity, as many questions at a time as fill all cores.

        A question takes whole chunks, so that its plans run through the same machine code whatever
        others are beside it.
        """
        self.prepare(wants, size)
        problem, evaluate = self._maps[wants, size]
        width = evaluate.whole_chunks(size)
        samples = [
            _samples(episode, actions, width)
            for episode, actions in zip(episodes, asked, strict=True)
        ]
        told: list[Told] = []
        count = max(1, evaluate.capacity // width)
        for first in range(0, len(samples), count):
            group = samples[first : first + count]
            found = evaluate(problem, tuple(map(np.concatenate, zip(*group, strict=True))))
            for index in range(len(group)):
                own = slice(index * width, index * width + len(asked[len(told)].pick))
                told.append(jax.tree.map(lambda leaf, own=own: leaf[own], found))
        return told

    def _compiled(self, problem: TaskProblem, wants: Wants, size: int) -> PopulationMap:
        shape = (size, self._task.num_actions, self._task.num_pickers)
        idle = Actions(jnp.full(shape, NONE), jnp.zeros((*shape, 3), float))
        samples = _samples(problem.episode, idle, size)
        layout = self._layout(problem, wants, size)
        return PopulationMap(partial(_evaluate, wants), problem, samples, layout)

    def _layout(self, problem: TaskProblem, wants: Wants, size: int) -> Layout:
        return self._given_layout or default_layout(size, problem.chunk_size(wants))

    @cached_property
    def _evaluator_problem(self) -> TaskProblem:
        if not isinstance(self._evaluator, SearchEngine):
            raise ValueError(
                f"the algorithm asks for settled scores or screened costs and the evaluator "
                f"is {self._evaluator}, no engine in JAX; give another evaluator, as "
                f"MassSprings(self_contact=True)"
            )
        return self._host_problem(self._evaluator)

    def _host_problem(self, evaluator: SearchEngine | None) -> TaskProblem:
        """A problem with the goal as its start, one candidate, and arrays on the host."""
        goal = np.asarray(self._task.goal)
        found = make_problem(
            self._task, np.zeros(1, int), Episode(goal, goal), self._engine, evaluator
        )
        return dataclasses.replace(found, episode=as_float(found.episode))


def evaluations_of(algorithm: Algorithm) -> list[tuple[Wants, int]]:
    """Kinds and sizes of the evaluations that a question of an algorithm takes, in order."""
    wants, size = algorithm.wants, algorithm.num_plans
    return [("cost", size), (wants, num_again(size))] if wants == "screened" else [(wants, size)]


Samples = tuple[Any, ...]
"""Starts, goals, picks and displacements as bare arrays: `Actions` are none of NumPy's."""


def _samples(episode: Episode, actions: Actions, width: int) -> Samples:
    """The plans of an episode with it beside each, padded to `width` with copies of the last."""
    rows = np.minimum(np.arange(width), len(actions.pick) - 1)
    beside = [np.broadcast_to(leaf, (width, *leaf.shape)) for leaf in jax.tree.leaves(episode)]
    return (*beside, *(np.asarray(leaf)[rows] for leaf in jax.tree.leaves(actions)))


def _evaluate(wants: Wants, problem: TaskProblem, sample: Samples) -> Told:
    start, goal, pick, displacement = sample
    problem = dataclasses.replace(problem, episode=Episode(start, goal))
    return evaluation(problem, wants)(Actions(pick, displacement))
