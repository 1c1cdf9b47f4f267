"""Scores of states: 0 for the start, 1 where the cost is 0."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsimp.dynamics import State, at_rest
from jaxsimp.tasks import Episode, make_task, score, task_names

FOLDS = ("cloth_side_folding", "cloth_diagonal_folding")
LAYERS = dict.fromkeys(FOLDS, 1) | {
    "cloth_reflective_folding": 2,
    "cloth_underneath_folding": 1,
}
"""Number of gaps of a thickness that a cost of the goal counts."""
ROUNDING = 2e-6  # of costs, relative: see test_costs.py


@pytest.mark.parametrize("name", task_names())
def test_score_is_0_at_the_start_and_near_1_at_the_goal(name):
    task = make_task(name, quick=True)
    episode = task.episode_fn(2)
    start, goal = (jnp.asarray(p, dtype=float) for p in (episode.start, episode.goal))
    assert float(score(task, episode, start)) == 0.0
    # A rope reaches its goal exactly. The layers of a fold stay a thickness (4 mm) apart.
    start_cost = float(task.terminal_cost(episode, at_rest(start)))
    gap = LAYERS.get(name, 0) * 2 * task.body.radius / start_cost
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


def of_the_first_particle(episode, state, action=None):
    """Distance of the first particle to its goal along x, metres."""
    return jnp.abs(state.position[0, 0] - jnp.asarray(episode.goal)[0, 0])


def first_particle_task():
    return dataclasses.replace(make_task("rope_letter_m", 5), terminal_cost=of_the_first_particle)


def scored(start: float, end: float) -> tuple[float, float]:
    """Score of a first particle that goes from one cost to another, and its derivative."""
    task, goal = first_particle_task(), np.zeros((5, 3))
    episode = Episode(np.full((5, 3), start), goal)

    def of_end(end):
        return score(task, episode, jnp.full((5, 3), end))

    value, slope = jax.jit(jax.value_and_grad(of_end))(end)
    return float(value), float(slope)


def test_score_of_a_start_that_costs_nothing_is_the_limit_of_cheap_starts():
    assert scored(0.0, 0.0)[0] == 1.0
    assert scored(0.0, 1e-3)[0] == -np.inf
    # The limit: of starts that cost less and less, with an end that costs nothing or something.
    for start in (1e-3, 1e-6, 1e-12):
        assert scored(start, 0.0)[0] == 1.0
        assert scored(start, 1e-3)[0] == pytest.approx(1 - 1e-3 / start, rel=1e-6, abs=1e-6)


def test_gradient_of_a_score_is_finite_where_the_start_costs_nothing():
    for start, end in [(0.0, 0.0), (0.0, 1e-3)]:
        assert np.isfinite(scored(start, end)[1])
    assert scored(0.5, 0.25)[1] == pytest.approx(-2.0)  # -1 / c_0 where the start costs something


def test_a_cost_that_is_not_a_number_has_no_score():
    # Failure is data: an unstable state must not pass for a good one, whatever the start costs.
    for start in (0.0, 0.5):
        assert np.isnan(scored(start, np.nan)[0])


def test_score_of_positions_is_that_of_their_state_at_rest():
    task = make_task("rope_letter_m", 5)
    episode, position = task.episode_fn(0), jnp.full((5, 3), 0.1)
    state = State(position, jnp.ones((5, 3)))
    assert float(score(task, episode, position)) == float(score(task, episode, state))

    def speed(episode, state):
        return 1.0 + jnp.abs(state.velocity).mean()

    task = dataclasses.replace(task, terminal_cost=speed)
    assert float(score(task, episode, position)) == 0.0
    assert float(score(task, episode, state)) == -1.0


@pytest.mark.usefixtures("unchecked_shapes")
def test_what_is_no_state_of_the_body_has_no_score():
    task = make_task("rope_folding", 5)
    start, goal = map(np.asarray, (task.episode_fn(0).start, task.episode_fn(0).goal))
    nowhere = start * np.nan
    for episode, state, message in (
        (Episode(start, goal), np.inf, r"position has shape \(\); give shape \(N, 3\)"),
        (Episode(start, goal), goal[:4], r"state has shape \(4, 3\); give shape \(5, 3\)"),
        (Episode(start, goal[:1]), goal, r"goal of the episode has shape \(1, 3\); give shape"),
        (Episode(nowhere, goal), goal, r"episode.start\[0, 0\] is nan; give numbers"),
        (start, goal, r"the episode is a ndarray; give Episode"),
    ):
        with pytest.raises(ValueError, match=message):
            score(task, episode, state)
    big = start.astype(start.dtype.newbyteorder())
    found = score(task, Episode(big, goal.tolist()), goal)
    assert found == score(task, Episode(start, goal), goal)
    assert jnp.isnan(score(task, Episode(start, goal), nowhere))
