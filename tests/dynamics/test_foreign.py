"""The interface by which XLA calls compiled kernels: its header, its version, and refusals."""

import ctypes
import re
from pathlib import Path

import jax
import numpy as np
import pytest

from jaxsimp import goals
from jaxsimp.bodies import cloth
from jaxsimp.dynamics import at_rest, make_simulation, settle
from jaxsimp.dynamics.contact.cpu import compiled, foreign, kernels

HEADER = Path(jax.ffi.include_dir(), "xla", "ffi", "api", "c_api.h").read_text()
# As jaxlib 0.12 names them: the same structures.
HEADER = HEADER.replace("InternalExtension_Type", "Extension_Type")
HEADER = HEADER.replace("XLA_FFI_InternalExtension", "XLA_FFI_Extension_Base")
MIRRORED = {
    foreign.ExtensionBase: "XLA_FFI_Extension_Base",
    foreign.ApiVersion: "XLA_FFI_Api_Version",
    foreign.Metadata: "XLA_FFI_Metadata",
    foreign.MetadataExtension: "XLA_FFI_Metadata_Extension",
    foreign.Buffer: "XLA_FFI_Buffer",
    foreign.Args: "XLA_FFI_Args",
    foreign.Rets: "XLA_FFI_Rets",
    foreign.CallFrame: "XLA_FFI_CallFrame",
}
KINDS = {
    "size_t": ctypes.c_size_t,
    "int64_t": ctypes.c_int64,
    "int": ctypes.c_int,
    "XLA_FFI_Handler_Traits": ctypes.c_uint32,
    **dict.fromkeys(
        ("XLA_FFI_Extension_Type", "XLA_FFI_DataType", "XLA_FFI_ExecutionStage"), ctypes.c_int
    ),
    **{name: mirror for mirror, name in MIRRORED.items()},
}


def fields(name: str) -> list[tuple[str, type]]:
    """Fields of a structure of the header, in their order."""
    (body,) = re.findall(rf"struct {name} {{(.*?)^}}", HEADER, re.MULTILINE | re.DOTALL)
    found = []
    for line in re.sub(r"//[^\n]*", "", body).split(";"):
        words = re.sub(r"\b(const|struct)\b", "", line).split()
        if words:
            kind = " ".join(words[:-1])
            pointer = "*" in line
            found.append((words[-1].lstrip("*"), ctypes.c_void_p if pointer else KINDS.get(kind)))
    return found


@pytest.mark.parametrize("mirror", MIRRORED, ids=MIRRORED.values())
def test_structures_are_those_of_the_header(mirror):
    ours = [(name, kind) for name, kind, *_ in mirror._fields_]
    # Up to the last field that is of use here.
    assert fields(MIRRORED[mirror])[: len(ours)] == ours


def test_the_version_is_one_that_the_header_includes():
    # XLA supports handlers of earlier minor versions; it refuses others itself, see below.
    version = {
        name: int(value) for name, value in re.findall(r"#define XLA_FFI_API_(M\w+) (\d+)", HEADER)
    }
    assert version["MAJOR"] == foreign.MAJOR
    assert version["MINOR"] >= foreign.MINOR
    assert f"XLA_FFI_Extension_Metadata = {foreign.METADATA}," in HEADER


def handler(major: int, minor: int):
    """A handler that answers to be of this version."""

    @ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(foreign.CallFrame))
    def answer(frame):
        at = frame.contents.extension_start
        extension = ctypes.cast(at, ctypes.POINTER(foreign.MetadataExtension)).contents
        assert extension.extension_base.type == foreign.METADATA
        metadata = ctypes.cast(extension.metadata, ctypes.POINTER(foreign.Metadata)).contents
        metadata.api_version.major_version = major
        metadata.api_version.minor_version = minor
        metadata.traits = 0

    return answer


def test_xla_refuses_a_version_that_it_does_not_support():
    jax.devices()
    capsule = ctypes.PYFUNCTYPE(ctypes.py_object, *[ctypes.c_void_p] * 3)(
        ("PyCapsule_New", ctypes.pythonapi)
    )
    for minor, refused in ((foreign.MINOR, False), (foreign.MINOR + 96, True)):
        answer = handler(foreign.MAJOR, minor)
        kept.append(answer)
        address = ctypes.cast(answer, ctypes.c_void_p).value
        register = jax.ffi.register_ffi_target
        arguments = f"of_version_{minor}", capsule(address, None, None)
        if refused:
            with pytest.raises(jax.errors.JaxRuntimeError, match=f"0\\.{minor}"):
                register(*arguments, platform="cpu")
        else:
            register(*arguments, platform="cpu")


kept = []
"""XLA may ask for as long as the process lives."""


@pytest.mark.parametrize(
    "refusal", [jax.errors.JaxRuntimeError, ImportError], ids=["of XLA", "of numba"]
)
def test_without_its_kernel_contact_is_as_defined_with_one_warning(monkeypatch, refusal):
    body = cloth((5, 5), (0.05, 0.05))
    simulation = make_simulation(body, 1e-3, self_contact=True)
    start = at_rest(goals.flat(body))
    wanted = settle(simulation, start, 5).position

    def refuse(name: str, dtype: str) -> None:
        raise refusal(f"version 0.3 of {name} is incompatible")

    def forget() -> None:
        compiled.has_kernel.cache_clear()
        compiled._told.clear()

    monkeypatch.setattr(kernels, "register_kernel", refuse)
    forget()
    with pytest.warns(UserWarning, match=r"without its compiled kernel.*0\.3 of touch is") as told:
        found = settle(simulation, start, 5).position
    assert len(told) == 1
    np.testing.assert_allclose(found, wanted, atol=1e-7)  # float32
    # Silent from now on, for another kernel, too, which a trace asks for: a warning is an error.
    gradient = jax.grad(lambda position: settle(simulation, at_rest(position), 2).position.sum())
    jax.eval_shape(gradient, start.position)
    forget()
