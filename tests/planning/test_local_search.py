"""Local search, and searches that start from given plans."""

import dataclasses
import re
from dataclasses import dataclass
from functools import lru_cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array

from jaxsimp.dynamics import NONE, Actions
from jaxsimp.engines import Layout, MassSprings
from jaxsimp.planning import (
    CEM,
    PRICES,
    ActionSpace,
    LocalSearch,
    Planner,
    Plans,
    RandomShooting,
    Reranking,
    Sequence,
    Told,
    optimize,
    price,
    search_on_host,
)
from jaxsimp.planning.loop import evaluation
from jaxsimp.tasks import make_task

LIMITS = (0.1, 0.2, 0.05)
CANDIDATES = [3, 11, 42]
SHORT = CEM(num_iterations=2, population=12, initial_populations=1)


@partial(jax.tree_util.register_dataclass, data_fields=["space"], meta_fields=[])
@dataclass(frozen=True)
class Bowl:
    """Least, 0, at displacements of half the limits; settled, at a fifth, from 2 on."""

    space: ActionSpace

    def _from(self, actions: Actions, least: float) -> Array:
        direction = actions.displacement / jnp.broadcast_to(self.space.limits, (2, 2, 3))
        return ((direction - least) ** 2).sum()

    def cost(self, actions: Actions) -> Array:
        return self._from(actions, 0.5)

    def settled_cost(self, actions: Actions) -> Array:
        # A plan that begins with particle 42 comes apart.
        return jnp.where(actions.pick[0, 0] == 42, jnp.nan, 2 + self._from(actions, 0.2))

    def evaluator_cost(self, actions: Actions) -> Array:
        return self.cost(actions)


def bowl() -> Bowl:
    return Bowl(ActionSpace(jnp.array(CANDIDATES), jnp.array(LIMITS, float), 2, 2))


def given(*levels: float, pick: int = 11) -> Actions:
    """Plans to start from: both pickers move by these fractions of the limits."""
    moves = np.array(levels)[:, None, None, None] * np.broadcast_to(LIMITS, (2, 2, 3))
    picks = np.full(moves.shape[:-1], pick)
    picks[:, 1, 1] = NONE
    return Actions(jnp.asarray(picks), jnp.asarray(moves, float))


def searched(algorithm, initial: Actions | None, seed: int = 0):
    """The search on the host, and what was asked: kind, plans, costs."""
    problem, asked = bowl(), []
    jitted = {wants: jax.jit(jax.vmap(evaluation(problem, wants))) for wants in PRICES}

    def evaluate(wants, actions):
        asked.append((wants, actions, np.asarray(jitted[wants](actions).costs)))
        return Told(asked[-1][2])

    plans = None if initial is None else problem.space.plans(initial)
    key = jax.random.key(seed)
    return search_on_host(algorithm, problem.space, key, evaluate, initial=plans), asked


def levels(actions: Actions) -> np.ndarray:
    """Displacements in units of the limits."""
    return np.asarray(actions.displacement) / np.array(LIMITS)


# --- local search ---------------------------------------------------------------------------------


def test_the_first_round_has_the_starts_and_plans_around_them_in_turn():
    _, asked = searched(LocalSearch((0.01, 0.01), 6, 2), given(-0.3, 0.4))
    (wants, costed, costs), (settled, first, told), (_, second, _), _ = asked
    assert (wants, settled) == ("cost", "settled")
    assert costs[0] > costs[1] == pytest.approx(12 * 0.1**2, rel=1e-5)  # float32
    # By cost, the better first; both are asked as they are.
    for row, start in ((0, 1), (1, 0)):
        np.testing.assert_array_equal(first.displacement[row], costed.displacement[start])
    centres = np.array([0.4, -0.3])[np.arange(6) % 2]
    off = levels(first) - centres[:, None, None, None]
    assert np.all(np.abs(off) < 0.06)  # six deviations
    assert np.all(np.abs(off[2:]).max(axis=(1, 2, 3)) > 1e-4)
    # Then all are around the best, which is not among them.
    best = levels(first)[told.argmin()]
    assert np.all(np.abs(levels(second) - best) < 0.06)
    assert np.all(np.abs(levels(second) - best).max(axis=(1, 2, 3)) > 1e-4)
    for _, actions, _ in asked[1:3]:
        np.testing.assert_array_equal(actions.pick, np.broadcast_to(costed.pick[0], (6, 2, 2)))


def test_fewer_starts_than_wanted_are_not_asked_twice():
    _, asked = searched(LocalSearch((0.05,), 4, 3), given(0.3))
    _, first, _ = asked[1]
    assert len(np.unique(np.asarray(first.displacement).reshape(4, -1), axis=0)) == 4


def test_noise_has_the_deviation_of_its_round_and_keeps_inside_the_limits():
    _, asked = searched(LocalSearch((0.1, 0.02), 512), given(0.2))
    _, first, _ = asked[1]
    # 6,144 numbers: their deviation is within 4 % at five standard errors (0.9 % each).
    assert np.std(levels(first)[1:] - 0.2) == pytest.approx(0.1, rel=0.04)
    best = levels(first)[asked[1][2].argmin()]
    assert np.std(levels(asked[2][1]) - best) == pytest.approx(0.02, rel=0.04)
    _, asked = searched(LocalSearch((0.1,), 64), given(0.99))
    assert np.abs(levels(asked[1][1])).max() < 1


def test_it_improves_and_returns_the_best_that_it_saw():
    found, asked = searched(LocalSearch(), given(0.5))
    settled = [costs for wants, _, costs in asked if wants == "settled"]
    assert [len(costs) for costs in settled] == [8, 8, 8]
    start, best = settled[0][0], min(costs.min() for costs in settled)
    assert start == pytest.approx(2 + 12 * 0.3**2, rel=1e-5)
    # Three rounds of eight come nearer by 0.2 and more with every seed that was tried.
    assert best < start - 0.1
    returned = jax.jit(bowl().settled_cost)(found.actions)
    assert returned == pytest.approx(best, rel=1e-6)
    # The cost is the planner's own, not that by which it was chosen.
    assert found.cost == pytest.approx(float(bowl().cost(found.actions)), rel=1e-5)
    assert price(LocalSearch()) == 24 * PRICES["settled"]


@pytest.mark.parametrize("level", [0.2, -0.9])
def test_it_is_never_worse_than_its_start(level):
    # At the least, where all noise is worse, and far from it, for many seeds.
    settled, start = jax.jit(bowl().settled_cost), given(level)
    for seed in range(5):
        found, _ = searched(LocalSearch((0.3,), 2), start, seed)
        alone = settled(jax.tree.map(lambda leaf: leaf[0], start))
        assert settled(found.actions) <= alone * (1 + 1e-6)


def test_where_all_fails_the_start_is_returned_and_failures_are_counted():
    found, asked = searched(LocalSearch((0.1, 0.1), 4), given(0.3, pick=42))
    np.testing.assert_allclose(levels(found.actions), 0.3, rtol=1e-6)
    assert found.failed == 8
    assert all(np.isnan(costs).all() for wants, _, costs in asked if wants == "settled")


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"deviations": ()}, r"deviations is \(\); give one number for each round"),
        ({"deviations": 0.1}, "deviations is 0.1; give one number for each round"),
        ({"deviations": (0.1, -1.0)}, r"deviations\[1\] is -1.0; give .* from 0"),
        ({"num_starts": 9}, "num_starts is 9; give a whole number from 1 to 8"),
        ({"wants": "gradient"}, "wants is 'gradient'; "),
    ],
)
def test_settings_that_make_no_search_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        LocalSearch(**settings)
    assert hash(LocalSearch([0.1, 0.2])) == hash(LocalSearch((0.1, 0.2)))


# --- searches that start from given plans ---------------------------------------------------------


def test_plans_of_actions_are_the_inverse_of_actions():
    space, key = bowl().space, jax.random.key(0)
    drawn = RandomShooting(num_plans=32).ask(space, (), key)[1]
    found = space.plans(space.actions(drawn))
    np.testing.assert_array_equal(found.choice, drawn.choice)
    # Times a limit, and by it: two roundings of float32.
    np.testing.assert_allclose(found.direction, drawn.direction, rtol=2e-7)
    one = jax.tree.map(lambda leaf: leaf[0], space.actions(drawn))
    assert space.plans(one).choice.shape == (2, 2)


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize(
    ("actions", "message"),
    [
        (given(0.5, pick=12), r"picks particle 12, which is no candidate; .* \[3, 11, 42\]"),
        (given(0.5, 1.001), "a displacement of 1.001 limits; give at most the limits"),
        (given(float("nan")), "a displacement of nan limits"),
        (Actions(jnp.full((3, 2), 11), jnp.zeros((3, 2, 3))), r"pick of shape \(3, 2\)"),
        (Actions(jnp.full((2, 1), 11), jnp.zeros((2, 1, 3))), r"give shapes \(\*B, 2, 2\)"),
    ],
)
def test_plans_that_are_not_of_the_space_are_refused(actions, message):
    with pytest.raises(ValueError, match=message):
        bowl().space.plans(actions)


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize(
    ("choice", "direction"),
    [
        ((2, 2), (2, 2, 3)),
        ((0, 2, 2), (0, 2, 2, 3)),
        ((1, 2, 3), (1, 2, 3, 3)),
        ((1, 2, 2), (2, 2)),
    ],
)
def test_initial_plans_of_other_shapes_are_refused(choice, direction):
    plans = Plans(jnp.zeros(choice, int), jnp.zeros(direction, float))
    with pytest.raises(ValueError, match=re.escape("give shapes (B, 2, 2) and (B, 2, 2, 3)")):
        optimize(bowl(), SHORT, jax.random.key(0), initial=plans)


@pytest.mark.usefixtures("x64")
def test_both_drivers_start_alike():
    algorithm = Sequence((Reranking(2), LocalSearch((0.1,), 4, 2)))
    problem, initial = bowl(), given(0.3, 0.6, -0.2)
    plans = problem.space.plans(initial)
    pure = jax.jit(lambda key: optimize(problem, algorithm, key, batch=2, initial=plans))
    found, _ = searched(algorithm, initial)
    # Other machine code, in float64, over some ten operations.
    for pair in zip(jax.tree.leaves(pure(jax.random.key(0))), jax.tree.leaves(found), strict=True):
        np.testing.assert_allclose(*pair, rtol=0, atol=1e-12)


def test_a_start_only_adds_to_a_search_that_starts_from_nothing():
    # What is drawn, and told, is the same bit for bit; the archive has the start if it is better.
    shooting = RandomShooting(num_asks=2, num_plans=4)
    cold, asked = searched(shooting, None)
    warm, again = searched(shooting, given(0.5))
    assert len(again) == len(asked) + 1 == 3
    for pair in zip(jax.tree.leaves(asked), jax.tree.leaves(again[1:]), strict=True):
        np.testing.assert_array_equal(*pair)
    assert warm.cost == pytest.approx(0, abs=1e-6)
    assert cold.cost > 0.1
    np.testing.assert_allclose(levels(warm.actions), 0.5, rtol=1e-6)
    worse, _ = searched(shooting, given(-1.0))
    for pair in zip(jax.tree.leaves(worse), jax.tree.leaves(cold), strict=True):
        np.testing.assert_array_equal(*pair)


def test_cem_begins_with_a_start_among_its_elites():
    found, asked = searched(SHORT, given(0.45))
    assert found.traces[0]["elite_costs"][0, 0] == asked[0][2][0] == found.best_costs[0]


@lru_cache(None)
def rope_planner() -> Planner:
    task = make_task("rope_folding", 5)
    task = dataclasses.replace(task, num_actions=1, action_seconds=0.02, settle_actions=1)
    # Its pickers are too fast for self-contact.
    return Planner(task, evaluator=MassSprings(), layout=Layout(1, 1))


def test_a_planner_starts_from_plans_counts_them_and_compiles_once():
    planner = rope_planner()
    episode, ids = planner.task.episode_fn(0), np.array([0, 4])
    moves = np.array([[[[0.1, 0.0, 0.05], [0.0, 0.0, 0.0]]], [[[0.0, 0.1, 0.0]] * 2]])
    initial = Actions(jnp.array([[[4, NONE]], [[0, 4]]]), jnp.asarray(moves, float))
    search = LocalSearch((0.1, 0.1), num_plans=3, num_starts=2)
    plan = planner.plan(episode, ids, search, initial=initial)
    # Two starts, two rounds of three, and the cost of what is returned.
    assert plan.num_rollouts == 2 + 6 + 1
    assert plan.price == 2 + 6 * 4 + 1
    assert planner.execute(episode, plan.actions).score >= max(
        planner.execute(episode, jax.tree.map(lambda leaf, i=i: leaf[i], initial)).score
        for i in range(2)
    )
    again = planner.plan(episode, ids, search, initial=initial)
    for pair in zip(jax.tree.leaves(plan.optimum), jax.tree.leaves(again.optimum), strict=True):
        np.testing.assert_array_equal(*pair)
    with pytest.raises(ValueError, match="picks particle 4, which is no candidate"):
        planner.plan(episode, np.array([0, 2]), search, initial=initial)
    with pytest.raises(ValueError, match=r"give shapes \(B, T, G\)"):
        planner.plan(episode, ids, search, initial=jax.tree.map(lambda leaf: leaf[0], initial))
