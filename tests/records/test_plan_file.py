"""Plan files: whole or not there, and refused by name where they are no plans."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxsimp.dynamics import Actions
from jaxsimp.records import load_plan, save_plan


def some_plan() -> tuple[Actions, np.ndarray]:
    actions = Actions(jnp.zeros((2, 2), dtype=int), jnp.zeros((2, 2, 3)))
    return actions, np.zeros((4, 9, 3), np.float32)


def test_a_save_that_fails_leaves_the_old_plan(tmp_path, monkeypatch):
    path = tmp_path / "plan.npz"
    save_plan(path, *some_plan())
    before = path.read_bytes()

    def full(file, **arrays):
        file.write(b"half of a pl")
        raise OSError("no space left on device")

    monkeypatch.setattr(np, "savez_compressed", full)
    for name in ("plan.npz", "new.npz"):
        with pytest.raises(OSError, match="no space"):
            save_plan(tmp_path / name, *some_plan())
    assert path.read_bytes() == before
    assert not (tmp_path / "new.npz").exists()


def broken_files() -> dict[str, bytes]:
    import io

    other, single = io.BytesIO(), io.BytesIO()
    np.savez(other, pick=np.zeros((1, 2), int))
    np.save(single, np.zeros(3))
    return {
        "garbage": b"not a plan at all",
        "nothing": b"",
        "another archive": other.getvalue(),
        "one array": single.getvalue(),
    }


@pytest.mark.parametrize("content", broken_files().values(), ids=broken_files())
def test_a_file_that_is_no_plan_is_refused_by_name(tmp_path, content):
    path = tmp_path / "plan.npz"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"plan\.npz .*not a saved plan"):
        load_plan(path)


@pytest.mark.parametrize("share", [0.3, 0.9])
def test_a_plan_cut_short_is_refused_by_name(tmp_path, share):
    path = tmp_path / "plan.npz"
    save_plan(path, *some_plan())
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(ValueError, match=r"plan\.npz .*not a saved plan"):
        load_plan(path)


def test_a_plan_that_is_not_there(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"plan\.npz"):
        load_plan(tmp_path / "plan.npz")
