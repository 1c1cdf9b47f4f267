"""MuJoCo: bodies as its flexible bodies, and plans carried out in it."""

from jaxsimp.engines.mujoco.execution import Replay, ReplayStatus, replay
from jaxsimp.engines.mujoco.model import VARIANTS, Variant, make_model, save_mjcf

__all__ = ["VARIANTS", "Replay", "ReplayStatus", "Variant", "make_model", "replay", "save_mjcf"]
