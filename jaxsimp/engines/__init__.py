"""Engines: what carries out plans. Our springs, ensembles of them, MJX, and MuJoCo."""

from jaxsimp.engines.engine import Engine, Observe
from jaxsimp.engines.ensemble import Ensemble, Spread, make_ensemble
from jaxsimp.engines.springs import MassSprings

__all__ = ["Engine", "Ensemble", "MassSprings", "Observe", "Spread", "make_ensemble"]
