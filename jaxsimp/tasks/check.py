"""Checks of the functions of a new task: JAX can compile them."""

import inspect
from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from jaxsimp.dynamics import NONE, Actions, State, at_rest
from jaxsimp.tasks.episode import DrawFn, Episode, RunningCost, TerminalCost
from jaxsimp.tasks.starts import CrumpledStart


def check_costs(
    running_cost: RunningCost, terminal_cost: TerminalCost, num_particles: int, num_pickers: int
) -> None:
    """Check that JAX can compile the costs, and that each returns a float scalar.

    The check traces the costs with abstract arrays, of a shape and no values; it computes nothing.

    Args:
        running_cost: cost of an episode, a state and an action.
        terminal_cost: cost of an episode and a state.
        num_particles: number of particles of the body, `N`.
        num_pickers: number of pickers, `G`.

    Raises:
        ValueError: if a cost takes other arguments, fails, or does not return one float.
    """
    for name, cost, arguments in (
        ("running_cost", running_cost, ("episode", "state", "action")),
        ("terminal_cost", terminal_cost, ("episode", "state")),
    ):
        check = _check_cost_once if _is_hashable(cost) else _check_cost
        check(name, cost, num_particles, num_pickers, arguments)


def check_draw(draw_fn: DrawFn, num_particles: int) -> None:
    """Check that a function makes an episode of `num_particles` from a key.

    The check traces it, but not `CrumpledStart.draw` of such a body: the trace of a simulation
    takes a while, and that of its kernels their compilation.

    Raises:
        ValueError: if the function fails under a trace, or returns anything else.
    """
    start = getattr(draw_fn, "__self__", None)
    if isinstance(start, CrumpledStart) and (
        start.body.num_particles == len(start.goal) == num_particles
    ):
        return

    def draw() -> list[Array | np.ndarray]:
        found = draw_fn(jax.random.key(0))
        return [found.start, found.goal] if isinstance(found, Episode) else []

    found = _trace("draw_fn", draw, "let it take a key, as made by jax.random.key")
    shapes = [array.shape for array in found]
    if shapes != [(num_particles, 3)] * 2:
        raise ValueError(
            f"draw_fn returns {f'arrays of shapes {shapes}' if shapes else 'no Episode'}; return "
            f"an Episode of start and goal, shape ({num_particles}, 3) each"
        )


def _examples(num_particles: int, num_pickers: int) -> tuple[Episode, State, Actions]:
    positions = jnp.zeros((num_particles, 3))
    action = Actions(jnp.full(num_pickers, NONE), jnp.zeros((num_pickers, 3)))
    return Episode(positions, positions), at_rest(positions), action


def _check_cost(
    name: str,
    cost: Callable[..., Any],
    num_particles: int,
    num_pickers: int,
    arguments: tuple[str, ...],
) -> None:
    """Check one cost; `arguments` names its arguments: the first of the examples."""
    try:
        inspect.signature(cost).bind(*arguments)
    except (TypeError, ValueError) as error:  # no function, or a built-in one
        raise ValueError(
            f"{name} is called as {name}({', '.join(arguments)}), which fails: {error}; give a "
            f"function of {len(arguments)} arguments, {', '.join(arguments)}"
        ) from error
    remedy = "let it take positions of shape (N, 3), and an action of shapes (G,) and (G, 3)"
    examples = partial(_examples, num_particles, num_pickers)
    found = _trace(name, lambda: cost(*examples()[: len(arguments)]), remedy)
    if not isinstance(found, jax.ShapeDtypeStruct):
        raise ValueError(f"{name} returns a {type(found).__name__}; return one float, as a scalar")
    if found.shape != ():
        raise ValueError(
            f"{name} returns an array of shape {found.shape}; return a scalar, such as its mean()"
        )
    if not jnp.issubdtype(found.dtype, jnp.floating):
        raise ValueError(f"{name} returns a scalar of type {found.dtype}; return a float")


_check_cost_once = lru_cache(maxsize=64)(_check_cost)
"""Costs of tasks that differ in other things are traced once; a refusal is not kept."""


def _is_hashable(cost: Callable[..., Any]) -> bool:
    try:
        hash(cost)
    except TypeError:
        return False
    return True


def _trace(name: str, call: Callable[[], Any], remedy: str) -> PyTree[Any]:
    """Shapes and types of a call's result; a failure raises `ValueError` with the remedy.

    So does a side effect that keeps an array.
    """
    returned = []

    def watched() -> Any:
        found = call()
        returned.append(True)
        return found

    try:
        with jax.checking_leaks():
            return jax.eval_shape(watched)
    except (jax.errors.JAXTypeError, jax.errors.JAXIndexError) as error:
        raise ValueError(
            f"{name} asks for the values of arrays, and JAX compiles it before there are any "
            f"({type(error).__name__}); write it with jax.numpy instead of NumPy, and with "
            f"jnp.where instead of if"
        ) from error
    except Exception as error:
        said = (str(error).splitlines() or [""])[0]
        if returned and not isinstance(error, TypeError):  # which is about what it returns
            raise ValueError(
                f"{name} keeps an array of a call, and JAX calls it once, before there are any "
                f"values; return all that counts, and keep nothing"
            ) from error
        raise ValueError(f"{name} fails with {type(error).__name__}: {said}; {remedy}") from error
