"""Functions that numba compiles, as operations of XLA on the CPU.

They are called by XLA's foreign function interface (its C header `xla/ffi/api/c_api.h`), without
Python and without its lock, so that samples run on all cores. Of that interface only what is read
here matters: where the buffers of operands and results are, and how large.
"""

import ctypes
from collections.abc import Callable
from typing import (
    Any,
    no_type_check,
)  # numba needs the functions as they are, not wrapped in checks

import jax
import numpy as np
from numba import carray, cfunc, njit, types  # type: ignore[attr-defined]
from numba.extending import intrinsic

# Offsets into the structures of the interface, in words of 8 bytes.
FRAME_WORDS, EXTENSIONS, API, OPERANDS, RESULTS = 15, 1, 2, 9, 14
BUFFER_WORDS, DATA, RANK, DIMENSIONS = 6, 3, 4, 5
IS_METADATA, METADATA, VERSION, TRAITS = 1, 3, 3, 4
API_VERSION = 4


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


@njit(inline="always")
@no_type_check
def cube(buffer, dtype):
    """A buffer of three axes."""
    shape = (_size(buffer, 0), _size(buffer, 1), _size(buffer, 2))
    return carray(_data(buffer), shape, dtype)


@njit
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


@njit
@no_type_check
def _described(frame):
    """Whether XLA asked what this function is, and was told."""
    extension = frame[EXTENSIONS]
    if extension == 0 or (_words(extension, 2)[1] & 0xFFFFFFFF) != IS_METADATA:
        return False
    metadata = _words(_words(extension, METADATA + 1)[METADATA], TRAITS + 1)
    metadata[VERSION] = _words(frame[API], API_VERSION + 1)[API_VERSION]
    metadata[TRAITS] = metadata[TRAITS] & ~np.int64(0xFFFFFFFF)
    return True


def register(name: str, kernel: Callable[..., Any], num_operands: int, num_results: int) -> None:
    """Make a kernel known to XLA.

    Args:
        name: for `jax.ffi.ffi_call`.
        kernel: compiled by numba; takes the addresses of the operands' buffers and of the
            results', two arrays of integers, see `vector` and the like.
        num_operands: of the call.
        num_results: of the call.
    """

    @cfunc(types.int64(types.voidptr))
    @no_type_check
    def handler(frame):
        words = carray(frame, (FRAME_WORDS,), np.int64)
        if not _described(words):
            kernel(_words(words[OPERANDS], num_operands), _words(words[RESULTS], num_results))
        return 0  # No error.

    capsule = ctypes.PYFUNCTYPE(ctypes.py_object, *[ctypes.c_void_p] * 3)(
        ("PyCapsule_New", ctypes.pythonapi)
    )
    _kept.append(handler)
    jax.ffi.register_ffi_target(name, capsule(handler.address, None, None), platform="cpu")


_kept: list[Any] = []
"""What XLA calls must not be collected."""
