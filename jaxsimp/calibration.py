"""Calibration: the physics of a body from recorded motions, by gradient descent.

Factors on stiffness, damping, drag and friction minimise the distance of replays of recorded
actions from the recorded positions. The gradient goes backwards through every time step
(adjoint.py).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import ceil, log
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from jaxsimp.bodies import Body
from jaxsimp.bodies.material import PARAMETERS
from jaxsimp.checks import (
    keep,
    require_choice,
    require_count,
    require_ids,
    require_number,
    require_numbers,
    require_reals,
    require_shape,
    require_whole,
    told,
)
from jaxsimp.dynamics.arrays import FARTHEST
from jaxsimp.dynamics.pickers import Actions, Pickers, make_pickers, require_actions
from jaxsimp.dynamics.rollouts import rollout
from jaxsimp.dynamics.simulation import Simulation, State, largest_time_step, make_simulation
from jaxsimp.dynamics.springs import make_springs

LONGEST_TIME_STEP = 2e-3
"""Longest time step of replays, seconds."""
SECONDS = {"action_seconds": (1e-4, 1e4), "longest_time_step": (1e-6, 1.0)}
"""Least and most of times, seconds, as of a task."""
MOST_KINDS = 4
"""Number of different stiffnesses above which all springs share one factor."""

Factors = dict[str, Float[Array, "..."]]
"""Factors by name of the parameter: shape (kinds,) for stiffness, () for the others."""


@partial(
    jax.tree_util.register_dataclass, data_fields=["start", "actions", "positions"], meta_fields=[]
)
@dataclass(frozen=True)
class Recording:
    """A recorded motion.

    Attributes:
        start: positions and velocities before the first action, shape (N, 3).
        actions: actions of the pickers, shapes (T, G) and (T, G, 3).
        positions: positions after each action, shape (T, N, 3), metres.
    """

    start: State
    actions: Actions
    positions: Float[Array | np.ndarray, "... T N 3"]


@dataclass(frozen=True)
class CalibrationConfig:
    """Settings of a calibration.

    Attributes:
        parameters: names in `PARAMETERS` to fit; the others keep the body's values.
        steps: number of steps of gradient descent (Adam, with cosine decay of the learning rate
            to zero).
        learning_rate: initial learning rate, in natural logarithms of a factor.
        largest_factor: largest factor on a parameter. All factors below it must be stable, so the
            time step falls with its square root.
        smallest_factor: smallest factor on a parameter.
        longest_time_step: longest time step of replays, seconds.

    Raises:
        ValueError: if a parameter is unknown or a number is out of its range.
    """

    parameters: tuple[str, ...] = PARAMETERS
    steps: int = 150
    learning_rate: float = 0.1
    largest_factor: float = 5.0
    smallest_factor: float = 0.01
    longest_time_step: float = LONGEST_TIME_STEP

    def __post_init__(self) -> None:
        if not isinstance(self.parameters, tuple | list) or not self.parameters:
            raise ValueError(
                f"parameters is {told(self.parameters)}; give a tuple of names, of "
                f"{', '.join(PARAMETERS)}"
            )
        for name in self.parameters:
            require_choice("a name in parameters", name, PARAMETERS)
        keep(self, parameters=tuple(self.parameters))  # hashed, when compiled
        require_count("steps", self.steps, 1, 1_000_000)
        require_number("learning_rate", self.learning_rate, 1e-6, 10.0)
        require_number("largest_factor", self.largest_factor, 1.001, 1e6)
        require_number("smallest_factor", self.smallest_factor, 1e-9, 0.999)
        _require_seconds("longest_time_step", self.longest_time_step)


@dataclass(frozen=True, eq=False)
class Calibration:
    """Result of a calibration.

    Attributes:
        body: the body with the best physics found.
        factors: factors of that physics relative to the given body; stiffness has one per kind.
        errors: root-mean-square distance of replays from the recordings before each step of
            the descent and at its end, shape (steps + 1,), metres; not finite where a replay
            is not finite.
    """

    body: Body
    factors: dict[str, np.ndarray]
    errors: Float[np.ndarray, " I"]


def calibrate(
    body: Body,
    recordings: Sequence[Recording],
    action_seconds: float,
    config: CalibrationConfig | None = None,
    *,
    kinds: Int[np.ndarray, " S"] | None = None,
    gravity: float = 9.81,
) -> Calibration:
    """Fit a body's physics to recordings.

    Minimises the mean squared distance of particles from their recorded positions, over the
    logarithms of factors, from factors of 1. The first steps of the descent use the first actions
    only, and the second half uses all actions: late motion depends on early motion in such a
    complex way that a descent on all of it from the start gets stuck. Masses stay fixed, since a
    motion determines forces only in proportion to masses.

    Args:
        body: the initial guess.
        recordings: one or more recordings, with equal numbers of actions and of pickers.
        action_seconds: duration of each of their actions, seconds.
        config: settings.
        kinds: kind of each spring, counted from 0, shape (S,): springs of one kind share one
            factor on their stiffness. By default springs of equal stiffness are of one kind, or
            all springs if there are more than `MOST_KINDS` stiffnesses, as in a mesh.
        gravity: downward acceleration, metres per second squared.

    Raises:
        ValueError: if recordings do not fit the body or each other, hold a value that is not
            finite and at most `FARTHEST`, or show no motion; if a parameter to fit is zero; or if
            `kinds` has not one number for each spring.
    """
    config = config or CalibrationConfig()
    _require_seconds("action_seconds", action_seconds)
    _check_fitted(body, config)
    stacked, kinds = _stack(body, recordings), _check_kinds(body, kinds)
    least_stable = _scaled_body(body, _extremes(config), kinds)
    time_step, steps = _time_step(least_stable, action_seconds, config.longest_time_step)
    simulation = make_simulation(body, time_step, gravity)
    table, count = _kind_table(body, kinds), int(kinds.max(initial=0)) + 1
    logs, losses = _descend(config, steps, simulation, table, stacked, num_kinds=count)
    factors = {name: np.asarray(np.exp(np.asarray(logs[name], float))) for name in logs}
    return Calibration(_scaled_body(body, factors, kinds), factors, np.sqrt(np.asarray(losses)))


def simulate_recordings(
    body: Body,
    recordings: Sequence[Recording],
    action_seconds: float,
    *,
    gravity: float = 9.81,
    longest_time_step: float = LONGEST_TIME_STEP,
) -> Float[np.ndarray, "R T N 3"]:
    """Positions of a body after each action of recordings, shape (R, T, N, 3), metres.

    Args:
        body: the body, with its physics.
        recordings: as for `calibrate`.
        action_seconds: duration of each of their actions, seconds.
        gravity: downward acceleration, metres per second squared.
        longest_time_step: longest time step, seconds; shorter where stability requires it.

    Raises:
        ValueError: as `calibrate` does for recordings.
    """
    _require_seconds("action_seconds", action_seconds)
    _require_seconds("longest_time_step", longest_time_step)
    stacked = _stack(body, recordings)
    time_step, steps = _time_step(body, action_seconds, longest_time_step)
    return np.asarray(_replays(steps, make_simulation(body, time_step, gravity), stacked))


def recording_error(
    body: Body, recordings: Sequence[Recording], action_seconds: float, **options: float
) -> float:
    """Root-mean-square distance, metres, of particles in replays from their recorded positions.

    See `simulate_recordings` for arguments, options and errors.
    """
    found = simulate_recordings(body, recordings, action_seconds, **options)
    wanted = np.stack([np.asarray(recording.positions) for recording in recordings])
    return float(np.sqrt(np.mean(np.sum((found - wanted) ** 2, axis=-1))))


@partial(
    jax.jit,
    static_argnums=(0, 1),
    static_argnames="num_kinds",
    # With less optimisation gradients compile three times as fast, and run almost as fast.
    compiler_options={"xla_backend_optimization_level": 1},
)
def _descend(
    config: CalibrationConfig,
    steps: int,
    simulation: Simulation,
    table: Int[Array, "D HN"],
    recordings: Recording,
    num_kinds: int,
) -> tuple[Factors, Float[Array, " I"]]:
    """The best logarithms of factors, and mean squared distances, square metres."""
    import optax

    loss_fn = partial(_misfit, steps, simulation, table, recordings)
    optimizer = optax.adam(optax.cosine_decay_schedule(config.learning_rate, config.steps))
    low, high = log(config.smallest_factor), log(config.largest_factor)

    def step(
        carry: tuple[Any, ...], horizon: Float[Array, ""]
    ) -> tuple[tuple[Any, ...], Float[Array, ""]]:
        logs, state, best, least = carry
        (_, loss), gradient = jax.value_and_grad(loss_fn, has_aux=True)(logs, horizon)
        better = loss < least  # False if it is not finite
        best, least = _choose(better, logs, best), jnp.where(better, loss, least)
        finite = jnp.isfinite(loss) & _all_finite(gradient)
        gradient = _choose(finite, gradient, jax.tree.map(jnp.zeros_like, gradient))
        updates, state = optimizer.update(gradient, state)
        # Where the gradient is not finite the descent continues from the best factors.
        logs = optax.apply_updates(_choose(finite, logs, best), updates)
        logs = jax.tree.map(lambda leaf: jnp.clip(leaf, low, high), logs)
        return (logs, state, best, least), loss

    logs = {name: jnp.zeros(num_kinds if name == "stiffness" else ()) for name in config.parameters}
    first = (logs, optimizer.init(logs), logs, jnp.asarray(jnp.inf))
    num_actions = recordings.positions.shape[1]
    # The horizon grows from one action to all actions in the first half of the descent.
    horizons = jnp.clip(jnp.linspace(1.0, 2.0 * num_actions, config.steps), 1.0, num_actions)
    (logs, _, best, least), losses = jax.lax.scan(step, first, horizons)
    last = loss_fn(logs, horizons[-1])[1]
    unit = _motion(recordings)
    return _choose(last < least, logs, best), jnp.append(losses, last) * unit


def _misfit(
    steps: int,
    simulation: Simulation,
    table: Int[Array, "D HN"],
    recordings: Recording,
    logs: Factors,
    horizon: Float[Array, ""],
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Mean squared distance of replays, up to a horizon (a number of actions), and of all actions.

    Relative to `_motion`, so that Adam's epsilon is small in comparison.
    """
    scaled = _scaled(simulation, table, jax.tree.map(jnp.exp, logs))
    missed = _replays(steps, scaled, recordings) - recordings.positions
    by_action = jnp.mean(jnp.sum(missed**2, axis=-1), axis=(0, 2)) / _motion(recordings)
    weights = jnp.clip(horizon - jnp.arange(len(by_action)), 0.0, 1.0)
    return jnp.vdot(weights, by_action) / weights.sum(), by_action.mean()


def _motion(recordings: Recording) -> Float[Array, ""]:
    """Mean squared distance of particles from their starting positions, square metres."""
    moved = recordings.positions - recordings.start.position[:, None]
    return jnp.mean(jnp.sum(moved**2, axis=-1))


def _replays(steps: int, simulation: Simulation, recordings: Recording) -> Float[Array, "R T N 3"]:
    """Positions after each action, of all recordings."""
    # Recorded actions have no limit.
    pickers: Pickers = make_pickers((1e3, 1e3, 1e3), max_stretch=1e6, steps=steps)

    def one(recording: Recording) -> Float[Array, "T N 3"]:
        return rollout(simulation, pickers, recording.start, recording.actions)[1]

    return jax.lax.map(one, recordings)


def _scaled(simulation: Simulation, table: Int[Array, "D HN"], factors: Factors) -> Simulation:
    springs, changes = simulation.springs, dict(factors)
    if "stiffness" in changes:
        factor = changes.pop("stiffness")[table]
        springs = replace(springs, stiffness=springs.stiffness * factor)
    if "damping" in changes:
        springs = replace(springs, damping=springs.damping * changes.pop("damping"))
    own: dict[str, Any] = {name: getattr(simulation, name) * changes[name] for name in changes}
    return replace(simulation, springs=springs, **own)


def _scaled_body(body: Body, factors: dict[str, np.ndarray], kinds: Int[np.ndarray, " S"]) -> Body:
    others = {name: float(factors[name]) for name in factors if name != "stiffness"}
    stiffness = np.broadcast_to(factors.get("stiffness", 1.0), kinds.max(initial=0) + 1)
    return body.scaled(stiffness=stiffness[kinds], **others)


def _kind_table(body: Body, kinds: Int[np.ndarray, " S"]) -> Int[Array, "D HN"]:
    """Kinds in the rows of the stored springs; 0 where there is no spring."""
    table = make_springs(replace(body, stiffness=kinds + 1.0)).stiffness
    return jnp.maximum(table.astype(int) - 1, 0)


def _extremes(config: CalibrationConfig) -> dict[str, np.ndarray]:
    """The largest factors: the least stable physics that the descent may reach."""
    return {name: np.asarray(config.largest_factor) for name in config.parameters}


def _time_step(body: Body, action_seconds: float, longest: float) -> tuple[float, int]:
    """A stable time step, seconds, and the number of time steps per action."""
    steps = ceil(action_seconds / min(longest, 0.9 * largest_time_step(body)))
    return action_seconds / steps, steps


def _stack(body: Body, recordings: Sequence[Recording]) -> Recording:
    """Recordings stacked along a first axis, if they fit the body and each other."""
    if not isinstance(recordings, Sequence) or not recordings:
        raise ValueError(f"recordings is {told(recordings)}; give a list of at least one Recording")
    shape: tuple[int | str, ...] = ("T", "G")
    checked = []
    for index, recording in enumerate(recordings):
        checked.append(_checked(index, recording, body.num_particles, shape))
        shape = checked[0].actions.pick.shape
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *checked)
    if not np.any(np.asarray(stacked.positions != stacked.start.position[:, None])):
        raise ValueError("no particle moves in any recording; give a recording with motion")
    return stacked


def _checked(index: int, recording: object, count: int, shape: tuple[int | str, ...]) -> Recording:
    """A recording as arrays, with actions and pickers of a shape; its number for messages."""
    if not isinstance(recording, Recording) or not isinstance(recording.start, State):
        raise ValueError(
            f"recording {index} is {told(recording)}; give Recording(State(position, velocity), "
            f"Actions(pick, displacement), positions)"
        )
    why = f"for {count} particles and as many actions and pickers in every recording"

    def reals(name: str, values: object, wanted: tuple[int | str, ...]) -> Array:
        array = require_reals(f"{name} of recording {index}", values, wanted, why)
        if not np.all(np.isfinite(array)):
            raise ValueError(
                f"recording {index} has a value that is not finite, in {name}; leave such moments "
                f"out"
            )
        require_numbers(f"{name} of recording {index}", array, -FARTHEST, FARTHEST)
        return jnp.asarray(array, dtype=float)

    pick = require_whole(f"actions.pick of recording {index}", recording.actions.pick)
    require_shape(f"actions.pick of recording {index}", pick, shape, why)
    start = State(
        reals("start.position", recording.start.position, (count, 3)),
        reals("start.velocity", recording.start.velocity, (count, 3)),
        reals("start.missed", recording.start.missed, ()),
    )
    displacement = reals("actions.displacement", recording.actions.displacement, (*pick.shape, 3))
    positions = reals("positions", recording.positions, (len(pick), count, 3))
    try:
        actions = require_actions(Actions(jnp.asarray(pick), displacement), count)
    except ValueError as error:
        raise ValueError(f"recording {index}: {error}") from error
    return Recording(start, actions, positions)


def _check_kinds(body: Body, kinds: Int[np.ndarray, " S"] | None) -> Int[np.ndarray, " S"]:
    if kinds is None:
        values, kinds = np.unique(body.stiffness, return_inverse=True)
        return kinds if len(values) <= MOST_KINDS else np.zeros_like(kinds)
    count = len(body.stiffness)
    kinds = require_ids("kinds", kinds, count, "springs")
    require_shape("kinds", kinds, (count,), f"a whole number from 0 for each of {count} springs")
    return kinds


def _require_seconds(name: str, seconds: float) -> None:
    require_number(name, seconds, *SECONDS[name], "s")


def _check_fitted(body: Body, config: CalibrationConfig) -> None:
    values = vars(body.material) | {"stiffness": body.stiffness, "damping": body.damping}
    zero = [name for name in config.parameters if not np.any(values[name])]
    if zero:
        raise ValueError(
            f"{zero[0]} of the body is 0, and stays 0 times any factor; start from a number "
            f"above zero, or leave it out of `parameters`"
        )


def _choose(condition: Array, first: PyTree[Any], second: PyTree[Any]) -> PyTree[Any]:
    return jax.tree.map(partial(jnp.where, condition), first, second)


def _all_finite(tree: PyTree[Any]) -> Array:
    return jnp.all(jnp.asarray([jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(tree)]))
