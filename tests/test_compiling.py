"""Functions compiled by numba: when they are kept, when compiled anew, and what is said."""

import errno
import os
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType

import numba
import numpy as np
import pytest

from jaxsimp import compiling, numba_cache

ROOT = Path(__file__).parents[1]
OUTER = """
from inner import inner
from numba import types

from jaxsimp.compiling import callback, compiler

compiled = compiler("sums")


@compiled
def outer(number):
    return inner(number) + 1


def handler(number):
    return outer(number)


def make_callback():
    return callback("calls", types.int64(types.int64), handler)
"""
INNER = """
from numba import njit


@njit
def inner(number):
    return {factor} * number
"""


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """Two modules with compiled functions; their cache is in `__pycache__` beside them."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    (tmp_path / "outer.py").write_text(OUTER)
    (tmp_path / "inner.py").write_text(INNER.format(factor=2))
    yield tmp_path
    forget()


def forget() -> None:
    sys.modules.pop("outer", None)
    sys.modules.pop("inner", None)
    numba_cache._told.clear()
    numba_cache._stamp.cache_clear()


def load() -> ModuleType:
    """The outer module, as another process would load it."""
    forget()
    sys.path_importer_cache.clear()
    return import_module("outer")


def kept(folder: Path) -> list[str]:
    return sorted(path.name.partition("-")[0] for path in folder.rglob("*.nbc"))


def test_the_first_call_says_what_it_compiles_and_where_it_is_kept(folder, caplog):
    module = load()
    assert not caplog.messages  # nothing at import
    assert module.outer(3) == 7
    (told,) = caplog.messages
    assert told.startswith("jaxsimp: compiling sums, which takes up to a minute, once: it is kept")
    assert told.endswith(f"in {folder / '__pycache__'}")
    assert module.outer(3.5) == 8  # compiled, too, without another word
    assert len(caplog.messages) == 1
    assert kept(folder) == ["outer.outer", "outer.outer"]


def test_what_was_kept_is_loaded_without_a_word(folder, caplog):
    load().outer(3)
    caplog.clear()
    module = load()
    assert module.outer(3) == 7
    assert not caplog.messages
    assert sum(module.outer.stats.cache_hits.values()) == 1


def test_what_is_missing_is_known_without_compiling_it(folder, caplog):
    module = load()
    function = module.outer.py_func
    assert compiling.is_missing(function)
    assert not caplog.messages
    module.outer(3)
    assert not compiling.is_missing(function)
    (folder / "inner.py").write_text((folder / "inner.py").read_text() + "# changed\n")
    numba_cache._stamp.cache_clear()
    assert compiling.is_missing(function)


def test_a_callback_is_kept_too(folder, caplog):
    found = load().make_callback()
    assert found.ctypes(3) == 7
    assert [text.split(",")[0] for text in caplog.messages] == [
        "jaxsimp: compiling calls",
        "jaxsimp: compiling sums",
    ]
    caplog.clear()
    found = load().make_callback()
    assert (found.ctypes(3), found.cache_hits) == (7, 1)
    assert not caplog.messages


def test_a_change_in_another_file_is_noticed(folder):
    assert load().outer(3) == 7
    # Of another size: Python's own bytecode knows a file by its size and the second of its change.
    (folder / "inner.py").write_text(INNER.format(factor=50))
    assert load().outer(3) == 151
    assert kept(folder) == ["outer.outer"]  # in place of the other


def test_numba_cache_dir_is_where_it_is_kept(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "elsewhere"))
    load().outer(3)
    assert kept(tmp_path / "elsewhere") == ["outer.outer"]
    assert not kept(folder / "__pycache__")


@pytest.fixture
def nowhere(folder, monkeypatch) -> Path:
    """Files where the folders for caches would be: not even root can write there."""
    (folder / "file").write_text("")
    (folder / "__pycache__").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(folder / "file"))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    return folder


def test_where_nothing_can_be_kept_nothing_is_missing(nowhere):
    assert not compiling.is_missing(load().outer.py_func)


def test_without_a_folder_it_is_compiled_each_time_and_the_remedy_is_named(nowhere, caplog):
    for _ in range(2):
        module = load()
        assert (module.outer(3), module.outer(3.5)) == (7, 8)
    remedy = "set NUMBA_CACHE_DIR to a folder that can be written"
    assert caplog.messages == 2 * [
        "jaxsimp: compiling sums, which takes up to a minute, in every process, since no folder to "
        f"keep it in can be written: {remedy}"
    ]


def test_a_user_without_home_and_name_has_no_folder_named_after_a_tilde(tmp_path):
    code = """
import pwd
def nobody(uid): raise KeyError(uid)
pwd.getpwuid = nobody
from numba.core.caching import UserWideCacheLocator as UserWide
from jaxsimp.numba_cache import _Place
print(UserWide in _Place._locator_classes, len(_Place._locator_classes) > 1)
"""
    bare = {name: os.environ[name] for name in os.environ.keys() - {"HOME", "XDG_CACHE_HOME"}}
    for extra, wanted in (({}, "False True\n"), ({"HOME": "/home/x"}, "True True\n")):
        done = subprocess.run(
            [sys.executable, "-c", code],
            env=bare | {"PYTHONPATH": str(ROOT)} | extra,
            cwd=tmp_path,
            capture_output=True,
            text=True,
        )
        assert (done.stdout, done.stderr) == (wanted, "")


@pytest.mark.parametrize(
    "error",
    [OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)), TypeError("cannot pickle 'weakref'")],
    ids=["full disk", "not pickled"],
)
def test_what_cannot_be_kept_costs_time_alone(folder, caplog, monkeypatch, error):
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(numba_cache.IndexDataCacheFile, "save", fail)
    module = load()
    assert (module.outer(3), module.outer(3.5)) == (7, 8)
    _, told = caplog.messages
    assert told == (
        "jaxsimp: compiled code of sums is not kept, and the next process compiles it again: "
        f"{error}"
    )


@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
def test_a_damaged_file_is_compiled_anew_and_replaced(folder, caplog, suffix):
    load().outer(3)
    (path,) = folder.rglob(f"*.{suffix}")
    path.write_bytes(path.read_bytes()[:40])
    assert load().outer(3) == 7
    caplog.clear()
    assert load().outer(3) == 7
    assert not caplog.messages


def test_a_numba_that_is_made_otherwise_is_used_as_it_is(folder, monkeypatch, caplog):
    monkeypatch.setattr(compiling, "Kept", None)
    monkeypatch.delattr(compiling, "make_callback")
    module = load()
    assert module.outer(3) == 7
    assert module.make_callback().ctypes(3) == 7
    assert not kept(folder)


def test_another_cache_of_numba_is_not_relied_on(folder, monkeypatch, caplog):
    def changed(*_: object) -> None:
        raise TypeError("takes 3 arguments")

    monkeypatch.setattr(numba_cache, "IndexDataCacheFile", changed)
    np.testing.assert_equal(load().outer(3), 7)
    assert "in every process, since it cannot be kept (takes 3 arguments)" in caplog.text
