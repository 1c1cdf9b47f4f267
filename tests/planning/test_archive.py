"""The archive of the best distinct plans, against a slow search in NumPy; candidates."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxsimp.planning import ActionSpace, Plans, action_space
from jaxsimp.planning.archive import DISTINCT, archived, empty_archive
from jaxsimp.planning.space import as_candidates
from jaxsimp.simplification import simplify
from jaxsimp.tasks import make_task

NUM_CANDIDATES, ROOM, BATCH = 2, 3, 4


def space() -> ActionSpace:
    return ActionSpace(jnp.arange(NUM_CANDIDATES), jnp.ones(3, float), num_actions=1, num_pickers=2)


SHIFTS = [0.0, 0.8 * DISTINCT, 1.6 * DISTINCT, 1.0]
"""Steps of these are below `DISTINCT` or above it by a fifth, far more than float32 rounds."""
one_plan = st.builds(
    lambda choice, shift, place, cost: (choice, [shift * (i == place) for i in range(6)], cost),
    st.sampled_from([[0, 0], [0, 1], [NUM_CANDIDATES, 0]]),
    st.sampled_from(SHIFTS),
    st.sampled_from([0, 5]),  # a displacement of the first slot, or of the last
    st.sampled_from([0.0, 1.0, 2.0, np.inf]),  # ties, and failures
)
batches = st.lists(st.lists(one_plan, min_size=BATCH, max_size=BATCH), min_size=1, max_size=3)


def alike(one, other) -> bool:
    """Whether two plans are one: no slot differs in what is grasped, or how far that is moved."""
    apart = np.abs(moves_of(one) - moves_of(other)).max(axis=1)
    grasped = np.array(one[0]) < NUM_CANDIDATES
    return one[0] == other[0] and not (grasped & (apart > DISTINCT)).any()


def moves_of(plan):
    return np.reshape(plan[1], (2, 3))


def slow_archive(held: list, new: list) -> list:
    """The best distinct: the cheapest, then the cheapest that is not like one chosen."""
    pool, chosen = held + new, []
    for plan in sorted(pool, key=lambda plan: plan[2]):  # stable: the older first
        if not any(alike(plan, each) for each in chosen):
            chosen.append(plan)
    return chosen[:ROOM]


def as_plans(batch) -> tuple[Plans, jax.Array]:
    choice = jnp.asarray([plan[0] for plan in batch])[:, None]
    direction = jnp.asarray(np.stack([moves_of(plan) for plan in batch])[:, None], float)
    return Plans(choice, direction), jnp.asarray([plan[2] for plan in batch], float)


add = jax.jit(lambda archive, plans, costs: archived(archive, space(), plans, costs))


@given(batches=batches)
def test_the_archive_is_that_of_a_slow_search(batches):
    archive, held = empty_archive(space(), ROOM), []
    for batch in batches:
        archive = add(archive, *as_plans(batch))
        held = slow_archive(held, batch)
        np.testing.assert_array_equal(archive.filled, np.arange(ROOM) < len(held))
        wanted, costs = as_plans(held)
        np.testing.assert_array_equal(archive.costs[: len(held)], costs)
        np.testing.assert_array_equal(archive.plans.choice[: len(held)], wanted.choice)
        np.testing.assert_array_equal(archive.plans.direction[: len(held)], wanted.direction)


def some(cost: float, place: float = 0.0, choice: int = 0):
    return [choice, choice], [place] * 6, cost


def test_fewer_plans_than_room_are_filled_up_with_copies_of_the_best():
    archive = add(empty_archive(space(), ROOM), *as_plans([some(2.0), some(1.0, 0.5)] * 2))
    assert archive.filled.tolist() == [True, True, False]
    best = archive.best(3)
    np.testing.assert_array_equal(best.direction[:, 0, 0, 0], [0.5, 0.0, 0.5])


def test_a_plan_that_failed_comes_before_no_plan_and_after_all_others():
    failed = [some(np.inf, place) for place in (0.1, 0.3, 0.5, 0.7)]
    archive = add(empty_archive(space(), ROOM), *as_plans(failed))
    assert archive.filled.all()
    assert np.isinf(archive.costs).all()
    archive = add(archive, *as_plans([some(5.0, 0.9)] * BATCH))
    assert archive.costs[0] == 5.0
    np.testing.assert_allclose(archive.plans.direction[:, 0, 0, 0], [0.9, 0.1, 0.3], rtol=1e-6)


def test_displacements_of_what_is_not_grasped_do_not_tell_plans_apart():
    nothing = [some(1.0, place, NUM_CANDIDATES) for place in (0.0, 0.3, 0.6, 0.9)]
    archive = add(empty_archive(space(), ROOM), *as_plans(nothing))
    assert archive.filled.tolist() == [True, False, False]
    assert archive.plans.direction[0, 0, 0, 0] == 0.0  # the older


# --- candidates -----------------------------------------------------------------------------------


def test_candidates_are_ids_a_mask_or_key_points():
    np.testing.assert_array_equal(as_candidates(np.array([5, 2]), 9), [5, 2])
    mask = np.zeros(9, bool)
    mask[[2, 5]] = True
    np.testing.assert_array_equal(as_candidates(mask, 9), [2, 5])
    task = make_task("rope_folding", 9)
    found = simplify(task.body, task.goal, method="paper")
    space = action_space(task, found)
    np.testing.assert_array_equal(space.candidates, found.particles)
    np.testing.assert_allclose(space.limits, task.limits, rtol=1e-7)  # float32
    assert (space.num_actions, space.num_pickers) == (task.num_actions, task.num_pickers)


BODY = "ids 0 to 8 of a body of 9 particles"


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (np.array([], int), f"candidates is empty; give at least one of the {BODY}"),
        ([], f"candidates is empty; give at least one of the {BODY}"),
        ([[0, 1], [2]], r"candidates is \[\[0, 1\], \[2\]\]; give ids of particles"),
        (np.zeros(9, bool), f"candidates is empty; give at least one of the {BODY}"),
        (np.array([0, 9]), f"candidates names particle 9; give .*{BODY}"),
        (np.array([3, -1]), f"candidates names particle -1; give .*{BODY}"),
        (np.array([0.0, 1.0]), r"an array of float64 of shape \(2,\); give the ids .*\(9,\)"),
        (np.array([[0, 1]]), r"an array of int64 of shape \(1, 2\); give the ids of particles"),
        (np.ones(8, bool), r"an array of bool of shape \(8,\); give .* a mask of shape \(9,\)"),
        (np.array([4, 1, 4]), "candidates names particle 4 twice; give each id once"),
    ],
)
def test_what_are_no_candidates_is_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        as_candidates(wrong, 9)
    with pytest.raises(ValueError, match=message):
        action_space(make_task("rope_folding", 9), wrong)
