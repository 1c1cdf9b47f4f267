"""Plans for goals of one's own: what is planned for, how, and what comes out."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

import jaxsimp as js
from jaxsimp import goal_plan, goals
from jaxsimp.planning import CEM, Joint, Planner, StagedPlanner

ROPE = js.rope(11, 0.4)
CORNERS = np.array([[0.0, 0.0], [0.25, 0.0], [0.25, 0.15]])
L_SHAPE = goals.polyline(ROPE, CORNERS)
CLOTH = js.cloth((9, 9))
SMALL = CEM(num_iterations=3, population=24, initial_populations=1, encoding=Joint())


def folded(name: str) -> goals.Positions:
    return goals.fold_sequence(CLOTH, goals.rectangle_folds(CLOTH, name))


@pytest.fixture(autouse=True)
def small_search(monkeypatch):
    monkeypatch.setitem(goal_plan.SEARCHES, "cem", SMALL)


@lru_cache(None)
def planner() -> goal_plan.GoalPlanner:
    return js.goal_planner(ROPE, L_SHAPE, search="cem")


def test_a_plan_is_scored_saved_and_verified(tmp_path):
    plan = planner().plan(1)
    assert plan.key_points.particles.tolist() == [0, 6, 10]
    assert 0 < plan.score < 1
    assert plan.is_success == (plan.score >= 0.9)
    path = tmp_path / "plan.npz"
    plan.save(path)
    saved = js.load_plan(path)
    np.testing.assert_array_equal(saved.actions.displacement, plan.actions.displacement)
    found = saved.about["found"]
    assert found["seed"] == 1
    assert found["key_points"] == [0, 6, 10]
    np.testing.assert_array_equal(found["costs"], plan.search.optimum.best_costs)
    plan.animate(tmp_path / "plan.html")
    assert "<canvas" in (tmp_path / "plan.html").read_text()
    again = Planner(saved.task()).execute(saved.episode, saved.actions)
    assert again.score == pytest.approx(plan.score, abs=1e-6)
    replayed = plan.verify("fast")
    assert replayed.positions.shape == plan.execution.positions.shape


def test_it_is_the_better_of_two_searches_and_repeats():
    plan, again, other = planner().plan(1), planner().plan(1), planner().plan(2)
    assert len(plan.search.searches) == 2
    scores = [
        planner().planner.execute(plan.episode, each.actions).score for each in plan.search.searches
    ]
    assert plan.score == max(scores) > min(scores)
    np.testing.assert_array_equal(plan.actions.displacement, again.actions.displacement)
    assert np.any(plan.actions.displacement != other.actions.displacement)


def test_questions_are_counted():
    asked = []
    planner().plan(1, lambda: asked.append(None))
    assert len(asked) == planner().num_questions


def test_a_saved_plan_keeps_its_cost(tmp_path):
    task = js.reach(ROPE, L_SHAPE, cost="shape", num_actions=2)
    found = replace(planner(), task=task).plan(0)
    found.save(tmp_path / "plan.npz")
    assert js.load_plan(tmp_path / "plan.npz").task().terminal_cost is js.tasks.COSTS["shape"]


@pytest.mark.parametrize(
    ("name", "kind", "num_actions"),
    # The letter: two actions for each of two folds, and four idle ones between them.
    [("side", Planner, 2), ("letter", StagedPlanner, 8), ("quarter", StagedPlanner, 8)],
)
def test_folds_give_the_number_of_actions(name, kind, num_actions):
    made = js.goal_planner(CLOTH, folded(name))
    assert type(made.planner) is kind
    assert made.planner.task.num_actions == num_actions


def test_corners_of_a_rope_give_the_number_of_actions():
    body = js.rope(41, 0.5375)
    counts = {}
    for letter in "CMS":
        made = js.goal_planner(body, goals.letter(body, letter))
        counts[letter] = made.task.num_actions, len(made.key_points)
    for num_actions, num_key_points in counts.values():
        assert num_actions in (num_key_points + 1, num_key_points + 2)
        assert num_actions % 2 == 0
    assert counts["M"] == (6, 5)


def test_plan_takes_the_options_of_the_planner():
    plan = js.plan(ROPE, L_SHAPE, 3, search="cem", num_actions=2, limits=(0.1, 0.1, 0.05))
    assert plan.actions.pick.shape == (2, 2)
    assert np.all(np.abs(plan.actions.displacement) <= np.array([0.1, 0.1, 0.05]) + 1e-6)


def test_a_batch_of_goals_has_the_plans_of_each(monkeypatch):
    made = []
    original = goal_plan.planner_of
    monkeypatch.setattr(goal_plan, "planner_of", lambda task: made.append(task) or original(task))
    turned = goals.turn(L_SHAPE, 0.4)
    plans = js.plan_batch(ROPE, [L_SHAPE, turned], [1, 2], search="cem")
    assert len(made) == 1  # what is compiled serves both
    for plan, goal, seed in zip(plans, (L_SHAPE, turned), (1, 2), strict=True):
        alone = js.plan(ROPE, goal, seed, search="cem")
        np.testing.assert_array_equal(plan.actions.displacement, alone.actions.displacement)
        assert plan.score == alone.score
        np.testing.assert_array_equal(plan.task.goal, goal)
    with pytest.raises(ValueError, match="2 goals and 1 seeds"):
        js.plan_batch(ROPE, [L_SHAPE, turned], [1], search="cem")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"search": "best"}, "search is 'best'"),
        ({"tolerance": 1e-6}, "raise tolerance"),
        ({"cost": "speed"}, "cost is 'speed'"),
    ],
)
def test_what_is_refused(options, message):
    bent = goals.letter(js.rope(41), "S")
    with pytest.raises(ValueError, match=message):
        js.goal_planner(js.rope(41), bent, **options)
    with pytest.raises(ValueError, match="seed"):
        planner().plan(-1)
