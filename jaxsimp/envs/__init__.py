"""Environments of reinforcement learning: tasks as pure functions, and for Gymnasium.

With Gymnasium installed, the extra `env`, importing this room registers every task with it:
`gymnasium.make("jaxsimp.envs:jaxsimp/ClothDiagonalFolding-v1")` does both.
"""

from importlib.util import find_spec

from jaxsimp.envs.env import Env, EnvAction, EnvState, Observation, Transition, make_env

if find_spec("gymnasium"):
    from jaxsimp.envs.gym import register_envs

    register_envs()

__all__ = ["Env", "EnvAction", "EnvState", "Observation", "Transition", "make_env"]
