"""Costs of tasks: in closed form, their symmetries, matching distances, gradients."""

from functools import lru_cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment

from jaxsimp import goals, tasks
from jaxsimp.dynamics import at_rest
from jaxsimp.tasks import Episode, Task, matching_distance, task_names

FOLDS = ("cloth_side_folding", "cloth_diagonal_folding")
# Costs are means of at most 400 float32 distances of up to 0.5 m: rounding adds up to some
# 1e-7 relative an operation, far below this.
ROUNDING = 2e-6


make_task = lru_cache(None)(
    tasks.make_task
)  # with `jit_cost`, so that tests share what is compiled
jit_matching = jax.jit(matching_distance)


@lru_cache(None)
def jit_cost(task: Task):
    return jax.jit(position_cost(task))


def position_cost(task: Task):
    """The terminal cost as a function of positions, at rest."""
    return lambda episode, position: task.terminal_cost(episode, at_rest(position))


def cost_of(task: Task, episode: Episode, position: np.ndarray) -> float:
    episode = Episode(np.asarray(episode.start), np.asarray(episode.goal))
    return float(jit_cost(task)(episode, jnp.asarray(position, dtype=float)))


def moved(task: Task, seed: int, size: float) -> np.ndarray:
    """The start with every particle moved at random."""
    start = np.asarray(task.episode_fn(0).start)
    return start + size * np.random.default_rng(seed).standard_normal(start.shape)


# --- costs in closed form -------------------------------------------------------------------------


@pytest.mark.parametrize("resolution", [5, 8, 9, 20, 25])
def test_start_cost_of_a_side_fold(resolution):
    # Row i of n mirrors row n-1-i at a distance L (n-1-2i)/(n-1). The mean over the moving
    # half is L/2 for odd n (with the crease, at distance zero) and L/2 n/(n-1) for even n.
    task = make_task("cloth_side_folding", resolution)
    start = task.episode_fn(0).start
    closed = task.body.size / 2 * (1 if resolution % 2 else resolution / (resolution - 1))
    assert cost_of(task, task.episode_fn(0), start) == pytest.approx(closed, rel=ROUNDING)


@pytest.mark.parametrize("resolution", [5, 8, 9, 20])
def test_start_cost_of_a_diagonal_fold(resolution):
    # With h = L/(n-1), the s+1 particles with i+j = s are h √2 (n-1-s) from their images:
    # the mean over s = 0 .. n-1 is h √2 (n-1)/3 = L √2/3, exactly, at every resolution.
    task = make_task("cloth_diagonal_folding", resolution)
    n, h = resolution, task.body.size / (resolution - 1)
    counted = sum((s + 1) * h * np.sqrt(2) * (n - 1 - s) for s in range(n)) / (n * (n + 1) / 2)
    assert counted == pytest.approx(task.body.size * np.sqrt(2) / 3, rel=1e-12)
    cost = cost_of(task, task.episode_fn(0), task.episode_fn(0).start)
    assert cost == pytest.approx(counted, rel=ROUNDING)


@pytest.mark.parametrize(("name", "on_crease"), [(FOLDS[0], 9), (FOLDS[1], 9)])
def test_goal_cost_of_a_fold_is_the_gap_between_its_layers(name, on_crease):
    # The moving particles end a thickness above their images; those on the crease, their own
    # images, a radius above where they were. Both folds of 9 x 9 have 45 moving particles.
    task = make_task(name, 9)
    episode, radius = task.episode_fn(3), task.body.radius
    gap = ((45 - on_crease) * 2 * radius + tasks.cloth.STILL_WEIGHT * on_crease * radius) / 45
    # Heights of 2 mm are differences of coordinates up to 0.2 m, rounded to 1e-8 m.
    assert cost_of(task, episode, episode.goal) == pytest.approx(gap, abs=1e-7)


def test_start_cost_of_rope_folding(x64):
    # 11 of 41 particles; the assignment by SciPy, the positions written out: rope particle at
    # arc s goes to the left or the right side of an equilateral triangle of side L/2.
    task = tasks.make_task("rope_folding", 41)  # not one that a float32 test has traced
    side = tasks.rope.ROPE_LENGTH / 2
    s = np.arange(0, 41, 4) / 40 * 2 * side
    height = np.sqrt(3) / 2 * side
    goal = np.stack([-side / 2 + s / 2, height / 2 - height * np.abs(s / side - 1)], axis=1)
    start = np.stack([s - side, np.zeros(11)], axis=1)
    apart = np.linalg.norm(start[:, None] - goal[None], axis=-1)
    expected = apart[linear_sum_assignment(apart)].mean()
    episode = task.episode_fn(0)
    assert cost_of(task, episode, episode.start) == pytest.approx(expected, rel=1e-9)


@given(st.floats(0.0, 1.0), st.integers(0, 99))
def test_cost_of_rope_straightening_is_the_missing_distance_of_the_ends(distance, seed):
    task = make_task("rope_straightening", 5)
    goal = np.asarray(task.goal)
    assert np.linalg.norm(goal[-1] - goal[0]) == pytest.approx(0.5, rel=1e-12)
    rng = np.random.default_rng(seed)
    position = rng.uniform(-0.3, 0.3, goal.shape)
    towards = rng.standard_normal(3)
    position[-1] = position[0] + distance * towards / np.linalg.norm(towards)
    # abs: float32 coordinates of up to 1.3 m are rounded by 1e-7 m.
    expected = abs(distance - 0.5)
    assert cost_of(task, Episode(goal, goal), position) == pytest.approx(expected, abs=5e-7)


@pytest.mark.parametrize("name", FOLDS)
def test_dragging_the_half_that_should_lie_still_costs_its_weight(name):
    # Carrying the whole cloth off leaves the halves as far apart, and drags the still half.
    task = make_task(name, quick=True)
    episode = task.episode_fn(1)
    away = np.array([0.03, -0.04, 0.0])
    before = cost_of(task, episode, episode.start)
    after = cost_of(task, episode, episode.start + away)
    assert after - before == pytest.approx(1.2 * 0.05, rel=1e-5)  # a difference: some digits go


# --- symmetries -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", task_names())
@given(angle=st.floats(-np.pi, np.pi), seed=st.integers(0, 99))
def test_cost_does_not_change_when_everything_is_turned(name, angle, seed):
    task = make_task(name, quick=True)
    episode = task.episode_fn(0)
    turned = Episode(goals.turn(episode.start, angle), goals.turn(episode.goal, angle))
    position = moved(task, seed, 0.02)
    expected = cost_of(task, episode, position)
    assert cost_of(task, turned, goals.turn(position, angle)) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("resolution", [5, 6, 9])
@pytest.mark.parametrize(
    ("name", "normal"), [(FOLDS[0], (-1.0, 0.0)), (FOLDS[1], (-(0.5**0.5), -(0.5**0.5)))]
)
def test_mirror_pairs_are_reflections_of_the_rest_coordinates(name, normal, resolution):
    # The pairs are read off the gradient of the cost: it is large for whole rows of pairs only
    # where a particle is compared, so lift one particle and see which other one feels it.
    task = make_task(name, resolution)
    rest, episode = task.body.rest, task.episode_fn(0)
    n = np.array([*normal, 0.0])
    distance = rest @ n
    moving = np.flatnonzero(distance > -1e-9)
    image = rest[moving] - 2 * distance[moving, None] * n
    nearest = np.linalg.norm(rest[None] - image[:, None], axis=-1)
    still = nearest.argmin(axis=1)
    assert nearest.min(axis=1).max() < 1e-12
    position = moved(task, 1, 0.05)
    expected = (
        np.linalg.norm(position[moving] - position[still], axis=-1).mean()
        + 1.2 * np.linalg.norm(position[still] - episode.start[still], axis=-1).mean()
    )
    assert cost_of(task, episode, position) == pytest.approx(expected, rel=ROUNDING)


def test_rope_folding_compares_11_particles_end_to_end():
    task = make_task("rope_folding", 41)
    episode = task.episode_fn(0)
    gradient = jax.grad(position_cost(task), argnums=1)(episode, jnp.asarray(moved(task, 0, 0.05)))
    compared = np.flatnonzero(np.linalg.norm(gradient, axis=1))
    np.testing.assert_array_equal(compared, np.arange(0, 41, 4))


# --- matching distance ----------------------------------------------------------------------------


def cloud(seed: int, count: int, scale: float = 1.0) -> np.ndarray:
    return scale * np.random.default_rng(seed).standard_normal((count, 3))


@given(st.sampled_from([1, 2, 5, 11]), st.integers(0, 10**6))
def test_matching_distance_is_that_of_scipy(count, seed):
    points, targets = cloud(seed, count), cloud(seed + 1, count)
    apart = np.linalg.norm(points[:, None] - targets[None], axis=-1)
    expected = apart[linear_sum_assignment(apart)].mean()
    found = jit_matching(jnp.asarray(points), jnp.asarray(targets))
    # float32; a tie broken otherwise has the same mean.
    assert float(found) == pytest.approx(expected, rel=1e-6)


@given(st.sampled_from([2, 7]), st.integers(0, 10**6), st.randoms(use_true_random=False))
def test_matching_distance_ignores_the_order_of_the_points(count, seed, random):
    points, targets = cloud(seed, count), cloud(seed + 1, count)
    order = list(range(count))
    random.shuffle(order)
    plain = float(jit_matching(jnp.asarray(points), jnp.asarray(targets)))
    shuffled = float(jit_matching(jnp.asarray(points[order]), jnp.asarray(targets)))
    assert shuffled == pytest.approx(plain, rel=1e-6)  # sums in another order
    assert float(jit_matching(jnp.asarray(points[order]), jnp.asarray(points))) == 0.0


def test_gradient_of_the_matching_distance_is_that_of_the_best_assignment(x64):
    points, targets = cloud(5, 7), cloud(6, 7)
    gradient = jax.grad(matching_distance)(jnp.asarray(points), jnp.asarray(targets))
    apart = np.linalg.norm(points[:, None] - targets[None], axis=-1)
    _, match = linear_sum_assignment(apart)
    towards = points - targets[match]
    expected = towards / np.linalg.norm(towards, axis=1, keepdims=True) / 7
    np.testing.assert_allclose(gradient, expected, rtol=1e-12)


# --- gradients ------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", task_names())
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_positions_that_are_not_finite_have_no_finite_cost(name, bad):
    # Planning counts on it: such a rollout ranks last. Particle 0 matters to every cost.
    task = make_task(name, quick=True)
    episode = task.episode_fn(0)
    one = np.array(episode.start)
    one[0, 1] = bad
    for position in (one, np.full_like(one, bad)):
        assert not np.isfinite(cost_of(task, episode, position))


@pytest.mark.parametrize("name", task_names())
def test_gradients_are_finite_at_the_start_at_the_goal_and_where_points_coincide(name):
    task = make_task(name, quick=True)
    episode = task.episode_fn(0)
    gradient_fn = jax.jit(jax.grad(position_cost(task), argnums=1))
    for position in (episode.start, episode.goal, np.zeros_like(task.body.rest)):
        gradient = gradient_fn(episode, jnp.asarray(position, dtype=float))
        assert np.all(np.isfinite(gradient))


@pytest.mark.parametrize("name", task_names())
def test_gradients_are_those_of_finite_differences(name, x64):
    task = tasks.make_task(name, 5)  # not one that a float32 test has traced
    episode = task.episode_fn(0)
    position, along = jnp.asarray(moved(task, 2, 0.05)), jnp.asarray(cloud(3, len(task.goal)))
    cost = partial(position_cost(task), episode)
    # Each compiled as one program.
    slope = jax.jit(lambda p, d: jax.jvp(cost, (p,), (d,))[1])(position, along)
    ahead, behind = (cost_of(task, episode, position + h * along) for h in (1e-6, -1e-6))
    # Central differences: error of h^2 times a third derivative of 1/(5 cm)^2, and 1e-16 / h.
    assert float(slope) == pytest.approx((ahead - behind) / 2e-6, rel=1e-6, abs=1e-9)
    gradient = jax.jit(jax.grad(cost))(position)
    assert float(jnp.vdot(gradient, along)) == pytest.approx(float(slope), rel=1e-12)
