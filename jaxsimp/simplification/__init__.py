"""Simplification: reduce a goal to its key points, the particles that a model of it keeps."""

from jaxsimp.simplification.key_points import FitStatus, KeyPoints
from jaxsimp.simplification.methods import METHODS, simplify, simplify_batch
from jaxsimp.simplification.ropes.fit import Workspace
from jaxsimp.simplification.ropes.optimal import simplify_optimal
from jaxsimp.simplification.ropes.uniform import simplify_uniform
from jaxsimp.simplification.surfaces.meshlab import simplify_meshlab
from jaxsimp.simplification.surfaces.parametric import simplify_parametric
from jaxsimp.simplification.surfaces.quadric import simplify_quadric

__all__ = [
    "METHODS",
    "FitStatus",
    "KeyPoints",
    "Workspace",
    "simplify",
    "simplify_batch",
    "simplify_meshlab",
    "simplify_optimal",
    "simplify_parametric",
    "simplify_quadric",
    "simplify_uniform",
]
