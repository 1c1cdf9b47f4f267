"""Plans in stages: each fold from where the last one left the body."""

import dataclasses
from functools import lru_cache

import jax.numpy as jnp
import numpy as np
import pytest

from jaxsimp.dynamics import NONE, Actions
from jaxsimp.engines import Layout, MassSprings
from jaxsimp.goals import find_folds, subgoals
from jaxsimp.planning import (
    CEM,
    PRICES,
    Planner,
    Reranking,
    Sequence,
    StagedPlanner,
    stage_algorithm,
    staged_task,
    stages,
)
from jaxsimp.records import load_plan, save_plan
from jaxsimp.tasks import Episode, make_task

SEARCH = Sequence((CEM(num_iterations=1, population=4, initial_populations=1), Reranking(2)))
CORNERS = np.array([0, 8, 72, 80])


@lru_cache(None)
def task():
    """A quarter fold of a coarse cloth whose actions take few time steps."""
    made = make_task("cloth_quarter_fold", 9)
    return dataclasses.replace(made, action_seconds=0.1, settle_actions=3)


@lru_cache(None)
def planner() -> StagedPlanner:
    # Its pickers are too fast for self-contact.
    return StagedPlanner(task(), evaluator=MassSprings(), layout=Layout(1, 2))


@lru_cache(None)
def planned(seed: int = 3):
    return planner().plan(task().episode_fn(seed), CORNERS, SEARCH, seed)


def test_a_plan_has_two_actions_a_fold_and_idle_ones_between():
    plan = planned()
    assert len(planner().subgoals) == len(find_folds(task().body, task().goal)) == 2
    assert plan.actions.pick.shape == (2 + 3 + 2, 2)
    assert plan.actions.pick.shape[0] == planner().task.num_actions
    assert staged_task(task(), 3).num_actions == 3 * 2 + 2 * 3
    assert np.all(plan.actions.pick[2:5] == NONE)
    assert np.all(plan.actions.displacement[2:5] == 0)
    assert np.any(plan.actions.pick[:2] != NONE)
    assert np.any(plan.actions.pick[5:] != NONE)


def test_a_stage_starts_where_the_last_one_left_the_body(monkeypatch):
    asked, original = [], Planner.plan_batch

    def recorded(self, episodes, *arguments, **named):
        asked.append(episodes)
        return original(self, episodes, *arguments, **named)

    monkeypatch.setattr(Planner, "plan_batch", recorded)
    episode = task().episode_fn(3)
    plan = planner().plan(episode, CORNERS, SEARCH, 3)
    (first, *_), (second, *_) = asked
    np.testing.assert_allclose(first.start, episode.start, atol=1e-7)  # float32
    np.testing.assert_allclose(second.goal, episode.goal, atol=1e-6)
    # Carried out in one piece, the body rests there before the second stage begins; what still
    # moves then, of 0.3 m, is below a tenth of a millimetre.
    whole = planner().execute(episode, plan.actions)
    np.testing.assert_allclose(second.start, whole.positions[5], atol=1e-4)
    assert np.abs(second.start - first.start).max() > 0.01


def test_the_better_attempt_at_a_stage_is_kept():
    plan, episode = planned(), task().episode_fn(3)
    stage, (first, second) = planner()._stage, plan.searches[:2]
    one = Episode(
        np.float32(episode.start), np.float32(planner()._subgoals(episode.goal)[0].positions)
    )
    scores = [stage.execute(one, each.actions).score for each in (first, second)]
    assert scores[0] != scores[1]
    best = (first, second)[int(np.argmax(scores))]
    np.testing.assert_array_equal(plan.actions.pick[:2], best.actions.pick)
    np.testing.assert_array_equal(plan.actions.displacement[:2], best.actions.displacement)


def test_sub_goals_are_carried_to_the_goal_of_the_episode():
    # The oracle finds the folds of the goal that is turned.
    goal = np.asarray(task().episode_fn(5).goal, float)
    wanted = subgoals(task().body, goal)
    for found, each in zip(planner()._subgoals(goal), wanted, strict=True):
        # rounding of the goal
        np.testing.assert_allclose(found.positions, each.positions, atol=1e-5)
        np.testing.assert_array_equal(found.moving, each.moving)
    # Another goal of as many folds has its own; of another number it is refused.
    letter = np.asarray(make_task("cloth_letter_fold", 9).goal)
    wanted = subgoals(task().body, letter)
    for found, each in zip(planner()._subgoals(letter), wanted, strict=True):
        np.testing.assert_array_equal(found.positions, each.positions)
        np.testing.assert_array_equal(found.moving, each.moving)
    side = np.asarray(make_task("cloth_side_folding", 9).goal)
    with pytest.raises(ValueError, match=r"takes 1 stages and that of the task 2; make a planner"):
        planner().plan(Episode(task().episode_fn(0).start, side), CORNERS, SEARCH)


def test_folds_side_by_side_are_one_stage_for_two_pickers():
    corners = make_task("cloth_four_corners", 9)
    folds = subgoals(corners.body, corners.goal)
    found = stages.stages_of(corners, corners.goal)
    assert (len(folds), len(found)) == (4, 2)
    for index, each in enumerate(found):
        np.testing.assert_array_equal(
            each.moving, folds[2 * index].moving | folds[2 * index + 1].moving
        )
        np.testing.assert_array_equal(each.positions, folds[2 * index + 1].positions)
    one_picker = dataclasses.replace(corners, num_pickers=1)
    assert len(stages.stages_of(one_picker, corners.goal)) == 4
    # The third of a letter that comes second lies on the first, which it does not move.
    letter = make_task("cloth_letter_fold", 9)
    first, second = stages.stages_of(letter, letter.goal)
    assert not np.any(first.moving & second.moving)


def test_candidates_of_a_stage_are_those_that_it_moves():
    start = np.zeros((5, 3))
    end = np.array([[0, 0, 0], [0.2, 0, 0], [0, 0, 0], [0, 0, 0.05], [0, 0, 0]])
    moving = np.array([False, False, True, False, False])
    found = stages._candidates(np.array([0, 1, 2, 3]), moving, start, end, 0.1)
    np.testing.assert_array_equal(found, [1, 2])
    np.testing.assert_array_equal(
        stages._candidates(np.array([0, 4]), moving, start, end, 0.1), [0, 4]
    )


def test_the_same_seed_gives_the_same_plan_and_another_one_another():
    again = planner().plan(task().episode_fn(3), CORNERS, SEARCH, 3)
    np.testing.assert_array_equal(again.actions.displacement, planned().actions.displacement)
    other = planner().plan(task().episode_fn(3), CORNERS, SEARCH, 4)
    assert np.any(other.actions.displacement != again.actions.displacement)
    seeds = [stages._seed(3, stage, attempt) for stage in range(2) for attempt in range(2)]
    assert len(set(seeds)) == 4


def test_prices_add_up():
    plan = planned()
    # Two attempts at two stages: 4 plans, 2 settled ones, the cost of the one that is returned, and
    # its execution.
    assert planner().num_searches == len(plan.searches) == 4 == 2 * len(plan.parts)
    assert plan.num_rollouts == 4 * (4 + 2 + 1 + 1)
    assert plan.price == 4 * (4 + 2 * PRICES["settled"] + 1 + PRICES["settled"])
    assert plan.seconds == sum(part.seconds for part in plan.parts)
    assert any(plan.optimum is each.optimum for each in plan.searches[2:])
    assert stage_algorithm(reranks=False).algorithms == stage_algorithm().algorithms[:-1]


def test_a_plan_in_stages_is_saved_and_replayed_as_any_other(tmp_path):
    plan, episode, whole = planned(), task().episode_fn(3), planner().task
    execution = planner().execute(episode, plan.actions)
    path = tmp_path / "plan.npz"
    save_plan(path, whole, episode, plan.actions, execution, engine=planner().evaluator)
    saved = load_plan(path)
    replay = Planner(saved.task(), evaluator=MassSprings()).execute(saved.episode, saved.actions)
    np.testing.assert_array_equal(replay.positions, saved.positions)


def test_an_unstable_stage_is_followed_from_where_it_began(monkeypatch):
    broken = Actions(jnp.full((2, 2), NONE), jnp.zeros((2, 2, 3)))
    episode, original = task().episode_fn(3), Planner.execute
    starts = []

    def unstable(self, each, actions):
        starts.append(each.start)
        done = original(self, each, broken)
        return dataclasses.replace(done, positions=done.positions * np.nan, score=np.nan)

    monkeypatch.setattr(Planner, "execute", unstable)
    planner().plan(episode, CORNERS, SEARCH, 3)
    np.testing.assert_allclose(starts[-1], episode.start, atol=1e-7)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("rope_letter_u", "has no triangles; folds are found of sheets only"),
        ("towel_over_bar", "the goal of the"),
    ],
)
def test_goals_without_folds_are_refused(name, message):
    with pytest.raises(ValueError, match=message):
        StagedPlanner(make_task(name, 9))


def test_a_flat_goal_has_no_stages():
    flat = dataclasses.replace(task(), goal=np.asarray(task().episode_fn(0).start))
    with pytest.raises(ValueError, match="has no folds; plan for it in one piece, with Planner"):
        StagedPlanner(flat)
