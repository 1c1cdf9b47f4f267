"""What a GPU computes, beside a CPU: `JAXSIMP_GPU=1 pytest -m gpu` on a machine with one."""

import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsimp import goals
from jaxsimp.bodies import cloth
from jaxsimp.dynamics import Actions, at_rest, make_pickers, make_simulation, rollout
from jaxsimp.engines import default_layout

ROOT = Path(__file__).parents[1]


def gpus() -> list[jax.Device]:
    try:
        return jax.devices("gpu")
    except RuntimeError:  # JAX has none, or may not look
        return []


pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not gpus(), reason="needs a GPU, and JAXSIMP_GPU=1"),
]


def on(device: jax.Device, self_contact: bool) -> tuple[np.ndarray, np.ndarray]:
    """Ends of rollouts of a fold on a device, and the slopes of their heights."""
    body = cloth((11, 11))
    simulation = make_simulation(body, 1e-3, self_contact=self_contact)
    pickers = make_pickers((0.2, 0.2, 0.2), steps=100)
    fold = np.array([[[0.1, 0, 0.1]] * 2, [[0.1, 0, -0.08]] * 2])
    moves = jnp.asarray(np.stack([share * fold for share in (1.0, 0.95, 0.9, 0.85)]))
    picks = jnp.asarray([[0, 10]] * 2)

    def end(move):
        plan = Actions(picks, move)
        return rollout(simulation, pickers, at_rest(goals.flat(body)), plan)[0].position

    with jax.default_device(device):
        ends = jax.jit(jax.vmap(end))(moves)
        slopes = jax.jit(jax.vmap(jax.grad(lambda move: end(move)[:, 2].sum())))(moves)
        return np.asarray(ends), np.asarray(slopes)


@pytest.mark.parametrize("self_contact", [False, True])
def test_rollouts_and_gradients_repeat_bit_for_bit_and_are_those_of_a_cpu(self_contact):
    (gpu,), (cpu, *_) = gpus()[:1], jax.devices("cpu")
    first, again, there = on(gpu, self_contact), on(gpu, self_contact), on(cpu, self_contact)
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one, other)
    # Rounding of float32 over 200 steps: layers that land a step sooner lie elsewhere by 0.1 mm.
    np.testing.assert_allclose(first[0], there[0], atol=2e-4)


def test_the_layout_is_one_batch_on_each_gpu():
    layout = default_layout(128, 8)
    assert layout.chunk_size * layout.num_workers >= 128
    assert layout.num_workers == len(gpus())


@pytest.mark.parametrize(
    "command", [("experiments.run", "paper", "--smoke"), ("jaxsimp", "simplify", "--help")]
)
def test_commands_run_as_they_stand(command, tmp_path):
    out = ["--out", str(tmp_path / "results")] if "--help" not in command else []
    subprocess.run([sys.executable, "-m", *command, *out], cwd=ROOT, check=True)
