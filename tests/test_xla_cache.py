"""The cache of compiled programs: whole files or none, and the same bits as without it."""

import json
import logging
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from llvmlite import binding

from jaxsimp import xla_cache
from jaxsimp.xla_cache import Kept, keep_programs

ROOT = Path(__file__).parents[1]
# A rope that touches itself, so that kernels of numba are called.
ROLLOUT = """
import json, sys
import jax, numpy as np
from jaxsimp.xla_cache import keep_programs
keep_programs()
counts = {}
def count(name, **_):
    counts[name] = counts.get(name, 0) + 1
jax.monitoring.register_event_listener(count)
from jaxsimp.bodies import rope
from jaxsimp.dynamics import Actions, at_rest, make_pickers, make_simulation, rollout
body = rope(7, 0.2)
simulation, pickers = make_simulation(body, 1e-3, self_contact=True), make_pickers(steps=40)
moves = [[[0.08, 0, 0.05]], [[0.08, 0, -0.05]], [[-0.08, 0, 0]]]
actions = Actions(np.array([[0], [0], [6]]), np.array(moves))
final, _ = jax.jit(rollout)(simulation, pickers, at_rest(body.rest + [0, 0, 0.01]), actions)
hits = counts.get("/jax/compilation_cache/cache_hits", 0)
misses = counts.get("/jax/compilation_cache/cache_misses", 0)
print(json.dumps([hits, misses, np.asarray(final.position).tobytes().hex()]))
"""
OURS = ("JAX_COMPILATION_CACHE_DIR", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS")


def rolled_out(home: Path, **settings: str) -> tuple[int, int, str]:
    """Programs loaded and compiled in a process of its own, and the bits of its result."""
    environment = {name: value for name, value in os.environ.items() if name not in OURS}
    environment |= {"PYTHONPATH": str(ROOT), "XDG_CACHE_HOME": str(home)} | settings
    done = subprocess.run(
        [sys.executable, "-c", ROLLOUT],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stderr == ""
    return tuple(json.loads(done.stdout))


def files(folder: Path) -> list[Path]:
    return [path for path in folder.rglob("*") if path.is_file()]


def test_another_process_loads_what_was_compiled_and_computes_the_same_bits(tmp_path):
    hits, misses, bits = rolled_out(tmp_path)
    kept = files(tmp_path)
    assert misses == len(kept) > hits
    assert {path.suffix for path in kept} == {".program"}
    # One is damaged, as by a disk: it is compiled again, and nothing else is.
    largest = max(kept, key=lambda path: path.stat().st_size)
    largest.write_bytes(largest.read_bytes()[:-1])
    assert rolled_out(tmp_path) == (hits + misses - 1, 1, bits)
    off = rolled_out(tmp_path / "off", JAX_ENABLE_COMPILATION_CACHE="false")
    assert off == (0, 0, bits)
    assert not (tmp_path / "off").exists()


def test_a_folder_of_the_users_is_left_alone(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))  # JAX's is set in conftest.py
    keep_programs()
    assert not list(tmp_path.iterdir())


# --- files ----------------------------------------------------------------------------------------


def test_a_program_is_found_by_its_key(tmp_path):
    kept = Kept(tmp_path)
    kept.put("jit_f-1", b"one")
    kept.put("jit_f-2", b"")
    assert [kept.get(f"jit_f-{number}") for number in (1, 2, 3)] == [b"one", b"", None]
    assert Kept(tmp_path).get("jit_f-1") == b"one"


@pytest.mark.parametrize("size", [0, 10, 32, 34])
def test_what_is_cut_short_or_changed_is_none_and_is_replaced(tmp_path, size):
    kept = Kept(tmp_path)
    kept.put("key", b"program")
    (path,) = files(tmp_path)
    whole = path.read_bytes()
    for damaged in (whole[:size], whole[:size] + b"x" + whole[size + 1 :]):
        path.write_bytes(damaged)
        assert kept.get("key") is None
        kept.put("key", b"program")
        assert kept.get("key") == b"program"


def test_a_folder_that_cannot_be_written_is_told_once_and_leaves_nothing(
    tmp_path, caplog, monkeypatch
):
    def full(*_):
        raise OSError(28, "No space left on device")

    kept = Kept(tmp_path)
    monkeypatch.setattr(xla_cache.os, "replace", full)
    for key in ("one", "two"):
        kept.put(key, b"program")
        assert kept.get(key) is None
    assert not files(tmp_path)
    assert [record.levelno for record in caplog.records] == [logging.WARNING]
    assert "not kept, and the next command compiles them again: " in caplog.text
    assert "No space left" in caplog.text


def test_writers_and_readers_of_one_file_see_whole_ones(tmp_path):
    kept, value = Kept(tmp_path), os.urandom(300_000)

    def write_and_read(_):
        kept.put("key", value)
        return kept.get("key") == value

    with ThreadPoolExecutor(8) as pool:
        assert all(pool.map(write_and_read, range(100)))
    assert len(files(tmp_path)) == 1


def test_the_least_recently_used_files_are_removed(tmp_path, monkeypatch):
    kept = Kept(tmp_path)
    for age, key in enumerate("abcd"):
        kept.put(key, bytes(100))
        os.utime(kept._path_of(key), (1000 - age, 1000 - age))
    kept.get("d")  # the oldest is used
    monkeypatch.setattr(xla_cache, "LARGEST", 3 * 132)
    xla_cache._remove_oldest(tmp_path)
    assert [key for key in "abcd" if kept.get(key)] == ["a", "b", "d"]


# --- folders --------------------------------------------------------------------------------------


def test_another_processor_jax_or_python_has_another_folder(tmp_path, monkeypatch):
    import jaxlib.version

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    found = [xla_cache._folder(), xla_cache._folder()]
    assert found[0] == found[1]
    assert found[0].is_relative_to(tmp_path / "jaxsimp" / "programs")
    for owner, name, value in (
        (binding, "get_host_cpu_name", lambda: "z80"),
        (jaxlib.version, "__version__", "99.0"),
        (xla_cache, "python_version", lambda: "4.0.0"),
    ):
        monkeypatch.setattr(owner, name, value)
        found.append(xla_cache._folder())
    assert len(set(found)) == 4


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="files have no owner")
def test_a_folder_of_another_user_is_not_trusted(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(os, "getuid", lambda: 12345678)
    with pytest.raises(PermissionError, match="is of another user"):
        xla_cache._folder()


def test_without_a_home_nothing_is_kept(monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    with pytest.raises(OSError, match="no absolute path"):
        xla_cache._folder()
