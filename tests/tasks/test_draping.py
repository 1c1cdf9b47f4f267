"""A towel hung over a bar: its goal in closed form, and a plan by hand that hangs it."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from experiments.scripted import scripted_plan
from jaxsimp.bodies import cloth
from jaxsimp.dynamics import Capsule, Table, least_radius, settle
from jaxsimp.dynamics.simulation import at_rest
from jaxsimp.engines import MassSprings
from jaxsimp.tasks import make_task, score
from jaxsimp.tasks.draping import HEIGHT, hung_over


@pytest.mark.parametrize("self_contact", [False, True])
def test_a_plan_by_hand_hangs_the_towel(self_contact):
    task = make_task("towel_over_bar", quick=True)
    found = MassSprings(self_contact).executor(task)(
        task.episode_fn(0), scripted_plan(task, task.episode_fn(0))
    )
    assert found.score >= 0.9
    # It hangs: round the bar on both sides, and clear of the table.
    bar = task.obstacles[0]
    settled = found.positions[-1]
    assert settled[:, 2].min() > 2 * task.body.radius
    assert settled[:, 2].max() > HEIGHT + 0.9 * bar.radius
    assert settled[:, 0].min() < -bar.radius
    assert settled[:, 0].max() > bar.radius


def test_without_the_bar_the_plan_fails():
    task = make_task("towel_over_bar", quick=True)
    bare = dataclasses.replace(task, obstacles=(Table(),))
    found = MassSprings().executor(bare)(
        task.episode_fn(0), scripted_plan(task, task.episode_fn(0))
    )
    assert found.score < 0.7


@pytest.mark.parametrize("resolution", [5, 13, 25])
def test_the_goal_lies_on_the_bar_and_hangs_straight_down(resolution):
    task = make_task("towel_over_bar", resolution)
    bar, body = task.obstacles[0], task.body
    assert isinstance(bar, Capsule)
    assert bar.radius >= least_radius(body)
    distance = np.asarray(bar.distance(*jnp.asarray(task.goal, dtype=float).T)[0])
    np.testing.assert_allclose(distance[task.goal[:, 2] > HEIGHT], body.radius, atol=1e-6)
    assert distance.min() > body.radius - 1e-6
    assert task.goal[:, 2].min() > body.radius
    # Halves are equal, and rows keep their distance along the towel, on the arc as a chord.
    grid = task.goal.reshape(resolution, resolution, 3)
    np.testing.assert_allclose(grid, grid[::-1] * [-1, 1, 1], atol=1e-12)
    spacing = np.ptp(body.rest[:, 0]) / (resolution - 1)
    apart = np.linalg.norm(np.diff(grid, axis=0), axis=2)
    reach = bar.radius + body.radius
    assert apart.max() <= spacing + 1e-12
    assert apart.min() >= 2 * reach * np.sin(spacing / reach / 2) - 1e-12


def test_a_towel_that_hangs_stays():
    # A stiff one: the goal does not stretch, and then differs from rest by little.
    task = make_task("towel_over_bar", quick=True)
    simulation = task.simulation()
    final = settle(simulation, at_rest(task.goal), 300)
    assert float(score(task, task.episode_fn(0), final)) > 0.95


def test_a_goal_of_a_towel_shorter_than_the_bar_is_round():
    body = cloth((5, 5), (0.1, 0.1))
    goal = hung_over(body, 0.2)
    reach = 0.2 + body.radius
    angle = np.arctan2(goal[:, 0], goal[:, 2] - HEIGHT)
    np.testing.assert_allclose(angle * reach, body.rest[:, 0], atol=1e-12)
