"""The task for any body and goal: where it starts, what it costs, how far its pickers go."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsimp import goals
from jaxsimp.bodies import cloth, rope
from jaxsimp.dynamics import at_rest
from jaxsimp.tasks import COSTS, crumple, make_task, reach, score

ROPE = rope(11, 0.4)
L_SHAPE = goals.polyline(ROPE, np.array([[0.0, 0.0], [0.3, 0.0], [0.3, 0.1]]))
CLOTH = cloth((7, 7))
SIDE = goals.fold_sequence(CLOTH, goals.rectangle_folds(CLOTH, "side"))


@pytest.mark.parametrize(("body", "goal"), [(ROPE, L_SHAPE), (CLOTH, SIDE)])
@pytest.mark.parametrize("cost", COSTS)
def test_the_goal_scores_one_and_the_start_zero(body, goal, cost):
    task = reach(body, goal, cost=cost)
    episode = task.episode_fn(0)
    assert float(score(task, episode, jnp.asarray(goal, float))) == pytest.approx(1.0, abs=1e-5)
    assert float(score(task, episode, jnp.asarray(episode.start, float))) == 0.0


def test_a_flat_start_is_what_the_goal_unfolds_to():
    turned = goals.turn(SIDE, 0.7) + np.array([0.2, -0.1, 0.0])
    start = reach(CLOTH, turned).episode_fn(0).start
    expected = goals.turn(goals.flat(CLOTH), 0.7) + np.array([0.2, -0.1, 0.0])
    # The folds are fitted to the particles; a tenth of a millimetre of 0.3 m.
    np.testing.assert_allclose(start, expected, atol=1e-4)


def test_a_rope_starts_straight_along_its_goal():
    lying = goals.turn(goals.flat(ROPE), -1.1) + np.array([0.3, 0.4, 0.0])
    bent = lying + 1e-3 * np.random.default_rng(0).standard_normal(lying.shape)
    start = goals.flat_at(ROPE, bent)
    # The best turn of ten times less than the noise: eleven particles share it.
    np.testing.assert_allclose(start[:, :2], lying[:, :2], atol=1e-3)

    # No other turn is better.
    def off(angle):
        middle = bent[:, :2].mean(axis=0)
        moved = goals.turn(start - np.array([*middle, 0.0]), angle)[:, :2] + middle
        return ((moved - bent[:, :2]) ** 2).sum()

    assert off(0.0) < min(off(1e-3), off(-1e-3))


def test_starts_that_are_given_and_crumpled():
    given = L_SHAPE + np.array([0.0, 0.2, 0.0])
    np.testing.assert_array_equal(reach(ROPE, L_SHAPE, start=given).episode_fn(3).start, given)
    far = L_SHAPE + np.array([1.0, -2.0, 0.0])
    task = reach(ROPE, far, start="crumpled")
    x, y, _ = far.mean(axis=0)
    np.testing.assert_allclose(
        task.episode_fn(3).start, crumple(ROPE, 3) + np.array([x, y, 0.0]), atol=1e-6
    )
    assert np.any(task.episode_fn(3).start != task.episode_fn(4).start)
    with pytest.raises(ValueError, match="no draw_fn"):
        task.draw_episode(jax.random.key(0))


def test_a_crumpled_body_can_be_laid_flat_where_a_flat_one_is_refused():
    flat = goals.flat(ROPE)
    with pytest.raises(ValueError, match="at the goal already"):
        reach(ROPE, flat)
    task = reach(ROPE, flat, start="crumpled")
    assert np.abs(task.episode_fn(0).start - flat).max() > 0.05


def test_limits_and_durations_are_the_papers_at_its_sizes():
    for task, name in ((reach(cloth((7, 7)), SIDE), "cloth_side_folding"),):
        paper = make_task(name, 7)
        np.testing.assert_allclose(task.limits, paper.limits)
        assert task.action_seconds == pytest.approx(paper.action_seconds)
        assert task.time_step == pytest.approx(paper.time_step)
    body = rope(11, 0.5375)
    task = reach(body, goals.letter(body, "M"))
    np.testing.assert_allclose(task.limits, make_task("rope_letter_m", 11).limits)


@pytest.mark.parametrize("size", [0.05, 0.3, 2.0])
@pytest.mark.parametrize("thickness", [4e-4, 4e-3])
def test_any_size_and_thickness_has_self_contact(size, thickness):
    body = cloth((7, 7), (size, size), thickness=thickness)
    goal = goals.fold_sequence(body, goals.rectangle_folds(body, "side"))
    task = reach(body, goal)
    task.simulation(self_contact=True)  # raises if pickers are too fast
    assert task.top_speed <= make_task("cloth_side_folding", 7).top_speed * (1 + 1e-9)


def test_a_goal_far_away_can_be_reached():
    far = L_SHAPE + np.array([0.0, 1.5, 0.0])
    task = reach(ROPE, far, start=goals.flat(ROPE), num_actions=3)
    assert 3 * task.limits[1] >= np.abs(far - goals.flat(ROPE)).max()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"start": "rolled"}, "start is 'rolled'"),
        ({"cost": "speed"}, "cost is 'speed'"),
        ({"start": np.zeros((3, 3))}, r"shape \(3, 3\)"),
        ({"start": L_SHAPE}, "is at the goal already; give another start"),
        ({"limits": (0.1, 0.1)}, "three displacements"),
        ({"num_actions": 0}, "num_actions is 0"),
    ],
)
@pytest.mark.usefixtures("unchecked_shapes")
def test_what_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        reach(ROPE, L_SHAPE, **options)


# --- costs ----------------------------------------------------------------------------------------


def test_the_shape_cost_does_not_see_turns_and_shifts():
    task = reach(ROPE, L_SHAPE, cost="shape")
    episode = task.episode_fn(0)
    rng = np.random.default_rng(1)
    state = L_SHAPE + 0.02 * rng.standard_normal(L_SHAPE.shape)
    moved = goals.turn(state, 2.3) + np.array([0.5, -0.4, 0.0])
    costs = [
        float(COSTS["shape"](episode, at_rest(jnp.asarray(each, float)))) for each in (state, moved)
    ]
    # Float32, of coordinates of 1 m: 1e-7 m each.
    assert costs[0] == pytest.approx(costs[1], abs=2e-6)
    # The oracle turns in small steps: the best turn has the least sum of squares.
    own, wanted = (points - [*points[:, :2].mean(axis=0), 0.0] for points in (moved, L_SHAPE))
    tried = [goals.turn(own, angle) - wanted for angle in np.linspace(-np.pi, np.pi, 20001)]
    best = min(tried, key=lambda off: (off[:, :2] ** 2).sum())
    assert costs[1] == pytest.approx(np.linalg.norm(best, axis=1).mean(), rel=1e-4)


def test_the_other_costs_in_closed_form():
    episode = reach(ROPE, L_SHAPE).episode_fn(0)
    rng = np.random.default_rng(2)
    state = L_SHAPE[::-1] + 0.01 * rng.standard_normal(L_SHAPE.shape)
    apart = np.linalg.norm(state[:, None] - L_SHAPE[None], axis=2)
    chamfer = (apart.min(axis=0).mean() + apart.min(axis=1).mean()) / 2
    expected = {
        "particles": np.linalg.norm(state - L_SHAPE, axis=1).mean(),
        "either_end": np.linalg.norm(state - L_SHAPE[::-1], axis=1).mean(),
        "chamfer": chamfer,
        "daxbench": 1 - np.exp(-10 * chamfer),
    }
    for name, value in expected.items():
        found = float(COSTS[name](episode, at_rest(jnp.asarray(state, float))))
        assert found == pytest.approx(value, rel=1e-5)  # float32
