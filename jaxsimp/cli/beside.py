"""What is compiled on another core meanwhile: at first use, numba takes half a minute on one."""

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

COMPILE = (
    "from jaxsimp.dynamics.contact.cpu.compiled import has_kernel; has_kernel('touch', 'float32')"
)


@contextmanager
def contact_compiled_beside() -> Iterator[None]:
    """A context in which another process compiles self-contact, unless that is kept or of no use.

    It ends when the other process has, so that what was compiled is loaded afterwards.
    """
    if not _is_to_compile():
        yield
        return
    environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-c", COMPILE]
    # In a session of its own, where Ctrl-C does not reach it: it is ended here.
    other = subprocess.Popen(command, env=environment, start_new_session=True)
    try:
        yield
        other.wait()
    finally:
        other.kill()
        other.wait()


def _is_to_compile() -> bool:
    """Whether there is a core for it, and a folder that lacks it, and it is used at all."""
    import jax

    from jaxsimp.compiling import is_missing
    from jaxsimp.machine import num_cores

    if num_cores() == 1 or jax.default_backend() != "cpu":
        return False
    try:
        from jaxsimp.dynamics.contact.cpu.kernels import _touch_float32
    except Exception:  # of a numba or jaxlib that is made otherwise: told where it is used
        return False
    return is_missing(_touch_float32)
