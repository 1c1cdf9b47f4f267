"""Figures of the physics page: made at a small size, and what they claim holds there."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from experiments import physics
from jaxsimp.body import rope
from jaxsimp.dynamics import State


@pytest.mark.slow
def test_all_figures_are_made_and_their_numbers_said(tmp_path, capsys):
    options = physics.Options(out=tmp_path / "new", quick=True)
    assert physics.main(options) == 0
    for name in physics.FIGURES:
        assert (tmp_path / "new" / f"physics_{name}.png").stat().st_size > 5000
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in lines] == list(physics.FIGURES)


def test_an_unknown_figure_is_refused(tmp_path, capsys):
    assert physics.main(physics.Options(out=tmp_path / "none", only=("speed",))) == 2
    assert "choose from time_step, resolution, energy" in capsys.readouterr().out
    assert not (tmp_path / "none").exists()


def test_the_order_of_a_power_law():
    steps = np.array([0.1, 0.2, 0.4])
    assert physics.order(steps, 3.0 * steps**1.7) == pytest.approx(1.7)


def test_errors_are_of_first_order_in_the_time_step():
    steps, errors = physics.time_step_errors(rope(5), 0.1, (1, 2, 4, 8))
    np.testing.assert_allclose(steps[0] / steps, [1, 2, 4, 8])
    # What is second order is a tenth at the longest step, and halves with each.
    assert physics.order(steps[-3:], errors[-3:]) == pytest.approx(1.0, abs=0.05)


def test_a_hanging_cloth_stretches_by_its_weight_at_any_resolution():
    shapes = {n: physics.hanging(n) for n in (5, 9, 17)}
    sags = np.array([shape[-1, n // 2, 2] - shape[0, n // 2, 2] for n, shape in shapes.items()])
    # By a third at most: half the weight, 0.098 N, over springs of 1.5 N/m and more.
    assert ((sags > 0.305) & (sags < 0.4)).all()
    # First order in the spacing: from 1/4 to 1/8 twice as far as from 1/8 to 1/16, to a tenth
    # or so of what is second order.
    assert (sags[0] - sags[1]) / (sags[1] - sags[2]) == pytest.approx(2.0, abs=0.4)


def test_energy_in_closed_form():
    body = replace(rope(2, 0.1, mass=0.02), stiffness=np.array([50.0]))
    position = np.array([[[0.0, 0.0, 1.0], [0.0, 0.3, 2.0]]])
    velocity = np.array([[[1.0, 2.0, 2.0], [0.0, 0.0, 0.0]]])
    length = np.hypot(0.3, 1.0)
    wanted = 0.01 * 9 / 2 + 50 * (length - 0.1) ** 2 / 2 + 0.01 * 9.81 * 3.0
    found = physics.energy(body, State(jnp.asarray(position), jnp.asarray(velocity)))
    np.testing.assert_allclose(found, wanted, rtol=1e-6)  # positions are float32


@pytest.mark.parametrize("resolution", [5, 9])
def test_a_fold_lies_on_itself(resolution):
    shape = physics.folded(resolution)
    # The carried side came to the other one's, to a spacing or so, and nothing is under the table.
    assert np.abs(shape[0, :, 0] - shape[-1, :, 0]).max() < 0.3 / (resolution - 1)
    assert shape[..., 2].min() > 0.0019
