"""Ensembles: the same body under several physics, each of which evaluates every plan.

A plan found in one simulation may owe its cost to that simulation's parameters. An ensemble takes
the cost of a plan over members whose stiffness, damping, drag, friction, mass and time step are
the body's own times factors; see Mordatch, Lowrey and Todorov, "Ensemble-CIO", IROS 2015.
"""

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from jaxsimp.checks import require_choice, require_count, require_number, require_seed
from jaxsimp.dynamics import Actions, Simulation, State, rollout_observing
from jaxsimp.engines.engine import Executor, Observe
from jaxsimp.engines.rollouts import RolloutExecutor
from jaxsimp.engines.springs import MassSprings, Physics, spring_chunk_size
from jaxsimp.tasks import Task

MOST_SPREAD, MOST_MEMBERS, MOST_CAUTION = 1e6, 10_000, 1e3
"""Largest factor of a spread, size of an ensemble, and caution."""
MOST_REFINEMENT = 4.0
"""Largest ratio of the task's time step to the ensemble's; a spread that needs more is an error."""


@dataclass(frozen=True)
class Spread:
    """Range of the members' physics around the body's own.

    Each number is the largest factor, up or down: 1 leaves the quantity as it is.

    Attributes:
        stiffness: factor on the stiffness of all springs.
        damping: factor on the damping of all springs.
        drag: factor on air drag.
        friction: factor on friction with obstacles.
        mass: factor on the mass of all particles.
        time_step: factor on the time step. An action takes the same number of time steps in every
            member, so its duration has this factor too: pickers are slower or faster.

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
            require_number(name, factor, 1.0, MOST_SPREAD)


QUANTITIES = tuple(field.name for field in dataclasses.fields(Spread))


@dataclass(frozen=True, eq=False)
class Ensemble:
    """An engine: one body under E physics; a plan's cost is its risk over them.

    Attributes:
        simulations: stacked simulations: every leaf has a first axis `E`. Member 0 is the body
            itself.
        action_steps: number of time steps of an action, in every member.
        factors: factors of each member, in the order of `QUANTITIES`, shape (E, 6).
        statistic: "mean", the mean cost over the members, or "worst", the largest.
        caution: number of standard deviations over the members that the risk adds to the mean.

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
        require_choice("statistic", self.statistic, ("mean", "worst"))
        require_number("caution", self.caution, 0.0, MOST_CAUTION)
        if self.statistic == "worst" and self.caution:
            raise ValueError(f"caution is {self.caution}; give 0, as it goes with the mean")

    def __len__(self) -> int:
        """Number of members, `E`."""
        return len(self.factors)

    def physics(self, task: Task) -> Physics:
        """The stacked simulations, and pickers with their number of time steps.

        Raises:
            ValueError: if the ensemble's body has another number of particles.
        """
        found = self.simulations.mass.shape[1]
        if found != task.body.num_particles:
            raise ValueError(
                f"the ensemble is of {found} particles and {task.name} has "
                f"{task.body.num_particles}; make one of this task"
            )
        return self.simulations, dataclasses.replace(task.pickers(), steps=self.action_steps)

    def rollout(
        self, physics: Physics, state: State, actions: Actions, observe: Observe
    ) -> tuple[State, PyTree[Any]]:
        """Carry out a plan in every member: states and observations have a first axis `E`.

        The members run in a loop, not along a batch axis: under `vmap` over plans the whole batch
        shares one simulation, and its time steps run with the batch axis last; see batching.py.
        """
        simulations, pickers = physics

        def one(simulation: Simulation) -> tuple[State, PyTree[Any]]:
            return rollout_observing(simulation, pickers, state, actions, observe)

        return jax.lax.map(one, simulations)

    def risk(self, costs: Float[Array, " E"]) -> Float[Array, ""]:
        """Cost of a plan from its costs in the members: infinite if one of them is not finite."""
        failed = ~jnp.isfinite(costs).all()
        costs = jnp.where(failed, 0.0, costs)
        if self.statistic == "worst":
            cost = costs.max()
        else:
            cost = costs.mean() + self.caution * costs.std() if self.caution else costs.mean()
        return jnp.where(failed, jnp.inf, cost)

    def chunk_size(self, physics: Physics) -> int:
        """The chunk size of the members."""
        return spring_chunk_size(_member_of(physics, 0)[0])

    def executor(self, task: Task) -> Executor:
        """An executor of plans in member 0, the body itself."""
        alone = MassSprings(self.simulations.self_contact is not None)
        return RolloutExecutor(task, alone, _member_of(self.physics(task), 0))


def _member_of(physics: Physics, index: int) -> Physics:
    """The physics of one member."""
    return jax.tree.map(lambda leaf: leaf[index], physics[0]), physics[1]


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

    The logarithms of the factors are a Latin hypercube: for each quantity, each of `size - 1`
    equal parts of the spread holds one member. The time step of member 0 is the task's, or the
    shorter one at which all members are stable (nine tenths of the largest stable one, as for a
    task); the duration of actions changes only by `spread.time_step`.

    Args:
        task: the task.
        size: number of members, `E`.
        seed: seed of the factors.
        spread: range of the factors.
        self_contact: whether the body touches itself, in every member.
        statistic: see `Ensemble`.
        caution: see `Ensemble`.

    Raises:
        ValueError: if the size is below 1, or the members are stable only at a time step that is
            shorter than the task's by a factor above `MOST_REFINEMENT`; see also `Ensemble`, and
            `Task.simulation` for self-contact.
    """
    size, seed = require_count("size", size, 1, MOST_MEMBERS), require_seed(seed)
    spread = Spread() if spread is None else spread
    if not isinstance(spread, Spread):
        raise ValueError(f"spread is {spread!r}; give Spread(...), of factors of at least 1")
    factors = draw_factors(size, seed, spread)
    members = [_scaled_task(task, dict(zip(QUANTITIES, row, strict=True))) for row in factors]
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


def _scaled_task(task: Task, factors: dict[str, float]) -> Task:
    """The task with scaled physics of its body, and its longest time step scaled too."""
    return dataclasses.replace(
        task,
        body=task.body.scaled(**{k: v for k, v in factors.items() if k != "time_step"}),
        longest_time_step=task.longest_time_step * factors["time_step"],
    )
