"""Tasks as environments of Gymnasium, single and in batches. Needs `gymnasium`, the extra `env`.

Classes around `Env`: they hold its state, and a generator that draws the key of each episode.
"""

from collections.abc import Mapping, Sequence
from functools import cached_property, partial
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from gymnasium.utils.seeding import np_random
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from jaxtyping import Array, Bool, UInt

from jaxsimp.checks import require_choice, require_count, require_reals, require_whole
from jaxsimp.engines import PopulationMap, default_layout, spring_chunk_size
from jaxsimp.envs.env import Env, EnvAction, EnvState, Observation, Transition, make_env
from jaxsimp.planning import Candidates
from jaxsimp.tasks import make_task, task_names
from jaxsimp.viz import COLORS, GOAL_COLOR, draw_body, draw_obstacle

NAMESPACE, VERSION = "jaxsimp", 1
MOST_ENVS = 100_000
"""Most environments of a batch."""
RENDER_MODES = ["rgb_array"]
MARGIN = 0.1
"""Width of the picture around start and goal, metres."""
Dict = dict[str, np.ndarray]
Step = tuple[Dict, float, bool, bool, dict[str, float]]
Steps = tuple[Dict, np.ndarray, np.ndarray, np.ndarray, Dict]


def env_id(task_name: str) -> str:
    """The id of a task: "jaxsimp/ClothDiagonalFolding-v1" for "cloth_diagonal_folding"."""
    words = task_name.split("_")
    return f"{NAMESPACE}/{''.join(word[:1].upper() + word[1:] for word in words)}-v{VERSION}"


def register_envs() -> None:
    """Make all registered tasks known to `gymnasium.make` and `gymnasium.make_vec`.

    The import of `jaxsimp.envs` does so; call it for tasks that are registered later.
    """
    for name in task_names():
        if env_id(name) not in gymnasium.registry:
            gymnasium.register(
                id=env_id(name),
                entry_point="jaxsimp.envs.gym:TaskEnv",
                vector_entry_point="jaxsimp.envs.gym:TaskVectorEnv",
                kwargs={"task_name": name},
            )


def _spaces(env: Env) -> tuple[spaces.Space[Any], spaces.Space[Any]]:
    """Spaces of the actions and the observations."""
    task = env.task
    shape, num_choices = (task.body.num_particles, 3), len(env.space.candidates) + 1
    vectors = partial(spaces.Box, -np.inf, np.inf, dtype=np.float32)
    return (
        spaces.Dict(
            {
                "choice": spaces.MultiDiscrete(np.full(task.num_pickers, num_choices)),
                "direction": spaces.Box(-1.0, 1.0, (task.num_pickers, 3), np.float32),
            }
        ),
        spaces.Dict(
            {
                "position": vectors(shape=shape),
                "velocity": vectors(shape=shape),
                "goal": vectors(shape=shape),
                "time_left": spaces.Box(0.0, 1.0, (), np.float32),
            }
        ),
    )


def _seen(observation: Observation) -> Dict:
    """An observation as a member of the space."""
    return {name: np.asarray(leaf, np.float32) for name, leaf in vars(observation).items()}


def _action(env: Env, action: Any, batch: tuple[int, ...] = ()) -> EnvAction:
    """An action from what a policy gives, with leading axes `batch`; directions are clipped.

    Raises:
        ValueError: if it is no mapping of `choice` and `direction`, of other shapes, a choice is
            no index, or a direction is not finite.
    """
    if not isinstance(action, Mapping) or set(action) != {"choice", "direction"}:
        raise ValueError(
            f"the action is {action!r:.60}; give a dict of choice and direction, as "
            f"action_space.sample()"
        )
    shape, most = (*batch, env.task.num_pickers), len(env.space.candidates)
    choice = require_whole("choice", action["choice"])
    if choice.shape != shape or not ((choice >= 0) & (choice <= most)).all():
        raise ValueError(
            f"choice is {choice.tolist()!r:.60}; give indices of shape {shape}, from 0 to "
            f"{most - 1} for a candidate, {most} for none"
        )
    why = "x, y, z in units of the limits for each picker"
    direction = require_reals("direction", action["direction"], (*shape, 3), why)
    if not np.isfinite(direction).all():
        raise ValueError("direction is not finite; give numbers from -1 to 1")
    return EnvAction(jnp.asarray(choice, int), jnp.asarray(direction, float))


def _drawn_key(generator: np.random.Generator) -> jax.Array:
    return jax.random.key(int(generator.integers(2**32)))


def _made(
    task_name: str,
    resolution: int | None,
    candidates: Candidates | Sequence[int] | None,
    self_contact: bool,
) -> Env:
    own = np.asarray(candidates) if isinstance(candidates, Sequence) else candidates
    return make_env(make_task(task_name, resolution), own, self_contact=self_contact)


class TaskEnv(gymnasium.Env[Dict, Dict]):
    """A registered task as an environment of Gymnasium; see `jaxsimp.envs.Env`.

    An observation is a dict of `Observation`, an action one of `EnvAction`. `terminated` is true
    after the last action; `truncated` never.

    Attributes:
        env: the environment as pure functions.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 # Gymnasium's base has it alike
        "render_modes": RENDER_MODES,
        "render_fps": 4,
    }

    def __init__(
        self,
        task_name: str,
        resolution: int | None = None,
        candidates: Candidates | Sequence[int] | None = None,
        *,
        self_contact: bool = False,
        render_mode: str | None = None,
    ) -> None:
        """Make the environment; its functions are compiled at the first step.

        Args:
            task_name: name of a task, see `jaxsimp.tasks.task_names`.
            resolution: see `jaxsimp.tasks.make_task`.
            candidates: see `make_env`.
            self_contact: see `make_env`.
            render_mode: "rgb_array" for `render`; None for no pictures.

        Raises:
            ValueError: if `make_task` or `make_env` raises, or there is no such mode.
        """
        if render_mode is not None:
            require_choice("render_mode", render_mode, RENDER_MODES)
        self.render_mode = render_mode
        self.env = _made(task_name, resolution, candidates, self_contact)
        self.action_space, self.observation_space = _spaces(self.env)
        self._start, self._step = jax.jit(self.env.reset), jax.jit(self.env.step)
        self._state: EnvState | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Dict, dict[str, float]]:
        """Start a random episode; there are no options."""
        super().reset(seed=seed)
        self._state = self._start(_drawn_key(self.np_random))
        return _seen(self.env.observe(self._state)), {"score": float(self._state.score)}

    def step(self, action: Any) -> Step:
        """Carry out an action.

        Raises:
            ValueError: if the action is none of the space, save for directions beyond -1 and 1,
                which are clipped; or there was no `reset`.
        """
        found: Transition = self._step(_current(self._state), _action(self.env, action))
        self._state = found.state
        info = {name: float(value) for name, value in found.info.items()}
        return _seen(found.observation), float(found.reward), bool(found.done), False, info

    def render(self) -> np.ndarray | None:
        """A picture of body, goal and obstacles, shape (400, 400, 3), uint8; needs `render_mode`.

        Raises:
            ValueError: if there was no `reset`.
        """
        if self.render_mode is None:
            return None
        return _picture(self.env, _current(self._state))


class TaskVectorEnv(VectorEnv[Dict, Dict, np.ndarray]):
    """Many environments of a registered task, side by side on all cores, or in one `jax.vmap`.

    Environment `i` of the seed `s` has the episodes of a `TaskEnv` with the seed `s + i`. The step
    after an episode's last one starts the next episode, whatever the action ("next step").

    Attributes:
        env: one environment as pure functions.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 # Gymnasium's base has it alike
        "render_modes": [],
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        num_envs: int,
        task_name: str,
        resolution: int | None = None,
        candidates: Candidates | Sequence[int] | None = None,
        *,
        self_contact: bool = False,
    ) -> None:
        """Make the environments; see `TaskEnv`.

        Raises:
            ValueError: as `TaskEnv`, or if `num_envs` is out of its range.
        """
        self.num_envs = require_count("num_envs", num_envs, 1, MOST_ENVS)
        self.env = _made(task_name, resolution, candidates, self_contact)
        self.single_action_space, self.single_observation_space = _spaces(self.env)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._layout = default_layout(num_envs, spring_chunk_size(self.env.simulation))
        self._generators: list[np.random.Generator] = []
        self._state: EnvState | None = None
        self._done = np.zeros(num_envs, bool)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Dict, Dict]:
        """Start a random episode in each environment; there are no options."""
        super().reset(seed=seed)
        if seed is not None or not self._generators:
            _, first = np_random(seed)
            self._generators = [np_random(first + index)[0] for index in range(self.num_envs)]
        found = self._started()
        self._state, self._done = found.state, np.zeros(self.num_envs, bool)
        return _seen(found.observation), {"score": np.asarray(found.info["score"])}

    def step(self, actions: Any) -> Steps:
        """Carry out an action in each environment, or start its next episode.

        Raises:
            ValueError: if an action is refused, see `TaskEnv.step`, or there was no `reset`.
        """
        state, action = _current(self._state), _action(self.env, actions, (self.num_envs,))
        was_done = self._done
        found = self._started() if was_done.any() else None
        if found is None or not was_done.all():  # episodes are of one length unless one fails
            stepped = self._step(self.env, (state, action))
            found = stepped if found is None else _select(was_done, found, stepped)
        self._state, self._done = found.state, np.asarray(found.done)
        info = {name: np.asarray(value) for name, value in found.info.items()}
        truncated = np.zeros(self.num_envs, bool)
        return _seen(found.observation), np.asarray(found.reward), self._done, truncated, info

    def _started(self) -> Transition:
        """The first state of a random episode in each environment."""
        keys = np.stack([jax.random.key_data(_drawn_key(each)) for each in self._generators])
        return self._start(self.env, keys)

    @cached_property
    def _start(self) -> PopulationMap:
        keys = np.stack([jax.random.key_data(jax.random.key(0))] * self.num_envs)
        return PopulationMap(_start_one, self.env, keys, self._layout)

    @cached_property
    def _step(self) -> PopulationMap:
        idle = np.zeros((self.num_envs, self.env.task.num_pickers), int)
        action = EnvAction(jnp.asarray(idle), jnp.zeros((*idle.shape, 3)))
        return PopulationMap(_step_one, self.env, (self._state, action), self._layout)


def _start_one(env: Env, key: UInt[Array, " W"]) -> Transition:
    state = env.reset(jax.random.wrap_key_data(key))
    nothing = jnp.zeros_like(state.score)
    info = {"score": state.score, "missed": nothing}
    return Transition(state, env.observe(state), nothing, jnp.zeros((), bool), info)


def _step_one(env: Env, given: tuple[EnvState, EnvAction]) -> Transition:
    return env.step(*given)


def _current(state: EnvState | None) -> EnvState:
    if state is None:
        raise ValueError("there is no episode yet; call reset first")
    return state


def _select(
    chosen: Bool[np.ndarray, " B"], transition: Transition, other: Transition
) -> Transition:
    """A transition where chosen, and another one elsewhere, along their first axis."""

    def select(leaf: np.ndarray, others: np.ndarray) -> np.ndarray:
        return np.where(chosen.reshape(-1, *[1] * (leaf.ndim - 1)), leaf, others)

    return jax.tree.map(select, transition, other)


def _picture(env: Env, state: EnvState) -> np.ndarray:
    """The body over its goal, with the obstacles; the frame is the same in a whole episode."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    start, goal = np.asarray(state.episode.start), np.asarray(state.episode.goal)
    ends = np.concatenate([start, goal])
    low, high = ends.min(axis=0) - MARGIN, ends.max(axis=0) + MARGIN
    canvas = FigureCanvasAgg(Figure((4, 4), dpi=100))
    axes: Any = canvas.figure.add_axes((0, 0, 1, 1), projection="3d", computed_zorder=False)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(0.0, high[2]))
    axes.set_box_aspect((*(high - low)[:2], high[2]), zoom=1.3)
    axes.view_init(elev=50, azim=-65)
    axes.set_axis_off()
    for obstacle in env.task.obstacles:
        draw_obstacle(axes, obstacle)
    draw_body(axes, env.task.body, goal, GOAL_COLOR)
    draw_body(axes, env.task.body, np.asarray(env.observe(state).position), COLORS[0])
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
