"""MuJoCo: models of bodies as its flexible bodies, and execution of plans."""

from jaxsimp.engines.mujoco.execution import MuJoCo, replay
from jaxsimp.engines.mujoco.model import VARIANTS, Variant, make_model, save_mjcf

__all__ = ["VARIANTS", "MuJoCo", "Variant", "make_model", "replay", "save_mjcf"]
