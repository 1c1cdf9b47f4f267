"""Ropes: chains of segments through key points, and their fits in a workspace."""

from jaxsimp.simplification.ropes.fit import (
    Limits,
    Workspace,
    feasible,
    fit_free,
    fit_within,
    limits_of,
)
from jaxsimp.simplification.ropes.optimal import simplify_optimal
from jaxsimp.simplification.ropes.uniform import (
    fit_rope,
    interpolation_matrix,
    simplify_uniform,
    uniform_breakpoints,
)

__all__ = [
    "Limits",
    "Workspace",
    "feasible",
    "fit_free",
    "fit_rope",
    "fit_within",
    "interpolation_matrix",
    "limits_of",
    "simplify_optimal",
    "simplify_uniform",
    "uniform_breakpoints",
]
