"""Functions that numba compiles, as operations of XLA on the CPU.

They are called by XLA's foreign function interface (its C header `xla/ffi/api/c_api.h`), without
Python and without its lock, so that samples run on all cores. Of that interface only what is read
here matters: where the buffers of operands and results are, and how large.
"""

import ctypes
from collections.abc import Callable
from typing import Any, no_type_check  # numba needs functions as they are, not wrapped in checks

import jax
import numpy as np

# numba has no annotations, and mypy does not see the names that it gathers at import.
from numba import carray, cfunc, njit, types  # type: ignore[attr-defined]
from numba.extending import intrinsic

# Offsets into the structures of the interface, in words of 8 bytes.
FRAME_WORDS, EXTENSIONS, API, OPERANDS, RESULTS = 15, 1, 2, 9, 14
BUFFER_WORDS, DATA, RANK, DIMENSIONS = 6, 3, 4, 5
OK = 0
"""What a handler returns: no error."""
IS_METADATA, METADATA, VERSION, TRAITS = 1, 3, 3, 4
API_VERSION = 4

# What is compiled is kept on disk, and compiled anew when its own file changes, not when a file it
# calls does: after a change here delete the .nbi and .nbc files in `__pycache__`.
compiled = njit(cache=True)


@intrinsic
@no_type_check
def _pointer(context, address):
    """The pointer to an address."""

    def generate(context, builder, signature, arguments):
        return builder.inttoptr(arguments[0], context.get_value_type(types.voidptr))

    return types.voidptr(types.int64), generate


@njit(inline="always")
@no_type_check
def _words(address, count):
    return carray(_pointer(address), (count,), np.int64)


@njit(inline="always")
@no_type_check
def _size(buffer, axis):
    return _words(_words(buffer, BUFFER_WORDS)[DIMENSIONS], axis + 1)[axis]


@njit(inline="always")
@no_type_check
def _data(buffer):
    return _pointer(_words(buffer, BUFFER_WORDS)[DATA])


@njit(inline="always")
@no_type_check
def scalar(buffer, dtype):
    """A buffer of no axes, as an array of one."""
    return carray(_data(buffer), (1,), dtype)


@njit(inline="always")
@no_type_check
def vector(buffer, dtype):
    """A buffer of one axis."""
    return carray(_data(buffer), (_size(buffer, 0),), dtype)


@njit(inline="always")
@no_type_check
def matrix(buffer, dtype):
    """A buffer of two axes."""
    return carray(_data(buffer), (_size(buffer, 0), _size(buffer, 1)), dtype)


@compiled
@no_type_check
def pass_on(operand, result, item_words):
    """Copy an operand to a result, unless XLA has them share memory; items in words of 4 bytes."""
    source, target = _words(operand, BUFFER_WORDS), _words(result, BUFFER_WORDS)
    if source[DATA] == target[DATA]:
        return
    size = item_words
    for axis in range(source[RANK]):
        size *= _size(operand, axis)
    old = carray(_pointer(source[DATA]), (size,), np.int32)
    new = carray(_pointer(target[DATA]), (size,), np.int32)
    for word in range(size):
        new[word] = old[word]


@compiled
@no_type_check
def is_call(frame):
    """Whether XLA calls a handler; or else it asked what the handler is, and was told."""
    words = _words(frame, FRAME_WORDS)
    extension = words[EXTENSIONS]
    if extension == 0 or (_words(extension, 2)[1] & 0xFFFFFFFF) != IS_METADATA:
        return True
    metadata = _words(_words(extension, METADATA + 1)[METADATA], TRAITS + 1)
    metadata[VERSION] = _words(words[API], API_VERSION + 1)[API_VERSION]
    metadata[TRAITS] = metadata[TRAITS] & ~np.int64(0xFFFFFFFF)
    return False


@njit(inline="always")
@no_type_check
def operands(frame, count):
    """Addresses of the buffers of a call's operands."""
    return _words(_words(frame, FRAME_WORDS)[OPERANDS], count)


@njit(inline="always")
@no_type_check
def results(frame, count):
    """Addresses of the buffers of a call's results."""
    return _words(_words(frame, FRAME_WORDS)[RESULTS], count)


def register(name: str, handler: Callable[[Any], int]) -> None:
    """Compile a handler, or load it as it was compiled before, and make it known to XLA.

    Args:
        name: for `jax.ffi.ffi_call`.
        handler: function of a module, of the address of a call's frame; see `is_call`,
            `operands` and `results`. Returns `OK`.
    """
    function = cfunc(types.int64(types.int64), cache=True)(handler)
    capsule = ctypes.PYFUNCTYPE(ctypes.py_object, *[ctypes.c_void_p] * 3)(
        ("PyCapsule_New", ctypes.pythonapi)
    )
    _kept.append(function)
    jax.ffi.register_ffi_target(name, capsule(function.address, None, None), platform="cpu")


_kept: list[Any] = []
"""What XLA calls must not be collected."""
