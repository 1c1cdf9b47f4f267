"""A cache of what JAX compiles, for console commands: JAX's own, with what that lacks.

JAX writes its files in place: what a kill or a full disk cuts short stays, and costs a warning and
a compilation in every process. Nor does it tell processors apart. Here a file is whole or absent,
and carries a hash of its content; each kind of processor, JAX and Python has a folder of its own;
and a cache that fails costs time alone. A program that was loaded computes the same bits as the one
that was compiled. Operations that numba compiles (dynamics/contact/cpu) stand in it by name: XLA
looks up their addresses in each process.

JAX has no public interface to do this by. If a name used here is missing in a later JAX, nothing is
kept, and all else works.
"""

import logging
import os
import tempfile
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
from platform import python_version

LARGEST = 2**30
"""Size from which on the oldest files are removed, bytes; those of a study are some ten MB."""
HASH_SIZE = sha256().digest_size
SUFFIX = ".program"

_log = logging.getLogger("jaxsimp")


class Kept:
    """Compiled programs in a folder, as JAX reads and writes them.

    Attributes:
        folder: where they are; it exists.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._told = False

    def get(self, key: str) -> bytes | None:
        """A program; None if there is none, or its file is damaged."""
        path = self._path_of(key)
        try:
            data = path.read_bytes()
            os.utime(path)  # the least recently used ones are removed first
        except OSError:
            return None
        found = data[HASH_SIZE:]
        return found if sha256(found).digest() == data[:HASH_SIZE] else None

    def put(self, key: str, value: bytes) -> None:
        """Keep a program, if that is possible."""
        try:
            with tempfile.NamedTemporaryFile(dir=self.folder, delete=False) as file:
                try:
                    file.write(sha256(value).digest() + value)
                    file.close()
                    os.replace(file.name, self._path_of(key))
                except OSError:
                    os.unlink(file.name)
                    raise
        except OSError as error:
            self._tell(error)

    def _path_of(self, key: str) -> Path:
        return self.folder / f"{sha256(key.encode()).hexdigest()}{SUFFIX}"

    def _tell(self, error: OSError) -> None:
        if not self._told:
            self._told = True
            _not_kept(error)


def keep_programs() -> None:
    """Keep what JAX compiles in this process, and use what was kept.

    The folder is `jaxsimp/programs` in `XDG_CACHE_HOME`, or in `~/.cache`. This does nothing if the
    user has `JAX_ENABLE_COMPILATION_CACHE=false`, or a `JAX_COMPILATION_CACHE_DIR`. It changes the
    global configuration of JAX, so it is for commands alone.
    """
    import jax

    names = ("jax_compilation_cache_dir", "jax_enable_compilation_cache")
    own, enabled = (getattr(jax.config, name) for name in names)
    if own or not enabled:
        return
    try:
        from jax._src import compilation_cache
    except ImportError:
        return
    if not hasattr(compilation_cache, "get_file_cache"):
        return
    try:
        folder = _folder()
    except OSError as error:
        _not_kept(error)
        return
    kept = Kept(folder)
    # JAX has no setting for another cache of files, and its own does not write them in one piece.
    # Types are ignored: `Kept` has the methods that are called, and not the base class.
    compilation_cache.get_file_cache = lambda path: (kept, path)  # type: ignore[assignment, return-value]
    jax.config.update("jax_compilation_cache_dir", str(folder))
    # Most programs compile in less than the second from which on JAX keeps them.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def _folder() -> Path:
    """The folder for this kind of processor, JAX and Python; it is the user's own.

    Raises:
        OSError: if there is none, and it cannot be made; or it is of another user, who could put
            any program there.
    """
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    if not os.path.isabs(home):  # of a user without a home
        raise OSError(f"{home} is no absolute path")
    root = Path(home) / "jaxsimp" / "programs"
    folder = root / sha256(_kind().encode()).hexdigest()[:16]
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if hasattr(os, "getuid") and folder.stat().st_uid != os.getuid():
        raise PermissionError(f"{folder} is of another user")
    _remove_oldest(root)
    return folder


def _kind() -> str:
    """What programs depend on besides what JAX makes part of their keys."""
    import jaxlib.version
    from llvmlite import binding

    processor = binding.get_host_cpu_name(), binding.get_host_cpu_features().flatten()
    return repr((processor, jaxlib.version.__version__, python_version()))


def _remove_oldest(root: Path) -> None:
    """Remove the least recently used files beyond `LARGEST`, and what a kill left of others."""
    files = []
    for path in root.rglob("*"):
        with suppress(OSError):  # of what another process removes
            found = path.stat()
            if path.is_file():
                files.append((found.st_mtime, found.st_size, path))
    total = 0
    for _, size, path in sorted(files, reverse=True):
        total += size
        if total > LARGEST:
            with suppress(OSError):
                path.unlink()


def _not_kept(error: OSError) -> None:
    _log.warning(
        f"jaxsimp: compiled programs are not kept, and the next command compiles them again: "
        f"{error}"
    )
