"""A cache of what numba compiles: numba's own, with what that leaves to be desired.

numba's does not see changes in other files, whose functions are compiled in; it raises where no
folder can be written, or the disk is full, or a file is damaged; and it does not say that it has
nothing. Here all files of a function's folder count, and a cache that fails costs time alone.

Numba has no public interface to do this by. If one of the names used here is missing in a later
numba, compiling.py keeps nothing, and all else works.
"""

import contextlib
import logging
import os
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

from numba.core.caching import (
    CompileResultCacheImpl,
    FunctionCache,
    IndexDataCacheFile,
    NullCache,
    UserWideCacheLocator,
)
from numba.core.ccallback import CFunc

_log = logging.getLogger("jaxsimp")
_told: set[tuple[str, str]] = set()
"""What was said: once is enough for all functions that compute the same."""


def make_callback(function: Any, signature: Any) -> Any:
    """What `numba.cfunc` makes of a function, not compiled yet."""
    return CFunc(function, (signature.args, signature.return_type), {}, {})


class _Place(CompileResultCacheImpl):
    """Where a function is kept: as numba chooses, but nowhere below a home that is not known.

    A user without a home and a name has the home `~`: a folder of that name, wherever one is.
    """

    _locator_classes = [  # noqa: RUF012 # numba reads a list of the class
        each
        for each in CompileResultCacheImpl._locator_classes
        if each is not UserWideCacheLocator
        or os.path.isabs(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~"))
    ]


class Kept(FunctionCache):
    """numba's cache of a function: fresh while no file of its folder changes."""

    _impl_class = _Place

    def __init__(self, function: Any, what: str) -> None:
        """Find the folder.

        Raises:
            RuntimeError: if none can be written.
        """
        super().__init__(function)
        self._what = what
        stamp = _stamp(Path(function.__code__.co_filename).parent)  # numba's is of one file
        self._cache_file = IndexDataCacheFile(self._cache_path, self._impl.filename_base, stamp)

    def has_any(self) -> bool:
        """Whether anything was kept that is fresh."""
        return bool(self._cache_file._load_index())

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """What was kept for these types; None if it has to be compiled, which is said once."""
        try:
            found = super().load_overload(sig, target_context)
        except Exception:  # a damaged file raises whatever pickle and LLVM raise
            with contextlib.suppress(OSError):  # else saving fails, too, and says so
                self.flush()
            found = None
        if found is None:
            _say(
                *("compiles", self._what),
                f"jaxsimp: compiling {self._what}, which takes up to a minute, once: it is kept in "
                f"{self._cache_path}",
            )
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep what was compiled, if that is possible."""
        try:
            super().save_overload(sig, data)
        except Exception as error:  # a full disk; what this numba cannot pickle
            _say(
                *("keeps", self._what),
                f"jaxsimp: compiled code of {self._what} is not kept, and the next process "
                f"compiles it again: {error}",
            )


class NotKept(NullCache):
    """No cache, for a reason."""

    def __init__(self, what: str, reason: str) -> None:
        self._what, self._reason = what, reason

    def load_overload(self, sig: Any, target_context: Any) -> None:
        """Nothing: say once that it is compiled, and how to have it kept."""
        _say(
            *("compiles", self._what),
            f"jaxsimp: compiling {self._what}, which takes up to a minute, in every process, since "
            f"{self._reason}: set NUMBA_CACHE_DIR to a folder that can be written",
        )


@cache
def _stamp(folder: Path) -> str:
    """Hash of all Python files of a folder."""
    return sha256(b"\0".join(each.read_bytes() for each in sorted(folder.glob("*.py")))).hexdigest()


def _say(occasion: str, what: str, text: str) -> None:
    if (occasion, what) not in _told:
        _told.add((occasion, what))
        _log.warning(text)
