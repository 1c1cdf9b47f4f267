"""Functions compiled by numba, as operations of XLA on the CPU.

XLA calls them through its foreign function interface (C header `xla/ffi/api/c_api.h`, installed
with jaxlib), without Python and without its lock, so that samples run on all cores. The classes
below mirror the structures of that header that are read here, field by field.
"""

import ctypes
from collections.abc import Callable
from typing import Any, no_type_check  # numba needs functions as they are, not wrapped in checks

import jax
import numpy as np
from numba import carray, njit, types  # type: ignore[attr-defined] # set when numba is imported
from numba.extending import intrinsic

from jaxsimp.compiling import callback, compiler

MAJOR, MINOR = 0, 3
"""Version of the interface that the classes below mirror: what handlers answer to XLA, which
refuses handlers of a version that it does not support."""
METADATA = 1
"""Type of the extension by which XLA asks for the version."""


class ExtensionBase(ctypes.Structure):
    """XLA_FFI_Extension_Base."""

    _fields_ = (("struct_size", ctypes.c_size_t), ("type", ctypes.c_int), ("next", ctypes.c_void_p))


class ApiVersion(ctypes.Structure):
    """XLA_FFI_Api_Version."""

    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension_start", ctypes.c_void_p),
        ("major_version", ctypes.c_int),
        ("minor_version", ctypes.c_int),
    )


class Metadata(ctypes.Structure):
    """XLA_FFI_Metadata, up to the last field that handlers without state fill."""

    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("api_version", ApiVersion),
        ("traits", ctypes.c_uint32),
    )


class MetadataExtension(ctypes.Structure):
    """XLA_FFI_Metadata_Extension."""

    _fields_ = (("extension_base", ExtensionBase), ("metadata", ctypes.c_void_p))


class Buffer(ctypes.Structure):
    """XLA_FFI_Buffer."""

    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension_start", ctypes.c_void_p),
        ("dtype", ctypes.c_int),
        ("data", ctypes.c_void_p),
        ("rank", ctypes.c_int64),
        ("dims", ctypes.c_void_p),
    )


class Args(ctypes.Structure):
    """XLA_FFI_Args."""

    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension_start", ctypes.c_void_p),
        ("size", ctypes.c_int64),
        ("types", ctypes.c_void_p),
        ("args", ctypes.c_void_p),
    )


class Rets(ctypes.Structure):
    """XLA_FFI_Rets."""

    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension_start", ctypes.c_void_p),
        ("size", ctypes.c_int64),
        ("types", ctypes.c_void_p),
        ("rets", ctypes.c_void_p),
    )


class CallFrame(ctypes.Structure):
    """XLA_FFI_CallFrame, up to the last field that is read here."""

    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension_start", ctypes.c_void_p),
        ("api", ctypes.c_void_p),
        ("ctx", ctypes.c_void_p),
        ("stage", ctypes.c_int),
        ("args", Args),
        ("rets", Rets),
    )


WORD = 8
"""Bytes of a pointer and of an `int64_t`: the unit in which structures are read."""


def _place(structure: type[ctypes.Structure], name: str) -> int:
    """Place of a field, in words."""
    return int(getattr(structure, name).offset) // WORD


FRAME_SIZE = ctypes.sizeof(CallFrame)
FRAME_EXTENSION = _place(CallFrame, "extension_start")
FRAME_OPERANDS = _place(CallFrame, "args") + _place(Args, "args")
FRAME_RESULTS = _place(CallFrame, "rets") + _place(Rets, "rets")
BUFFER_WORDS = ctypes.sizeof(Buffer) // WORD
BUFFER_DATA, BUFFER_RANK, BUFFER_DIMS = (_place(Buffer, name) for name in ("data", "rank", "dims"))
EXTENSION_TYPE = _place(ExtensionBase, "type")
EXTENSION_METADATA = _place(MetadataExtension, "metadata")
METADATA_VERSION = _place(Metadata, "api_version") + _place(ApiVersion, "major_version")
METADATA_TRAITS = _place(Metadata, "traits")
OK = 0
"""Result of a handler: no error."""

WHAT = "self-contact"
compiled = compiler(WHAT)


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
    return _words(_words(buffer, BUFFER_WORDS)[BUFFER_DIMS], axis + 1)[axis]


@njit(inline="always")
@no_type_check
def _data(buffer):
    return _pointer(_words(buffer, BUFFER_WORDS)[BUFFER_DATA])


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
def tensor(buffer, dtype):
    """A buffer of three axes."""
    shape = (_size(buffer, 0), _size(buffer, 1), _size(buffer, 2))
    return carray(_data(buffer), shape, dtype)


@compiled
@no_type_check
def pass_on(operand, result, item_words):
    """Copy an operand to a result, unless XLA has them share memory; items in words of 4 bytes."""
    source, target = _words(operand, BUFFER_WORDS), _words(result, BUFFER_WORDS)
    if source[BUFFER_DATA] == target[BUFFER_DATA]:
        return
    size = item_words
    for axis in range(source[BUFFER_RANK]):
        size *= _size(operand, axis)
    old = carray(_pointer(source[BUFFER_DATA]), (size,), np.int32)
    new = carray(_pointer(target[BUFFER_DATA]), (size,), np.int32)
    for word in range(size):
        new[word] = old[word]


@compiled
@no_type_check
def is_call(frame):
    """Whether XLA calls a handler. If it asks for the handler's version instead, answer."""
    words = _words(frame, FRAME_SIZE // WORD)
    extension = words[FRAME_EXTENSION]
    if extension == 0 or _low(_words(extension, EXTENSION_TYPE + 1)[EXTENSION_TYPE]) != METADATA:
        return True
    address = _words(extension, EXTENSION_METADATA + 1)[EXTENSION_METADATA]
    metadata = _words(address, METADATA_TRAITS + 1)
    metadata[METADATA_VERSION] = np.int64(MINOR) << np.int64(32) | np.int64(MAJOR)
    metadata[METADATA_TRAITS] = metadata[METADATA_TRAITS] & ~LOW  # none
    return False


LOW = np.int64(0xFFFFFFFF)
"""The half of a word that is an `int` beside another field, on a little-endian machine."""


@njit(inline="always")
@no_type_check
def _low(word):
    return word & LOW


@njit(inline="always")
@no_type_check
def operands(frame, count):
    """Addresses of the buffers of a call's operands."""
    return _words(_words(frame, FRAME_SIZE // WORD)[FRAME_OPERANDS], count)


@njit(inline="always")
@no_type_check
def results(frame, count):
    """Addresses of the buffers of a call's results."""
    return _words(_words(frame, FRAME_SIZE // WORD)[FRAME_RESULTS], count)


def register(name: str, handler: Callable[[Any], int]) -> None:
    """Compile a handler, or load it as it was compiled before, and make it known to XLA.

    Args:
        name: for `jax.ffi.ffi_call`.
        handler: function of a module, of the address of a call's frame; see `is_call`,
            `operands` and `results`. Returns `OK`.

    Raises:
        Exception: if XLA does not support the version of the interface, of a type that XLA chooses.
    """
    if name in _registered:
        return
    function = callback(WHAT, types.int64(types.int64), handler)
    capsule = ctypes.PYFUNCTYPE(ctypes.py_object, *[ctypes.c_void_p] * 3)(
        ("PyCapsule_New", ctypes.pythonapi)
    )
    jax.ffi.register_ffi_target(name, capsule(function.address, None, None), platform="cpu")
    _registered[name] = function


_registered: dict[str, Any] = {}
"""Functions that XLA may call, by name: they must not be collected."""
