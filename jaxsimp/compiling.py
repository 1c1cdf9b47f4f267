"""Functions compiled by numba: kept on disk where that is possible, and told about.

The first compilation in a process says what it is for, since it takes up to a minute: a warning of
the logger `jaxsimp`, which Python prints on stderr unless an application configures logging. What
was kept is loaded without a word; nothing is said at import.

The folder is what numba chooses: `NUMBA_CACHE_DIR`, else `__pycache__` beside the file, else the
user's folder for caches. Without one, each process compiles.
"""

from collections.abc import Callable
from typing import Any

from numba import cfunc, njit

try:
    from jaxsimp.numba_cache import Kept, NotKept, make_callback
except (ImportError, AttributeError):  # of a numba that is made otherwise: see there
    Kept = None  # type: ignore[assignment, misc] # of a class, to say that there is none


def compiler(what: str, **options: Any) -> Callable[[Any], Any]:
    """A decorator as `numba.njit`, for functions that are kept on disk.

    Args:
        what: what they compute, as users are told.
        options: of `numba.njit`.
    """

    def decorate(function: Any) -> Any:
        return _keep(njit(**options)(function), function, what)

    return decorate


def callback(what: str, signature: Any, function: Any) -> Any:
    """A function as `numba.cfunc` makes it: compiled at once, or loaded as it was kept.

    Args:
        what: what it computes, as users are told.
        signature: types of its result and arguments, as `types.int64(types.int64)`.
        function: function of a module.
    """
    try:
        made = make_callback(function, signature)
    except (NameError, AttributeError, TypeError):  # of a numba that is made otherwise
        return cfunc(signature)(function)
    _keep(made, function, what).compile()
    return made


def is_missing(function: Any) -> bool:
    """Whether a function is to be compiled, and there is a folder that would keep it."""
    try:
        return Kept is not None and not Kept(function, "").has_any()
    except (RuntimeError, AttributeError, TypeError, OSError):  # as in `_keep`
        return False


def _keep(compiled: Any, function: Any, what: str) -> Any:
    """What numba made of a function, with a cache that tells."""
    if Kept is None or not hasattr(compiled, "_cache"):  # absent under NUMBA_DISABLE_JIT, too
        return compiled
    try:
        compiled._cache = Kept(function, what)
    except RuntimeError:  # numba: "no locator available"
        compiled._cache = NotKept(what, "no folder to keep it in can be written")
    except (AttributeError, TypeError, OSError) as error:
        compiled._cache = NotKept(what, f"it cannot be kept ({error})")
    return compiled
