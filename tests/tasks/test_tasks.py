"""Tasks: costs in closed form, symmetries of the costs, the start states, the registry."""

from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment

from jaxsimp import goals, tasks
from jaxsimp.bodies import rope
from jaxsimp.dynamics import at_rest, make_simulation, settle
from jaxsimp.tasks import Episode, Task, crumple, matching_distance, score, task_names

ROPES = ("rope_straightening", "rope_folding")
GARMENTS = ("t_shirt_sleeves_in", "trousers_leg_over_leg")
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
    return jax.jit(task.cost_fn)


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


# --- scores ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", task_names())
def test_score_is_0_at_the_start_and_near_1_at_the_goal(name):
    task = make_task(name, quick=True)
    episode = task.episode_fn(2)
    start, goal = (jnp.asarray(p, dtype=float) for p in (episode.start, episode.goal))
    assert float(score(task, episode, start)) == 0.0
    # A rope reaches its goal exactly. The layers of a fold stay a thickness (4 mm) apart.
    gap = 2 * task.body.radius / cost_of(task, episode, start) if name in FOLDS else 0.0
    assert 1 - gap - ROUNDING <= float(score(task, episode, goal)) <= 1.0


@pytest.mark.parametrize("name", FOLDS)
def test_score_is_1_for_the_ideal_fold(name):
    # The moving half exactly on its images, which have not moved.
    task = make_task(name, quick=True)
    episode = task.episode_fn(4)
    ideal = np.array(episode.goal)
    ideal[:, 2] = episode.start[:, 2]
    assert float(score(task, episode, jnp.asarray(ideal, dtype=float))) == pytest.approx(
        1.0,
        abs=1e-5,  # images coincide to the rounding of coordinates, 1e-8 m of 0.14 m
    )


def test_a_worse_state_than_the_start_scores_below_0():
    task = make_task("cloth_side_folding", quick=True)
    episode = task.episode_fn(0)
    dragged = jnp.asarray(episode.start + np.array([0.5, 0.0, 0.0]), dtype=float)
    assert float(score(task, episode, dragged)) < -1


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


@pytest.mark.parametrize("name", FOLDS)
def test_episodes_are_turned_by_random_angles_up_to_45_degrees(name):
    task = make_task(name, quick=True)
    angles = []
    for seed in range(40):
        episode = task.episode_fn(seed)
        edge = episode.start[-1] - episode.start[0]
        angle = np.arctan2(edge[1], edge[0]) - np.pi / 4  # the diagonal of a square at rest
        angles.append((angle + np.pi) % (2 * np.pi) - np.pi)
        np.testing.assert_allclose(episode.start, goals.flat(task.body, angles[-1]), atol=1e-12)
        np.testing.assert_allclose(episode.goal, goals.turn(task.goal, angles[-1]), atol=1e-12)
    assert np.max(np.abs(angles)) <= np.pi / 4
    # 40 uniform draws all miss an eighth of the range at either end once in 10^2.
    assert min(angles) < -np.pi / 8 < np.pi / 8 < max(angles)
    assert len(set(angles)) == 40


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
    gradient = jax.grad(task.cost_fn, argnums=1)(episode, jnp.asarray(moved(task, 0, 0.05)))
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
    gradient_fn = jax.jit(jax.grad(task.cost_fn, argnums=1))
    for position in (episode.start, episode.goal, np.zeros_like(task.body.rest)):
        gradient = gradient_fn(episode, jnp.asarray(position, dtype=float))
        assert np.all(np.isfinite(gradient))


@pytest.mark.parametrize("name", task_names())
def test_gradients_are_those_of_finite_differences(name, x64):
    task = tasks.make_task(name, 5)  # not one that a float32 test has traced
    episode = task.episode_fn(0)
    position, along = jnp.asarray(moved(task, 2, 0.05)), jnp.asarray(cloud(3, len(task.goal)))
    _, slope = jax.jvp(lambda p: task.cost_fn(episode, p), (position,), (along,))
    ahead, behind = (cost_of(task, episode, position + h * along) for h in (1e-6, -1e-6))
    # Central differences: error of h^2 times a third derivative of 1/(5 cm)^2, and 1e-16 / h.
    assert float(slope) == pytest.approx((ahead - behind) / 2e-6, rel=1e-6, abs=1e-9)
    gradient = jax.grad(task.cost_fn, argnums=1)(episode, position)
    assert float(jnp.vdot(gradient, along)) == pytest.approx(float(slope), rel=1e-12)


# --- crumpled ropes -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def crumpled():
    """A short rope and what it looks like after four picks, for three seeds."""
    body = rope(11, tasks.rope.ROPE_LENGTH)
    return body, [crumple(body, seed) for seed in range(3)]


def test_a_crumpled_rope_is_the_same_for_the_same_seed_only(crumpled):
    body, shapes = crumpled
    np.testing.assert_array_equal(crumple(body, 1), shapes[1])
    again = rope(11, tasks.rope.ROPE_LENGTH)  # an equal body, compiled anew
    np.testing.assert_array_equal(crumple(again, 1), shapes[1])
    for first, second in [(0, 1), (0, 2), (1, 2)]:
        assert np.abs(shapes[first] - shapes[second]).max() > 0.05


def test_a_crumpled_rope_lies_on_the_table_at_rest(crumpled):
    body, shapes = crumpled
    simulation = make_simulation(body, 1e-3, self_contact=True)
    for position in shapes:
        assert position[:, 2].min() >= body.radius - 1e-6  # float32 rounding of a step
        later = settle(simulation, at_rest(position), 300)
        # Not a pose of a moment: left alone it stays, to a twentieth of the spacing.
        assert np.abs(later.position - position).max() < body.spacing / 20


@pytest.mark.slow
def test_parts_of_a_crumpled_rope_lie_on_each_other():
    body = rope(41, tasks.rope.ROPE_LENGTH)
    stacked = 0
    for seed in range(4):
        position = crumple(body, seed).astype(float)
        # Ten points on each segment; those nearer along the rope than it can bend are left out.
        along = np.linspace(0, 40, 401)
        points = np.stack([np.interp(along, np.arange(41), axis) for axis in position.T], axis=1)
        apart = np.linalg.norm(points[:, None] - points, axis=2)
        apart[np.abs(along[:, None] - along) < 3] = np.inf
        assert apart.min() > 0.8 * 2 * body.radius
        stacked += position[:, 2].max() > 2 * body.radius
    assert stacked > 0


def test_a_crumpled_rope_is_not_overstretched_and_not_straight(crumpled):
    body, shapes = crumpled
    # At rest on the table friction holds a tension of at most mu m g: with the 150 N/m of a
    # spring between neighbours that is 0.65 mm.
    allowed = body.material.friction * body.mass.sum() * 9.81 / 150.0
    for position in shapes:
        lengths = np.linalg.norm(np.diff(position, axis=0), axis=1)
        assert np.all(lengths <= body.spacing + allowed)
        assert np.linalg.norm(position[-1] - position[0]) < 0.97 * body.size


def test_straightening_starts_crumpled():
    task = make_task("rope_straightening", 11)
    episode = task.episode_fn(1)
    np.testing.assert_array_equal(episode.start, crumple(task.body, 1))
    np.testing.assert_array_equal(episode.goal, task.goal)


# --- the registry ---------------------------------------------------------------------------------


def test_the_four_tasks_of_the_paper_are_registered():
    assert set(task_names("paper")) == {*ROPES, *FOLDS}


def test_groups_are_all_tasks():
    assert set(task_names()) == {*task_names("paper"), *task_names("goals")}
    assert len(task_names("goals")) == 8
    assert task_names("none") == ()


@pytest.mark.parametrize("name", task_names())
@pytest.mark.parametrize("resolution", [5, 6, 13])
def test_tasks_have_other_resolutions(name, resolution):
    task = make_task(name, resolution)
    if name in GARMENTS:
        assert task.body.num_particles == pytest.approx(resolution**2, rel=0.15)
    else:
        assert task.body.shape == (resolution,) * len(task.body.shape)
    assert task.goal.shape == task.body.rest.shape
    simulation = task.simulation()
    assert float(simulation.time_step) == pytest.approx(task.time_step, rel=1e-6)
    seconds = task.action_steps * task.time_step
    assert seconds == pytest.approx(task.action_seconds, abs=task.time_step / 2)  # whole steps


@pytest.mark.parametrize("name", task_names())
def test_scales(name):
    full, quick = make_task(name), make_task(name, quick=True)
    assert quick.body.num_particles < full.body.num_particles
    assert make_task(name, 7, quick=True).body.num_particles < quick.body.num_particles
    assert full.name == name


def test_unknown_task_names_the_choices():
    with pytest.raises(ValueError, match=r"unknown task 'rope_tying'.*rope_folding"):
        make_task("rope_tying")


@pytest.mark.parametrize("resolution", [4, 1, 0, -3])
def test_low_resolution_is_refused(resolution):
    with pytest.raises(ValueError, match=f"resolution is {resolution}; .* at least 5"):
        make_task("rope_folding", resolution)


def test_a_name_is_taken_once(monkeypatch):
    monkeypatch.setattr(tasks.task, "_REGISTRY", dict(tasks.task._REGISTRY))
    with pytest.raises(ValueError, match="'rope_folding' is registered already"):
        tasks.register("rope_folding", full=9, quick=5)
    made = []

    @tasks.register("mine", full=9, quick=6)
    def mine(resolution):
        made.append(resolution)
        return make_task("rope_folding", resolution)

    assert "mine" in task_names()
    for choice in ({}, {"quick": True}, {"resolution": 7}):
        make_task("mine", **choice)
    assert made == [9, 6, 7]


def test_a_goal_that_does_not_fit_is_refused():
    task = make_task("rope_folding", 9)
    with pytest.raises(ValueError, match=r"goal of particle 0 is .* give finite coordinates"):
        Task(
            name="broken",
            body=task.body,
            goal=np.full((9, 3), np.nan),
            episode_fn=task.episode_fn,
            cost_fn=task.cost_fn,
            limits=task.limits,
        )
