"""Ensembles: the same body under several physics, so that a plan is judged by all of them.

A plan found in one simulation may owe its cost to that simulation's numbers. Here a plan's cost is
taken over members whose stiffness, damping, drag, friction, mass and time step are the body's own
times factors; see Mordatch, Lowrey and Todorov, "Ensemble-CIO", IROS 2015.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsimp.dynamics import Actions, Pickers, Simulation
from jaxsimp.tasks import Episode, Task

MOST_REFINEMENT = 4.0
"""A spread that needs a time step shorter than the task's by more than this is refused."""


@dataclass(frozen=True)
class Spread:
    """How far the members' physics is from the body's own.

    Each number is the largest factor, up or down: 1 leaves the quantity as it is.

    Attributes:
        stiffness: of all springs.
        damping: of all springs.
        drag: of the air.
        friction: with the table.
        mass: of all particles.
        time_step: of the integration. An action takes as many time steps in every member, so
            the duration of actions has the same factor: pickers are slower or faster, too.

    Raises:
        ValueError: if a number is below 1 or not finite.
    """

    stiffness: float = 1.5
    damping: float = 1.5
    drag: float = 1.5
    friction: float = 1.5
    mass: float = 1.2
    time_step: float = 1.1

    def __post_init__(self) -> None:
        for name, factor in dataclasses.asdict(self).items():
            if not 1 <= factor < np.inf:
                raise ValueError(
                    f"{name} is {factor}; a spread is the largest factor up or down, 1 or more"
                )


QUANTITIES = tuple(field.name for field in dataclasses.fields(Spread))


@dataclass(frozen=True, eq=False)
class Ensemble:
    """Simulations of one body under different physics, and how costs in them become one.

    Attributes:
        simulations: stacked: every leaf has a first axis `E`. Member 0 is the body itself.
        action_steps: time steps of an action, in every member.
        factors: of each member, by quantity in the order of `QUANTITIES`, shape (E, 6).
        statistic: the "mean" cost over the members, or that of the "worst".
        caution: as many standard deviations over the members are added to the mean.

    Raises:
        ValueError: if the statistic is unknown, or caution is negative, not finite, or given
            for the worst.
    """

    simulations: Simulation
    action_steps: int
    factors: Float[np.ndarray, "E Q"]
    statistic: Literal["mean", "worst"] = "mean"
    caution: float = 0.0

    def __post_init__(self) -> None:
        if self.statistic not in ("mean", "worst"):
            raise ValueError(f'statistic is {self.statistic}; give "mean" or "worst"')
        if not 0 <= self.caution < np.inf:
            raise ValueError(f"caution is {self.caution}; give a finite number, zero or more")
        if self.statistic == "worst" and self.caution:
            raise ValueError(f"caution is {self.caution}; it goes with the mean, not the worst")

    def __len__(self) -> int:
        """Number of members, `E`."""
        return len(self.factors)

    def physics(self, task: Task) -> tuple[Simulation, Pickers]:
        """The stacked simulations, and pickers that take their number of time steps."""
        return self.simulations, dataclasses.replace(task.pickers(), steps=self.action_steps)

    def cost(self, costs: Float[np.ndarray, "B E"]) -> Float[np.ndarray, " B"]:
        """Cost of each plan from those in the members: not finite if one of them is not."""
        failed = ~np.isfinite(costs).all(axis=1)
        costs = np.where(failed[:, None], 0.0, costs)
        mean = costs.mean(axis=1)
        if self.statistic == "worst":
            cost = costs.max(axis=1)
        else:
            cost = mean + self.caution * costs.std(axis=1) if self.caution else mean
        return np.where(failed, np.inf, cost)


def make_ensemble(
    task: Task,
    size: int = 5,
    seed: int = 0,
    spread: Spread | None = None,
    *,
    self_contact: bool = False,
    statistic: Literal["mean", "worst"] = "mean",
    caution: float = 0.0,
) -> Ensemble:
    """An ensemble of a task's body.

    The logarithms of the factors fill the spread evenly: in each quantity every one of
    `size - 1` equal parts of it has one member (a Latin hypercube). The time step of member 0 is
    the task's, or as much shorter as it takes for all members to be stable (nine tenths of the
    largest stable one, as for a task); actions keep their duration but for `spread.time_step`.

    Args:
        task: whose body it is.
        size: number of members, `E`.
        seed: of the factors.
        spread: of the factors.
        self_contact: whether the body touches itself, in every member.
        statistic: see `Ensemble`.
        caution: see `Ensemble`.

    Raises:
        ValueError: if the size is below 1, or members so different are stable only at a time
            step below the task's by more than `MOST_REFINEMENT`; see also `Ensemble`, and
            `Task.simulation` for self-contact.
    """
    if size < 1:
        raise ValueError(f"size is {size}; an ensemble has at least 1 member")
    spread = spread or Spread()
    factors = draw_factors(size, seed, spread)
    members = [_member(task, dict(zip(QUANTITIES, row, strict=True))) for row in factors]
    durations = factors[:, QUANTITIES.index("time_step")]
    # A member's own time step is nine tenths of its largest, or the task's longest.
    step = min(member.time_step / each for member, each in zip(members, durations, strict=True))
    if step * MOST_REFINEMENT < task.time_step:
        raise ValueError(
            f"members of {spread} are stable up to {step:.3g} s, and the task's time step is "
            f"{task.time_step:.3g} s; give a smaller spread of stiffness, damping or mass"
        )
    stepped = [
        dataclasses.replace(member, longest_time_step=step * each).simulation(
            self_contact=self_contact
        )
        for member, each in zip(members, durations, strict=True)
    ]
    return Ensemble(
        simulations=jax.tree.map(lambda *leaves: jnp.stack(leaves), *stepped),
        action_steps=round(task.action_seconds / step),
        factors=factors,
        statistic=statistic,
        caution=caution,
    )


def draw_factors(size: int, seed: int, spread: Spread) -> Float[np.ndarray, "E Q"]:
    """Factors of each member: 1 for the first, a Latin hypercube in the logarithm for others."""
    rng, others = np.random.default_rng(seed), size - 1
    largest = np.log([getattr(spread, name) for name in QUANTITIES])
    shape = (others, len(QUANTITIES))
    part = rng.permuted(np.tile(np.arange(others)[:, None], (1, shape[1])), axis=0)
    place = (part + rng.uniform(size=shape)) / max(others, 1)
    return np.concatenate([np.ones((1, shape[1])), np.exp((2 * place - 1) * largest)])


def _member(task: Task, factors: dict[str, float]) -> Task:
    """The task with a body of other physics; its longest time step has the factor, too."""
    return dataclasses.replace(
        task,
        body=task.body.scaled(**{k: v for k, v in factors.items() if k != "time_step"}),
        longest_time_step=task.longest_time_step * factors["time_step"],
    )


PlanCost = Callable[[tuple[tuple[Simulation, Pickers], Episode], Actions], Float[Array, ""]]


def over_members(cost_fn: PlanCost) -> Callable[[Any, Actions], Float[Array, " E"]]:
    """The costs of a plan in each of stacked simulations, from the function of one simulation.

    A loop, not one more axis of a batch: under `vmap` over plans all of a batch share the
    simulation, and their time steps run with the batch last; see batching.py.
    """

    def costs(
        shared: tuple[tuple[Simulation, Pickers], Episode], actions: Actions
    ) -> Float[Array, " E"]:
        (simulations, pickers), episode = shared

        def one(simulation: Simulation) -> Float[Array, ""]:
            return cost_fn(((simulation, pickers), episode), actions)

        return jax.lax.map(one, simulations)

    return costs
