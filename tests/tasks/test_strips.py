"""Folds of a cloth that lies folded already: starts, goals and costs in closed form."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxsimp.dynamics import at_rest
from jaxsimp.planning import num_stages
from jaxsimp.tasks import make_task

REFLECTIVE, UNDERNEATH = "cloth_reflective_folding", "cloth_underneath_folding"
RESOLUTION = 17
LAST, THICKNESS, SIDE = RESOLUTION - 1, 0.004, 0.3


def grid(positions: np.ndarray) -> np.ndarray:
    return np.asarray(positions, float).reshape(RESOLUTION, RESOLUTION, 3)


def costs(name: str) -> tuple[float, float]:
    task = make_task(name, RESOLUTION)
    episode = task.episode_fn(0)
    states = (at_rest(jnp.asarray(each, float)) for each in (episode.start, episode.goal))
    first, last = (float(task.terminal_cost(episode, state)) for state in states)
    return first, last


def test_layers_lie_as_the_names_say():
    start, back, under = (
        grid(
            make_task(name, RESOLUTION).goal
            if part
            else make_task(name, RESOLUTION).episode_fn.start
        )
        for name, part in ((REFLECTIVE, False), (REFLECTIVE, True), (UNDERNEATH, True))
    )
    np.testing.assert_array_equal(grid(make_task(UNDERNEATH, RESOLUTION).episode_fn.start), back)
    for row in range(4):  # of strip a; row 4 is the crease between a and b
        a, b, c, d = row, 8 - row, 8 + row, LAST - row
        # In half: a on d, b on c.
        np.testing.assert_allclose(start[a, :, :2], start[d, :, :2], atol=1e-9)
        np.testing.assert_allclose(start[a, :, 2] - start[d, :, 2], THICKNESS, atol=1e-9)
        # Reflected: a on b on c. (The crease between b and c is half a layer high.)
        if row:
            np.testing.assert_allclose(back[a, :, :2], back[b, :, :2], atol=1e-9)
            assert np.all(back[a, :, 2] > back[b, :, 2])
            assert np.all(back[b, :, 2] > back[LAST - b, :, 2])
            # Turned over: a under b, on the other side.
            np.testing.assert_allclose(under[a, :, :2], under[b, :, :2], atol=1e-9)
            assert np.all(under[a, :, 2] < under[b, :, 2])
            np.testing.assert_allclose(under[a, :, 0], -back[a, :, 0], atol=1e-9)
        np.testing.assert_array_equal(under[d], start[d])
        np.testing.assert_allclose(start[c, :, 2], THICKNESS / 2 if row else THICKNESS, atol=1e-9)


def test_costs_of_start_and_goal_in_closed_form():
    # a and b are mirror images: on average a quarter of the side apart. b lies a layer above c, but
    # for the crease of five rows, which is level.
    first, last = costs(REFLECTIVE)
    assert first == pytest.approx(SIDE / 4 + THICKNESS * 4 / 5, rel=0.01)
    # At the goal a is a layer above b, too; creases of half a layer.
    assert 0 < last < 2.2 * THICKNESS
    # a and b on each other, a layer apart; 1.2 times the way of a: over the crease, twice its
    # distance of 1/8 of the side on average.
    first, last = costs(UNDERNEATH)
    assert first == pytest.approx(1.2 * SIDE / 4 + THICKNESS, rel=0.02)
    assert 0 < last < 1.2 * THICKNESS


@pytest.mark.parametrize("name", [REFLECTIVE, UNDERNEATH])
@pytest.mark.parametrize("resolution", [9, 10, 12, 25])
def test_any_resolution_starts_folded_and_is_planned_in_one_piece(name, resolution):
    task = make_task(name, resolution)
    assert num_stages(task) == 0
    one, other = task.episode_fn(0), task.episode_fn(1)
    assert np.ptp(one.start[:, 2]) > THICKNESS / 2
    assert np.abs(one.start - other.start).max() > 0.01  # turned
    np.testing.assert_allclose(one.start[:, 2], other.start[:, 2], atol=1e-12)
