"""Coarse to fine: plans and positions carried over between bodies, and the planner that does it."""

import dataclasses
from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsimp.bodies import cloth, rope
from jaxsimp.dynamics import NONE, Actions
from jaxsimp.engines import Layout, MassSprings
from jaxsimp.planning import (
    CEM,
    CoarseToFinePlanner,
    LocalSearch,
    Plan,
    Planner,
    action_space,
    carry_over,
    host,
    problem,
)
from jaxsimp.planning.between_bodies import carried_positions, nearest_particles
from jaxsimp.planning.coarse_to_fine import best_distinct
from jaxsimp.planning.evaluations import Evaluations
from jaxsimp.records import load_plan, save_plan
from jaxsimp.tasks import Task, make_task, score

COARSE, FINE = cloth((5, 5)), cloth((9, 9))
CORNERS = {5: [0, 4, 20, 24], 9: [0, 8, 72, 80]}
SEARCH = CEM(num_iterations=2, population=6, initial_populations=1)
CANDIDATES = np.array([0, 8, 16])


# --- between bodies -------------------------------------------------------------------------------


def test_particles_become_the_nearest_of_the_other_body():
    np.testing.assert_array_equal(nearest_particles(COARSE, FINE)[CORNERS[5]], CORNERS[9])
    np.testing.assert_array_equal(nearest_particles(FINE, COARSE)[CORNERS[9]], CORNERS[5])
    np.testing.assert_array_equal(nearest_particles(FINE, FINE), np.arange(81))
    np.testing.assert_array_equal(nearest_particles(rope(5), rope(9)), [0, 2, 4, 6, 8])
    # Every second particle of the fine grid has its own in the coarse one.
    inner = nearest_particles(FINE, COARSE).reshape(9, 9)[::2, ::2]
    np.testing.assert_array_equal(inner, np.arange(25).reshape(5, 5))


def test_a_plan_carried_over_picks_the_nearest_and_moves_the_same():
    moves = jnp.asarray(np.random.default_rng(0).normal(size=(3, 2, 2, 3)), float)
    picks = jnp.array([[[0, 4], [NONE, 24]], [[12, NONE], [20, 0]], [[NONE, NONE], [4, 12]]])
    plans = Actions(picks, moves)
    found = carry_over(plans, COARSE, FINE)
    wanted = [[[0, 8], [NONE, 80]], [[40, NONE], [72, 0]], [[NONE, NONE], [8, 40]]]
    np.testing.assert_array_equal(found.pick, wanted)
    np.testing.assert_array_equal(found.displacement, moves)
    for there, back in ((found, plans), (carry_over(plans, COARSE, COARSE), plans)):
        other = FINE if there is found else COARSE
        np.testing.assert_array_equal(carry_over(there, other, COARSE).pick, back.pick)


def test_a_plan_of_another_body_is_refused():
    plan = Actions(jnp.array([[81, NONE]]), jnp.zeros((1, 2, 3)))
    with pytest.raises(ValueError, match="picks particle 81 of a body of 81; give the body of the"):
        carry_over(plan, FINE, COARSE)
    for other in (cloth((5, 5), (0.3, 0.25)), rope(5)):
        with pytest.raises(ValueError, match=r"extents of the two .* give two resolutions"):
            nearest_particles(FINE, other)


@pytest.mark.parametrize(("body", "to"), [(FINE, COARSE), (COARSE, FINE), (rope(9), rope(5))])
def test_a_body_that_is_turned_and_sheared_is_carried_exactly(body, to):
    matrix = np.random.default_rng(0).normal(size=(3, 3))

    def lying(rest: np.ndarray) -> np.ndarray:
        return rest @ matrix + [1.0, 2.0, 3.0]

    # Rounding of float64 in a system of eight equations.
    np.testing.assert_allclose(
        carried_positions(body, lying(body.rest), to), lying(to.rest), atol=1e-12
    )


def test_a_bent_body_is_carried_to_second_order_and_itself_exactly():
    body = cloth((17, 17))
    bent = np.random.default_rng(0).normal(size=(289, 3))
    np.testing.assert_array_equal(carried_positions(body, bent, body), bent)
    radius = 0.1

    def rolled(rest: np.ndarray) -> np.ndarray:
        angle = rest[:, 0] / radius
        return np.stack([radius * np.sin(angle), rest[:, 1], -radius * np.cos(angle)], axis=1)

    other = cloth((14, 14))
    error = np.abs(carried_positions(body, rolled(body.rest), other) - rolled(other.rest)).max()
    # Half a spacing off, along a tangent: spacing^2 / (8 radius); at a rim the slope is that of a
    # spacing and a half further in.
    assert error < (0.3 / 16) ** 2 / radius
    with pytest.raises(ValueError, match="positions has shape"):
        carried_positions(COARSE, bent, body)


# --- the planner ----------------------------------------------------------------------------------


@lru_cache(None)
def small_task(resolution: int) -> Task:
    task = make_task("rope_folding", resolution)
    return dataclasses.replace(task, num_actions=1, action_seconds=0.03, settle_actions=1)


@lru_cache(None)
def planner() -> CoarseToFinePlanner:
    return made(refinements=(LocalSearch((0.2, 0.1), 3, 2),) * 2)


def made(**options) -> CoarseToFinePlanner:
    coarser = small_task(5), small_task(9)
    # Its pickers are too fast for self-contact.
    options = {"evaluator": MassSprings(), "layout": Layout(1, 1)} | options
    return CoarseToFinePlanner(small_task(17), coarser, **options)


def planned(seed: int = 6, **options) -> Plan:
    return planner().plan(small_task(17).episode_fn(seed), CANDIDATES, SEARCH, seed, **options)


def test_each_body_starts_from_the_plan_before_and_the_last_is_no_worse():
    asked = []
    plan = planned(10, on_ask=lambda: asked.append(None))
    assert len(asked) == 2 * 2 + 2 + 2  # two searches on the coarsest
    ids = {5: [0, 2, 4], 9: [0, 4, 8], 17: CANDIDATES.tolist()}
    tasks = [each.task for each in planner().planners]
    for part, task in zip(plan.parts, tasks, strict=True):
        assert set(np.asarray(part.actions.pick).ravel().tolist()) <= {*ids[task.resolution], NONE}
    # A middle and an end: what is picked tells one candidate from another.
    assert np.asarray(plan.parts[0].actions.pick).tolist() == [[2, 0]]
    starts = plan.parts[:-1]
    steps = zip(plan.parts[1:], starts, tasks[1:], tasks[:-1], strict=True)
    for part, start, other, one in steps:
        carried = carry_over(start.actions, one.body, other.body)
        np.testing.assert_array_equal(part.actions.pick, carried.pick)
        off = np.abs(part.actions.displacement - carried.displacement).max()
        assert off < 0.15 * 0.2 * 5  # five deviations
    carried = carry_over(starts[-1].actions, tasks[1].body, tasks[2].body)
    episode = small_task(17).episode_fn(10)
    execute = planner().execute
    # What is settled is rounded otherwise in an execution, see test_planner.py.
    assert execute(episode, plan.actions).score >= execute(episode, carried).score - 1e-5


def test_each_body_has_noise_of_its_own(monkeypatch):
    asked, original = [], Evaluations.__call__

    def watched(self, wants, episodes, plans, size):
        if wants == "settled":
            asked.append(np.asarray(plans[0].displacement))
        return original(self, wants, episodes, plans, size)

    monkeypatch.setattr(Evaluations, "__call__", watched)
    planned()
    # The first row of the first round is the best start, the third is noise around it.
    first, second = (asked[index][2] - asked[index][0] for index in (0, 2))
    assert np.median(np.abs(first - second)) > 1e-3  # noise at a limit is cut off


def test_counts_and_seconds_add_up():
    plan = planned()
    # Twice twelve draws, and the execution of both plans; then two starts, six settled, the cost
    # of the plan that is returned.
    assert [part.num_rollouts for part in plan.parts] == [2 * (12 + 1), 2 + 6 + 1, 2 + 6 + 1]
    assert [part.price for part in plan.parts] == [2 * (12 + 4), 2 + 24 + 1, 2 + 24 + 1]
    for name in ("num_rollouts", "price", "seconds", "compile_seconds"):
        assert getattr(plan, name) == sum(getattr(part, name) for part in plan.parts)
    assert plan.optimum is plan.parts[-1].optimum


def test_the_same_seed_gives_the_same_plan_bit_for_bit_and_another_another():
    first, again = planned(), planned()
    for pair in zip(jax.tree.leaves(first.optimum), jax.tree.leaves(again.optimum), strict=True):
        np.testing.assert_array_equal(*pair)
    np.testing.assert_array_equal(first.actions.displacement, again.actions.displacement)
    assert np.any(planned(7).actions.displacement != first.actions.displacement)


def test_all_is_compiled_before_the_first_plan(monkeypatch):
    fresh = made(refinements=planner().refinements)
    space = action_space(fresh.task, CANDIDATES)
    assert fresh.prepare(SEARCH, space) > 0
    exchanges = host._compile.cache_info().misses
    for name in ("plan_cost", "settled_cost"):  # what is traced fails
        monkeypatch.setattr(problem, name, None)
    plan = fresh.plan(fresh.task.episode_fn(6), CANDIDATES, SEARCH, 6)
    assert host._compile.cache_info().misses == exchanges
    np.testing.assert_array_equal(plan.actions.displacement, planned().actions.displacement)
    assert fresh.estimate_seconds(SEARCH) > 0
    assert fresh.layout_of(SEARCH) == fresh.layout == Layout(1, 1)
    assert fresh.engine == MassSprings()


def test_of_candidates_with_one_coarse_particle_the_nearest_is_kept():
    # 0 to 16 on a rope of 17; one of 5 has particles beside 0, 4, 8, 12, 16.
    coarse, middle, fine = planner()._ids(np.array([15, 7, 8, 0, 9, 3, 1]))
    np.testing.assert_array_equal(fine, [0, 3, 8, 15])
    np.testing.assert_array_equal(coarse, [0, 1, 2, 4])
    assert middle[[0, 2]].tolist() == [0, 4]
    everywhere = planner()._ids(np.ones(17, bool))
    np.testing.assert_array_equal(everywhere[0], np.arange(5))
    np.testing.assert_array_equal(everywhere[2], [0, 4, 8, 12, 16])


def test_starts_are_the_plan_returned_and_other_archived_ones():
    space = action_space(small_task(5), np.array([0, 2, 4]))
    plan = planned().parts[0]
    starts = best_distinct(space, plan, 3)
    archive = space.actions(plan.optimum.archive.plans)
    assert len(starts.pick) == 3
    np.testing.assert_array_equal(starts.displacement[0], plan.actions.displacement)
    # An archive of one, which is the plan returned: it fills the rest.
    assert len(archive.pick) == 1
    np.testing.assert_array_equal(starts.displacement[2], plan.actions.displacement)
    other = dataclasses.replace(plan, actions=jax.tree.map(lambda leaf: -leaf, plan.actions))
    starts = best_distinct(space, other, 2)
    np.testing.assert_array_equal(starts.displacement[0], other.actions.displacement)
    np.testing.assert_array_equal(starts.displacement[1], archive.displacement[0])


@pytest.mark.usefixtures("unchecked_shapes")
def test_what_does_not_fit_together_is_refused():
    other = dataclasses.replace(small_task(5), num_actions=2)
    with pytest.raises(ValueError, match=r"num_actions is 1 in the task and \[2\] in the coarser"):
        CoarseToFinePlanner(small_task(9), other)
    with pytest.raises(ValueError, match="coarser has no task; give"):
        CoarseToFinePlanner(small_task(9), ())
    for wrong in ((), LocalSearch(), (LocalSearch(),) * 3):
        with pytest.raises(ValueError, match=r"refinements is .* give a tuple of 2, one for each"):
            made(refinements=wrong)
    with pytest.raises(ValueError, match="3 is no algorithm"):
        made(refinements=(LocalSearch(), 3))
    sheet = dataclasses.replace(make_task("cloth_side_folding", 5), num_actions=1)
    same = {name: getattr(sheet, name) for name in ("limits", "action_seconds")}
    with pytest.raises(ValueError, match="extents of the two bodies"):
        CoarseToFinePlanner(sheet, dataclasses.replace(small_task(5), **same))


def test_refinements_by_default_are_rounds_on_each_body():
    assert [len(each.deviations) for each in made().refinements] == [6, 2]
    assert CoarseToFinePlanner(small_task(9), small_task(5)).refinements == (LocalSearch(),)


def test_a_plan_is_saved_and_replayed_as_any_other(tmp_path):
    plan, task = planned(), small_task(17)
    episode = task.episode_fn(6)
    execution = planner().execute(episode, plan.actions)
    path = tmp_path / "plan.npz"
    save_plan(path, task, episode, plan.actions, execution, engine=planner().evaluator)
    saved = load_plan(path)
    np.testing.assert_array_equal(saved.actions.pick, plan.actions.pick)
    np.testing.assert_array_equal(saved.positions, execution.positions)
    again = Planner(task, evaluator=MassSprings()).execute(saved.episode, saved.actions)
    np.testing.assert_array_equal(again.positions, execution.positions)
    last = jnp.asarray(execution.positions[-1])
    assert execution.score == pytest.approx(float(score(task, episode, last)), abs=1e-6)
