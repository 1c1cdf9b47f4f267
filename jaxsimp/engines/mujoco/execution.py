"""Execution of plans in MuJoCo: the same limits, stretch rule and speed profile as in ours.

`jaxsimp.dynamics.pickers.grasp` decides the motion of the pickers, from MuJoCo's positions at the
start of each action; the held particle is joined to a mocap body, which moves along the
displacement. Plans run side by side on all cores, each in its own `mujoco.MjData`: the result of a
plan does not depend on the others.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxsimp.checks import require_count
from jaxsimp.dynamics import NONE, Actions, Pickers, Simulation, make_pickers
from jaxsimp.dynamics.pickers import grasp, require_actions, speed_profile
from jaxsimp.engines.engine import Execution, ExecutionStatus, Executor
from jaxsimp.engines.mujoco.model import Variant, as_variant, make_model
from jaxsimp.engines.population import MOST_WORKERS
from jaxsimp.engines.trajectory import (
    FRAMES_PER_SECOND,
    Trajectory,
    held_particles,
    stride_of,
)
from jaxsimp.machine import num_cores
from jaxsimp.tasks import Episode, Task, score
from jaxsimp.tasks.episode import require_episode

LEAD = 4
"""Lead of the mocap body, in time steps. A mocap body has no velocity, so the constraint brakes the
held particle. With the constraint of model.py (critically damped, a time constant of two steps) the
particle is exactly on its path if the mocap body is four steps ahead of it."""
FASTEST = 100.0
"""Speed along an axis, metres per second, that no picker, spring or fall gives a particle."""
STILL, STILL_SECONDS = 5e-3, 0.1
"""A body has settled when no particle was faster than this along an axis, metres per second, for
this many seconds. A folded cloth then creeps by about 0.4 mm in the rest of the task's time."""


@dataclass(frozen=True)
class MuJoCo:
    """MuJoCo as an engine: it evaluates plans; a planner cannot search in it.

    Attributes:
        variant: variant of the model, see `jaxsimp.engines.mujoco.model`.
    """

    variant: str | Variant = "full"

    def executor(self, task: Task) -> Executor:
        """See `Engine.executor`; it compiles a model for each plan, with the plan's particles.

        Raises:
            ValueError: if the variant is unknown.
        """
        variant = as_variant(self.variant)

        def execute(episode: Episode, actions: Actions) -> Execution:
            (found,) = replay(task, [episode], [actions], variant)
            return found

        return execute

    def trajectory(
        self,
        task: Task,
        episode: Episode,
        actions: Actions,
        frames_per_second: float = FRAMES_PER_SECOND,
    ) -> Trajectory:
        """See `Recorder.trajectory`; it ends when the body is at rest.

        Raises:
            ValueError: as `Recorder.trajectory`, or if the variant is unknown.
        """
        episode = require_episode(episode, task.body.num_particles)
        actions = require_actions(actions, task.body.num_particles)
        model = _model_of(task, [actions], self.variant)
        stride = stride_of(_action_steps(task, model), task.action_seconds, frames_per_second)
        start = np.asarray(episode.start, dtype=float)
        scene = _Scene(task, task.simulation(), model, start, stride)
        held = [np.zeros((0, actions.pick.shape[1]), dtype=int)]
        for pick, displacement, holds in zip(
            np.asarray(actions.pick),
            np.asarray(actions.displacement),
            held_particles(actions),
            strict=True,
        ):
            before = len(scene.frames)
            scene.act(pick, displacement)
            held.append(np.tile(holds, (len(scene.frames) - before, 1)))
        before = len(scene.frames)
        scene.settle(task.settle_actions)
        held.append(np.full((len(scene.frames) - before, actions.pick.shape[1]), NONE))
        steps, positions = zip((0, start), *scene.frames, strict=True)
        times = model.opt.timestep * np.array(steps)
        return Trajectory(times, np.stack(positions), np.concatenate(held))


def replay(
    task: Task,
    episodes: Sequence[Episode],
    plans: Sequence[Actions],
    variant: str | Variant = "full",
    *,
    num_workers: int | None = None,
) -> Iterator[Execution]:
    """Carry out plans in MuJoCo, let the body settle, and score them.

    Results come one by one, in the order of the plans; work on all plans begins when the caller
    asks for the first result.

    Args:
        task: the task; `replay` uses its body, limits and times.
        episodes: start and goal of each plan.
        plans: plans, of any numbers of actions.
        variant: variant of the model, see `jaxsimp.engines.mujoco.model`.
        num_workers: number of plans at a time, by default the number of cores. Results do not
            depend on it.

    Raises:
        ValueError: if the numbers of episodes and plans differ, one of them is not of the body,
            `num_workers` is no number of workers, or the variant is unknown.
    """
    if len(episodes) != len(plans):
        raise ValueError(
            f"{len(episodes)} episodes are given for {len(plans)} plans; give one for each"
        )
    if num_workers is not None:
        require_count("num_workers", num_workers, 1, MOST_WORKERS)
    episodes = [require_episode(episode, task.body.num_particles) for episode in episodes]
    plans = [require_actions(plan, task.body.num_particles) for plan in plans]
    model = _model_of(task, plans, variant)
    one = partial(_replay_one, task, task.simulation(), model, jax.jit(partial(score, task)))
    return _side_by_side(one, episodes, plans, num_workers or num_cores())


def _model_of(task: Task, plans: Sequence[Actions], variant: str | Variant) -> Any:
    """A model with pickers for all particles that plans grasp."""
    picked = {int(particle) for plan in plans for particle in np.unique(plan.pick)} - {NONE}
    if task.pinch is not None:  # what is between the fingers depends on the motion
        picked = set(range(task.body.num_particles))
    return make_model(task.body, variant, picked, obstacles=task.obstacles)


def _action_steps(task: Task, model: Any) -> int:
    return max(1, round(task.action_seconds / model.opt.timestep))


def _side_by_side(
    one: Executor,
    episodes: Sequence[Episode],
    plans: Sequence[Actions],
    num_workers: int,
) -> Iterator[Execution]:
    with ThreadPoolExecutor(num_workers) as pool:
        yield from pool.map(one, episodes, plans)


def _replay_one(
    task: Task,
    simulation: Simulation,
    model: Any,
    score_fn: Callable[[Episode, Float[Array, "N 3"]], Float[Array, ""]],
    episode: Episode,
    plan: Actions,
) -> Execution:
    """Carry out one plan."""
    scene = _Scene(task, simulation, model, np.asarray(episode.start, dtype=float))
    frames = [scene.positions()]
    for pick, displacement in zip(
        np.asarray(plan.pick), np.asarray(plan.displacement), strict=True
    ):
        scene.act(pick, displacement)
        frames.append(scene.positions())
    scene.settle(task.settle_actions)
    frames.append(scene.positions())
    warnings, unstable = scene.warnings(), scene.unstable
    status = ExecutionStatus.UNSTABLE if unstable else ExecutionStatus(bool(warnings))
    value = float("nan") if unstable else float(score_fn(episode, jnp.asarray(frames[-1])))
    return Execution(np.stack(frames), value, status, warnings)


class _Scene:
    """One simulation and the actions of pickers in it.

    Attributes:
        unstable: whether the simulation became unstable.
        frames: number of steps since the start, and positions, after each `stride` steps of an
            action and at its end; none without a stride.
    """

    def __init__(
        self,
        task: Task,
        simulation: Simulation,
        model: Any,
        start: Float[np.ndarray, "N 3"],
        stride: int | None = None,
    ) -> None:
        import mujoco

        self._task, self._simulation = task, simulation  # of which the pickers' rules count
        self._model, self._data = model, mujoco.MjData(model)
        self._data.qpos[:] = (start - task.body.rest).ravel()
        self._steps, self._stride = _action_steps(task, model), stride
        self._pickers = make_pickers(task.limits, steps=self._steps, pinch=task.pinch)
        speed = np.asarray(speed_profile(self._steps), dtype=float)
        self._ahead = np.cumsum(speed) + (LEAD - 1) * speed
        self.unstable = False
        self.frames: list[tuple[int, np.ndarray]] = []
        self._done = 0

    def positions(self) -> Float[np.ndarray, "N 3"]:
        """Positions of the particles, metres; NaN once the simulation is unstable."""
        rest = self._task.body.rest
        if self.unstable:
            return np.full_like(rest, np.nan)
        return rest + self._data.qpos.reshape(-1, 3)

    def act(self, pick: np.ndarray, displacement: np.ndarray) -> None:
        """Carry out one action."""
        start = self.positions()
        held, moves = _grasp(self._simulation, self._pickers, start, pick, displacement)
        hold = [(self._picker(i), start[i], moves[i]) for i in np.flatnonzero(held).tolist()]
        for (constraint, _), _, _ in hold:
            self._data.eq_active[constraint] = 1
        for share in self._ahead:
            for (_, mocap), place, move in hold:
                self._data.mocap_pos[mocap] = place + share * move
            self._step()
        for (constraint, _), _, _ in hold:
            self._data.eq_active[constraint] = 0

    def settle(self, num_actions: int) -> None:
        """Step with nothing held for `num_actions` actions, or until the body is at rest."""
        enough, still = max(1, round(STILL_SECONDS / self._model.opt.timestep)), 0
        for _ in range(num_actions * self._steps):
            self._step()
            still = still + 1 if np.abs(self._data.qvel).max() < STILL else 0
            if still == enough:
                return

    def warnings(self) -> tuple[str, ...]:
        """Names of MuJoCo's warnings so far."""
        import mujoco

        numbers = self._data.warning.number
        names = [mujoco.mjtWarning(i).name for i in np.flatnonzero(numbers)]
        return tuple(name.removeprefix("mjWARN_").lower() for name in names)

    def _step(self) -> None:
        self._step_physics()
        self._done += 1
        during = self._done % self._steps
        if self._stride and during % self._stride == 0:  # also at the end, where it is 0
            self.frames.append((self._done, self.positions()))

    def _step_physics(self) -> None:
        import mujoco

        if self.unstable:
            return
        mujoco.mj_step(self._model, self._data)
        warned = any(self._data.warning.number[kind] for kind in _unstable_kinds())
        # A solver that does not converge can give speeds that are finite but meaningless.
        self.unstable = warned or not np.abs(self._data.qvel).max() < FASTEST

    def _picker(self, particle: int) -> tuple[int, int]:
        """Constraint and mocap body of a particle."""
        name = f"picker_{particle}"
        return self._model.equality(name).id, int(self._model.body(name).mocapid[0])


def _unstable_kinds() -> tuple[int, ...]:
    """Warnings after which the numbers of a simulation are meaningless."""
    from mujoco import mjtWarning

    kinds = (mjtWarning.mjWARN_BADQPOS, mjtWarning.mjWARN_BADQVEL, mjtWarning.mjWARN_BADQACC)
    return tuple(map(int, kinds))


def _grasp(
    simulation: Simulation,
    pickers: Pickers,
    position: np.ndarray,
    pick: np.ndarray,
    displacement: np.ndarray,
) -> tuple[Bool[np.ndarray, " N"], Float[np.ndarray, "N 3"]]:
    """Held particles of an action, and the displacement of each."""
    action = Actions(jnp.asarray(pick), jnp.asarray(displacement, dtype=float))
    around = simulation.rest, simulation.obstacles, simulation.radius
    held, moves = _jitted_grasp(pickers, *around, jnp.asarray(position, float), action)
    return np.asarray(held), np.asarray(moves, dtype=float)


_jitted_grasp = jax.jit(grasp)
