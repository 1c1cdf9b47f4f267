"""Folds found from a goal: folded, found and folded again."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxsimp import goals
from jaxsimp.bodies import Body, cloth, rope
from jaxsimp.bodies.garments import t_shirt, trousers
from jaxsimp.dynamics import NONE, Actions, at_rest
from jaxsimp.engines import MassSprings
from jaxsimp.tasks import make_task

# A goal without noise is fitted to rounding, a few hundred times that of a coordinate of 1 m.
ROUNDING = 1e-10

CLOTH = cloth((13, 13))
NAMES = ("side", "diagonal", "quarter", "letter", "four_corners")
NO_FOLDS = r"the folds found do not give|has no panels|cannot be unfolded"
TUCKED = r"lies face down: it was turned over, or a part of it is tucked under"


def fold_tasks() -> dict[str, tuple[Body, tuple[goals.Fold, ...]]]:
    shirt, pair = t_shirt(num_particles=200), trousers(num_particles=200)
    return {
        **{name: (CLOTH, goals.rectangle_folds(CLOTH, name)) for name in NAMES},
        "sleeves": (shirt.body, goals.sleeves_in(shirt)),
        "legs": (pair.body, goals.leg_over_leg(pair)),
    }


TASKS = fold_tasks()


def states(body: Body, folds: tuple[goals.Fold, ...], start: np.ndarray) -> list[np.ndarray]:
    """The start, and positions after each fold."""
    found = [start]
    for fold in folds:
        found.append(goals.fold_sequence(body, [fold], found[-1]))
    return found


def moved(body: Body, fold: goals.Fold, before: np.ndarray) -> np.ndarray:
    """Particles that a fold turns over."""
    away = before[:, :2] - fold.point
    left = fold.direction[0] * away[:, 1] - fold.direction[1] * away[:, 0]
    above = left > 1e-6 * body.size * np.linalg.norm(fold.direction)
    return above if fold.part is None else above & fold.part


def random_folds(seed: int, count: int, start: np.ndarray, body: Body) -> list[goals.Fold]:
    """Folds about random lines, each of 5 to 95 % of the body."""
    draw = np.random.default_rng(seed)
    folds: list[goals.Fold] = []
    while len(folds) < count:
        place = goals.fold_sequence(body, folds, start)[:, :2]
        low, high = place.min(axis=0), place.max(axis=0)
        point = low + (high - low) * draw.uniform(0.15, 0.85, 2)
        angle = draw.uniform(-np.pi, np.pi)
        fold = goals.Fold(point, np.array([np.cos(angle), np.sin(angle)]))
        if 0.05 < np.mean(moved(body, fold, np.c_[place, place[:, :1]])) < 0.95:
            folds.append(fold)
    return folds


def found_or_none(body: Body, goal: np.ndarray) -> tuple[goals.Fold, ...] | None:
    """The folds of a goal; None if it is refused."""
    try:
        return goals.find_folds(body, goal)
    except ValueError:
        return None


# --- folded, found, folded again -----------------------------------------------------------------


@pytest.mark.parametrize("name", TASKS)
def test_folds_of_the_tasks_are_found(name):
    body, folds = TASKS[name]
    start = goals.flat(body)
    truth = states(body, folds, start)
    found = goals.find_folds(body, truth[-1])
    np.testing.assert_allclose(goals.unfolded(body, truth[-1]), start, atol=ROUNDING)
    np.testing.assert_allclose(goals.fold_sequence(body, found), truth[-1], atol=ROUNDING)
    assert len(found) == len(folds)
    if name not in ("four_corners", "sleeves"):  # whose order is free
        for wanted, have in zip(truth, states(body, found, start), strict=True):
            np.testing.assert_allclose(have, wanted, atol=ROUNDING)


@settings(max_examples=15)
@given(name=st.sampled_from(list(TASKS)), seed=st.integers(0, 10**6), noise=st.floats(0, 2e-3))
def test_noise_of_two_millimetres_does_no_harm(name, seed, noise):
    body, folds = TASKS[name]
    draw = np.random.default_rng(seed)
    angle, shift = draw.uniform(-np.pi, np.pi), np.append(draw.uniform(-0.1, 0.1, 2), 0.0)
    start, end = (
        goals.turn(each, angle) + shift
        for each in (goals.flat(body), goals.fold_sequence(body, folds))
    )
    goal = end + noise * draw.normal(size=end.shape)
    found = goals.find_folds(body, goal)
    again = goals.fold_sequence(body, found, goals.unfolded(body, goal))
    assert len(found) == len(folds)
    # Lines and start are means over dozens of particles: a noise of 2 mm leaves about 1 mm.
    off = np.linalg.norm((goals.unfolded(body, goal) - start)[:, :2], axis=1).max()
    assert off <= ROUNDING + 2 * noise
    assert np.linalg.norm((again - end)[:, :2], axis=1).max() <= ROUNDING + 4 * noise
    # By noise a particle near a crease changes its layer, and no others.
    assert np.mean(np.abs(again - end)[:, 2] > body.radius) <= 0.15


@settings(max_examples=12)
@given(
    seed=st.integers(0, 10**6),
    count=st.integers(1, 3),
    shape=st.tuples(st.integers(11, 17), st.integers(11, 17)),
    sides=st.tuples(st.floats(0.2, 0.5), st.floats(0.2, 0.5)),
    angle=st.floats(-7.0, 7.0),
)
def test_random_folds_are_found_or_refused(seed, count, shape, sides, angle):
    body = cloth(shape, sides)
    start = goals.flat(body, angle)
    folds = random_folds(seed, count, start, body)
    goal = goals.fold_sequence(body, folds, start)
    found = found_or_none(body, goal)
    if found is None:  # parts too small for a panel
        assert count > 1
        return
    again = goals.fold_sequence(body, found, goals.unfolded(body, goal))
    # What is left out is less than a panel at a crease: a few particles.
    off = np.linalg.norm((again - goal)[:, :2], axis=1)
    assert np.mean(off > 0.01 * body.size) <= 0.03
    assert np.mean(again[:, 2] - goal[:, 2] > 1.1 * body.radius) <= 0.1


def test_most_random_sequences_of_three_folds_are_found():
    # The seeds are the same each time. A rate of 0.9 gives fewer than 10 of 15 once in 450 times.
    made = [random_folds(seed, 3, goals.flat(CLOTH), CLOTH) for seed in range(15)]
    found = [found_or_none(CLOTH, goals.fold_sequence(CLOTH, folds)) for folds in made]
    num_found = sum(folds is not None for folds in found)
    assert num_found >= 10


def test_a_flat_goal_has_no_folds_wherever_it_lies():
    goal = goals.flat(CLOTH, 2.0) + np.array([0.3, -0.1, 0.0])
    assert goals.find_folds(CLOTH, goal) == ()
    assert goals.subgoals(CLOTH, goal) == ()
    np.testing.assert_allclose(goals.unfolded(CLOTH, goal), goal, atol=ROUNDING)


def test_lines_on_rows_of_particles_stay_there_in_spite_of_noise():
    goal = goals.fold_sequence(CLOTH, goals.rectangle_folds(CLOTH, "side"))
    noisy = goal + 2e-3 * np.random.default_rng(0).normal(size=goal.shape)
    again = goals.fold_sequence(CLOTH, goals.find_folds(CLOTH, noisy), goals.unfolded(CLOTH, noisy))
    # The middle row is the crease, half way between the layers.
    np.testing.assert_allclose(again[:, 2], goal[:, 2], rtol=1e-9)


# --- sub-goals -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["quarter", "letter", "legs"])
def test_subgoals_are_the_states_between(name):
    body, folds = TASKS[name]
    truth = states(body, folds, goals.flat(body))
    found = goals.subgoals(body, truth[-1])
    for one, fold, before, after in zip(found, folds, truth, truth[1:], strict=False):
        np.testing.assert_allclose(one.positions, after, atol=ROUNDING)
        np.testing.assert_array_equal(one.moving, moved(body, fold, before))
    assert len(found) == len(folds)
    np.testing.assert_array_equal(found[-1].positions, truth[-1])


def test_the_last_subgoal_is_the_goal_itself():
    body, folds = TASKS["quarter"]
    end = goals.fold_sequence(body, folds)
    goal = end + 1e-3 * np.random.default_rng(1).normal(size=end.shape)
    *_, last = goals.subgoals(body, goal)
    np.testing.assert_array_equal(last.positions, goal)


# --- the same folds ------------------------------------------------------------------------------


@pytest.mark.parametrize("name", TASKS)
def test_an_end_near_the_goal_has_the_same_folds_wherever_it_lies(name):
    body, folds = TASKS[name]
    goal = goals.fold_sequence(body, folds)
    end = goals.turn(goal, 1.0) + np.array([0.1, 0.05, 0.0])
    end = end + 2e-3 * np.random.default_rng(2).normal(size=end.shape)
    assert goals.same_folds(body, goal, goal)
    assert goals.same_folds(body, goal, end)
    assert not goals.same_folds(body, goal, goals.flat(body))
    assert not goals.same_folds(body, goals.flat(body), goal)


def test_other_layers_parts_and_lines_are_other_folds():
    line = np.zeros(2), np.array([0.0, 1.0])
    side = goals.fold_sequence(CLOTH, [goals.Fold(*line)])
    other_half = goals.fold_sequence(CLOTH, [goals.Fold(line[0], -line[1])])
    assert not goals.same_folds(CLOTH, side, other_half)
    for shift, same in ((0.01, True), (0.03, False)):  # 0.05 of the size, 0.015 m, is the limit
        end = goals.fold_sequence(CLOTH, [goals.Fold(np.array([-shift, 0.0]), line[1])])
        assert goals.same_folds(CLOTH, side, end) == same
    folds = goals.rectangle_folds(CLOTH, "letter")
    letter, swapped = (goals.fold_sequence(CLOTH, order) for order in (folds, folds[::-1]))
    np.testing.assert_allclose(letter[:, :2], swapped[:, :2], atol=ROUNDING)
    assert not goals.same_folds(CLOTH, letter, swapped)


def test_an_end_that_is_not_flat_has_other_folds(unchecked_shapes):
    goal = goals.fold_sequence(CLOTH, goals.rectangle_folds(CLOTH, "side"))
    assert not goals.same_folds(CLOTH, goal, hill())
    assert not goals.same_folds(CLOTH, goal, np.full_like(goal, np.nan))
    with pytest.raises(ValueError, match=r"end has shape \(3, 3\); give shape \(169, 3\)"):
        goals.same_folds(CLOTH, goal, goal[:3])
    with pytest.raises(ValueError, match=NO_FOLDS):
        goals.same_folds(CLOTH, hill(), goal)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cloth_quarter_fold", "cloth_letter_fold", "cloth_four_corners"])
def test_goals_let_go_and_settled_have_the_same_folds(name):
    task = make_task(name, resolution=17)
    engine = MassSprings(self_contact=True)
    shape = (task.settle_actions, task.num_pickers)
    idle = Actions(jnp.full(shape, NONE), jnp.zeros((*shape, 3)))
    goal = task.episode_fn(0).goal
    settle = jax.jit(lambda physics, state: engine.rollout(physics, state, idle, lambda *_: ())[0])
    end = settle(engine.physics(task), at_rest(jnp.asarray(goal, dtype=float)))
    assert goals.same_folds(task.body, goal, np.asarray(end.position, dtype=float))


# --- refusals ------------------------------------------------------------------------------------


def hill() -> np.ndarray:
    """The cloth over a hill as high as a third of its side."""
    bump = np.cos(np.pi * np.clip(np.linalg.norm(CLOTH.rest[:, :2], axis=1) / 0.15, 0, 1)) + 1
    return CLOTH.rest * [0.85, 0.85, 1] + np.outer(0.05 * bump, [0, 0, 1])


def mirrored(goal: np.ndarray) -> np.ndarray:
    """The lowest layer highest, as a goal tucked under or turned over."""
    return np.c_[goal[:, :2], goal[:, 2].max() + CLOTH.radius - goal[:, 2]]


def accordion() -> np.ndarray:
    """Twenty strips, more than there may be panels, each on the last."""
    body = fine()
    lines = [(x, (-1.0) ** i) for i, x in enumerate(np.linspace(-0.15, 0.15, 21)[1:-1])]
    x, z = body.rest[:, 0].copy(), np.zeros(body.num_particles)
    strip = np.clip(np.floor((x + 0.15) / 0.015), 0, len(lines))
    inside = x + 0.15 - 0.015 * strip
    z = body.radius * (1 + 2 * strip)
    return np.c_[np.where(strip % 2, 0.015 - inside, inside), body.rest[:, 1], z]


def fine() -> Body:
    return cloth((121, 7), (0.3, 0.1))


REFUSED = {
    "rope": (lambda: rope(9), lambda: goals.flat(rope(9)), "the rope has no triangles; folds are"),
    "turned over": (
        lambda: CLOTH,
        lambda: goals.flat(CLOTH) * [-1, 1, 1],
        TUCKED,
    ),
    "tucked under": (
        lambda: CLOTH,
        lambda: mirrored(goals.fold_sequence(CLOTH, goals.rectangle_folds(CLOTH, "letter")[:1])),
        TUCKED,
    ),
    "not flat": (lambda: CLOTH, hill, NO_FOLDS),
    "in the air": (
        lambda: CLOTH,
        lambda: goals.flat(CLOTH) + np.array([0, 0, 0.1]),
        r"panels too low by 0\.1 m, and 0\.002 m, half its thickness or 3 times the former, is",
    ),
    "upright": (
        lambda: CLOTH,
        lambda: CLOTH.rest[:, [0, 2, 1]] + np.array([0, 0, 0.15]),
        NO_FOLDS,
    ),
    "too many panels": (fine, accordion, "has no panels that lie flat, or more than 16; give"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_goals_without_such_folds_are_refused(name):
    body, goal, message = REFUSED[name]
    with pytest.raises(ValueError, match=message):
        goals.find_folds(body(), goal())


def test_a_body_that_is_not_flat_at_rest_is_refused():
    from dataclasses import replace

    body = replace(CLOTH, rest=hill())
    with pytest.raises(ValueError, match="high at rest, and does not lie flat"):
        goals.find_folds(body, hill())


def test_a_goal_of_another_body_is_refused(unchecked_shapes):
    with pytest.raises(ValueError, match=r"the goal has shape \(9, 3\); give shape \(169, 3\)"):
        goals.find_folds(CLOTH, np.zeros((9, 3)))
    with pytest.raises(ValueError, match="give finite coordinates in metres"):
        goals.find_folds(CLOTH, np.full((169, 3), np.nan))
