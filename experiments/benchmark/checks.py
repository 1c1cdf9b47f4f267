"""Checks that an engine computes the right motion, before it is timed."""

from functools import cache

import jax
import numpy as np

from experiments.benchmark.measure import Prepared, Row, prepare
from experiments.benchmark.peers import ENGINES, edge_list
from experiments.benchmark.peers.workload import Workload, make_body, make_workload

TOLERANCE = 1e-5
"""Largest error of a position after 100 steps, metres.

Particles move by 2 cm or more in these steps. Rounding of float32 gives an error of 1e-6 in a cloth
and in a rope; a stiffness wrong by one per cent gives 3e-4 or more.
"""
ORACLE = "edge list, float64"
"""Reference engine of the check; the reference of the edge list itself is jaxsimp."""


def check(engine: str, kind: str, side: int) -> Row:
    """The columns "checked_against" and "error", metres, of an engine on a body.

    Raises:
        UnavailableError: if the engine cannot run here.
    """
    by_itself = engine == "edge_list_vmap"
    expected = _positions("jaxsimp", kind, side) if by_itself else _oracle(kind, side)
    error = float(np.abs(_positions(engine, kind, side) - expected).max())
    return {
        "checked_against": "jaxsimp" if by_itself else ORACLE,
        "error": error if np.isfinite(error) else None,
    }


def passes(checked: Row) -> bool:
    """Whether the error is small enough for the engine to be timed."""
    return checked["error"] is not None and checked["error"] <= TOLERANCE


def compile_seconds(engine: str, kind: str, side: int) -> float:
    """Seconds to prepare an engine for its check: Warp compiles then, and never again."""
    return _prepared(engine, kind, side).compile_seconds


@cache
def _prepared(engine: str, kind: str, side: int) -> Prepared:
    return prepare(lambda: ENGINES[engine][2](_workload(kind, side)))


def _positions(engine: str, kind: str, side: int) -> np.ndarray:
    return _prepared(engine, kind, side).result


@cache
def _oracle(kind: str, side: int) -> np.ndarray:
    with jax.enable_x64(True):
        return edge_list.prepare(_workload(kind, side))()


def _workload(kind: str, side: int) -> Workload:
    """A workload of few samples and steps, before rounding grows."""
    body = make_body(kind, side)
    return make_workload(body, population=6, num_actions=2, action_steps=50, seed=1)
