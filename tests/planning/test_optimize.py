"""Algorithms and their drivers, on a quadratic whose least is known: what all of them promise."""

import dataclasses
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array

from jaxsimp.dynamics import NONE, Actions
from jaxsimp.engines import Layout, MassSprings
from jaxsimp.planning import (
    CEM,
    ENCODINGS,
    PRICES,
    ActionSpace,
    Algorithm,
    Descent,
    LocalSearch,
    Planner,
    RandomShooting,
    Reranking,
    Sequence,
    Told,
    make_problem,
    optimize,
    price,
    search_on_host,
)
from jaxsimp.planning.algorithm import stages
from jaxsimp.planning.loop import evaluation
from jaxsimp.planning.screening import num_again, screened
from jaxsimp.tasks import make_task

CANDIDATES = [3, 11, 42, 7]
LIMITS = np.array([0.1, 0.2, 0.05])
PICK = np.array([[11, NONE], [42, 3]])
MOVE = np.array([[0.5, -0.3, 0.2], [-0.6, 0.1, 0.7]])[:, None] * np.ones((2, 1))


@partial(jax.tree_util.register_dataclass, data_fields=["space", "move"], meta_fields=["fragile"])
@dataclass(frozen=True)
class Quadratic:
    """Least, 0, for the wanted picks and displacements; settled, only x counts.

    If fragile, plans that begin with particle 11 have no cost, and with 42 no gradient.
    """

    space: ActionSpace
    move: Array
    fragile: bool = False

    def cost(self, actions: Actions) -> Array:
        off = actions.displacement / jnp.broadcast_to(self.space.limits, (2, 2, 3)) - self.move
        cost = (off**2).sum() + (actions.pick != PICK).sum()
        if self.fragile:
            first = actions.pick[0, 0]
            cost = jnp.where(first == 11, jnp.nan, cost)
            # The root of zero has a slope that is not finite.
            cost = cost + jnp.sqrt(jnp.where(first == 42, 0.0 * off.sum(), 1.0))
        return cost

    def settled_cost(self, actions: Actions) -> Array:
        off = actions.displacement[..., 0] / self.space.limits[0] - self.move[..., 0]
        return 0.01 * jnp.abs(off).sum()  # below all costs

    def evaluator_cost(self, actions: Actions) -> Array:
        return 0.5 + 2 * self.cost(actions)


def quadratic(shift: float = 0.0, **options) -> Quadratic:
    limits = jnp.asarray(LIMITS, dtype=float)
    space = ActionSpace(jnp.asarray(CANDIDATES), limits, num_actions=2, num_pickers=2)
    return Quadratic(space, jnp.asarray(MOVE + shift, dtype=float), **options)


def on_host(problem, algorithm, key=0, asked=None):
    """The search on the host, keeping what is asked."""
    jitted = {wants: jax.jit(jax.vmap(evaluation(problem, wants))) for wants in PRICES}

    def evaluate(wants, actions):
        if wants == "screened":
            told = screened(jitted["cost"], jitted["screened"], actions)
        else:
            told = jitted[wants](actions)
        if asked is not None:
            asked.append((wants, actions, np.asarray(told.costs)))
        return told

    return search_on_host(algorithm, problem.space, jax.random.key(key), evaluate)


SHORT = CEM(num_iterations=4, population=24, initial_populations=2)
ALGORITHMS = {
    **{name: dataclasses.replace(SHORT, encoding=each) for name, each in ENCODINGS.items()},
    "mean": dataclasses.replace(SHORT, returns="mean"),
    "screened": dataclasses.replace(SHORT, wants="screened"),
    "random shooting": RandomShooting(num_asks=5, num_plans=24),
    "descent": Sequence((SHORT, Descent(num_asks=8, num_starts=3))),
    "reranking": Sequence((SHORT, Reranking(num_starts=4))),
    "local search": Sequence((SHORT, LocalSearch(num_starts=3))),
    "local search by cost": Sequence((SHORT, LocalSearch((0.1, 0.05), 24, wants="cost"))),
    "all": Sequence((SHORT, Descent(num_asks=4, num_starts=2), Reranking(num_starts=3))),
    "two": Sequence((RandomShooting(num_asks=1, num_plans=24), SHORT)),
}
algorithms = pytest.mark.parametrize("algorithm", ALGORITHMS.values(), ids=ALGORITHMS)


def assert_same(found, wanted, **tolerance) -> None:
    """Of two optima: all numbers, traces and archives included."""
    for pair in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(*pair, rtol=0, **tolerance)


# --- what all promise -----------------------------------------------------------------------------


@algorithms
def test_a_search_is_seeded_improves_and_tells_what_it_returns(algorithm):
    problem, asked = quadratic(), []
    found = on_host(problem, algorithm, 1, asked)
    assert_same(on_host(problem, algorithm, 1), found, atol=0)
    assert np.any(on_host(problem, algorithm, 2).best_costs != found.best_costs)
    assert np.all(np.diff(found.best_costs) <= 0)
    assert found.best_costs[-1] < found.best_costs[0]
    screens = getattr(algorithm, "wants", "") == "screened"
    cost = problem.evaluator_cost if screens else problem.cost
    assert found.cost == pytest.approx(float(cost(found.actions)), rel=1e-6)
    assert set(np.asarray(found.actions.pick).ravel().tolist()) <= {*CANDIDATES, NONE}
    assert np.all(np.abs(found.actions.displacement) <= LIMITS.astype(np.float32))
    # A question each, then perhaps the cost of what is returned.
    parts = stages(algorithm)
    shapes = [(part.wants, part.num_plans) for part in parts for _ in range(part.num_asks)]
    assert [(wants, len(costs)) for wants, _, costs in asked][: len(shapes)] == shapes
    assert asked[len(shapes) :] == [] or [len(each[2]) for each in asked[len(shapes) :]] == [1]
    assert len(found.best_costs) == len(shapes)
    assert price(algorithm) == sum(PRICES[wants] * count for wants, count in shapes)
    assert [len(leaf) for each in found.traces for leaf in each.values()] == [
        part.num_asks for part in parts if isinstance(part, CEM)
    ]
    assert all(isinstance(part, Algorithm) for part in parts)


@pytest.mark.parametrize(
    ("kind", "name", "value"),
    [
        (RandomShooting, "num_asks", 0),
        (RandomShooting, "num_plans", -3),
        (Descent, "num_asks", 0),
        (Descent, "num_starts", 0),
        (Descent, "learning_rate", 0.0),
        (Descent, "learning_rate", float("nan")),
        (Reranking, "num_starts", 0),
        (LocalSearch, "num_plans", 0),
        (LocalSearch, "num_starts", 0),
    ],
)
def test_settings_out_of_range_are_refused(kind, name, value):
    with pytest.raises(ValueError, match=f"{name} is {value}; give .* from 1"):
        kind(**{name: value})


def test_a_sequence_of_nothing_is_refused():
    with pytest.raises(ValueError, match=r"algorithms is \(\); give a tuple of at least one"):
        Sequence(())


@pytest.mark.usefixtures("unchecked_shapes")
def test_what_is_no_algorithm_is_refused():
    task = make_task("rope_folding", 5)
    for wrong in (CEM, "cem", 3, Sequence):
        with pytest.raises(ValueError, match=r"is no algorithm; give CEM\(\) or another"):
            optimize(make_problem(task, np.array([0])), wrong, jax.random.key(0))
        with pytest.raises(ValueError, match=r"is no algorithm; give CEM\(\) or another"):
            Sequence((CEM(), wrong))
    assert hash(Sequence([CEM(), Descent()])) == hash(Sequence((CEM(), Descent())))


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize("key", [0, None, np.zeros(2), jax.random.split(jax.random.key(0))])
def test_what_is_no_key_is_refused(key):
    problem = make_problem(make_task("rope_folding", 5), np.array([0]))
    with pytest.raises(ValueError, match=r"^key is .*; give one key, as made by jax.random.key"):
        optimize(problem, CEM(), key)


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize("batch", [0, 2.5])
def test_a_batch_of_nothing_is_refused(batch):
    problem = make_problem(make_task("rope_folding", 5), np.array([0]))
    with pytest.raises(ValueError, match=f"batch is {batch}; give a whole number of at least 1"):
        optimize(problem, CEM(), jax.random.key(0), batch=batch)


# --- one code, two drivers ------------------------------------------------------------------------


@pytest.mark.usefixtures("x64")
@algorithms
def test_optimize_is_the_search_on_the_host(algorithm):
    jitted = jax.jit(lambda problem, key: optimize(problem, algorithm, key, batch=8))
    problem = quadratic()
    # Other machine code rounds numbers of a few units otherwise, in float64: 1e-16 each, over
    # some ten updates.
    assert_same(jitted(problem, jax.random.key(1)), on_host(problem, algorithm, 1), atol=1e-12)


@pytest.mark.usefixtures("x64")
def test_vmap_over_keys_and_over_episodes_is_one_search_each():
    run = jax.jit(lambda move, key: optimize(of_move(move), ALGORITHMS["all"], key))

    def of_move(move):
        return dataclasses.replace(quadratic(), move=move)

    keys = jax.random.split(jax.random.key(0), 4)
    moves = jnp.asarray(MOVE + np.arange(4.0).reshape(4, 1, 1, 1) / 10)
    for axes, arguments in (((None, 0), (moves[0], keys)), ((0, None), (moves, keys[0]))):
        together = jax.jit(jax.vmap(run, in_axes=axes))(*arguments)
        for index in range(4):
            alone = run(
                *(a if axis is None else a[index] for a, axis in zip(arguments, axes, strict=True))
            )
            one = jax.tree.leaves(together)
            assert_same([leaf[index] for leaf in one], jax.tree.leaves(alone), atol=1e-12)


# --- what algorithms are told ---------------------------------------------------------------------


@dataclass(frozen=True)
class Probe(RandomShooting):
    """A user's own: it draws at random, and traces what it is told."""

    wants: str = "gradient"

    def init(self, space, archive):
        del archive
        shape = (self.num_plans, space.num_actions, space.num_pickers)
        zeros = jnp.zeros((*shape, 3), float)
        return {
            "choice": jnp.zeros(shape, int),
            "direction": zeros,
            "costs": zeros[:, 0, 0, 0],
            "gradients": zeros,
        }

    def ask(self, space, state, key):
        return state, super().ask(space, (), key)[1]

    def tell(self, space, state, plans, told):
        gradients = state["gradients"] if told.gradients is None else told.gradients
        return {**vars(plans), "costs": told.costs, "gradients": gradients}

    def trace(self, state):
        return state


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("driver", [on_host, lambda *a: optimize(*a, jax.random.key(0))])
def test_gradients_are_those_of_the_cost_by_direction(driver):
    problem, probe = quadratic(), Probe(num_asks=1, num_plans=3)
    told = {name: leaf[0] for name, leaf in driver(problem, probe).traces[0].items()}
    limits = jnp.asarray(LIMITS)

    def cost(index, direction):
        pick = jnp.asarray([*CANDIDATES, NONE])[told["choice"][index]]
        return float(problem.cost(Actions(pick, direction * jnp.broadcast_to(limits, (2, 2, 3)))))

    for index in range(3):
        direction = np.asarray(told["direction"][index])
        for place in np.ndindex(2, 2, 3):
            step = np.zeros((2, 2, 3))
            step[place] = 1e-4
            # Central differences of a quadratic are exact: rounding of 1e-16 by a step of 1e-4.
            slope = (cost(index, direction + step) - cost(index, direction - step)) / 2e-4
            assert told["gradients"][index][place] == pytest.approx(slope, abs=1e-9)


@pytest.mark.parametrize("driver", [on_host, lambda *a: optimize(*a, jax.random.key(0))])
def test_what_is_not_finite_ranks_last_and_is_counted_and_has_no_gradient(driver):
    probe = Probe(num_asks=1, num_plans=32)
    found = driver(quadratic(fragile=True), probe)
    told = {name: np.asarray(leaf[0]) for name, leaf in found.traces[0].items()}
    without_cost, without_slope = (told["choice"][:, 0, 0] == index for index in (1, 2))
    assert without_cost.sum() > 0 < without_slope.sum()
    assert found.failed == without_cost.sum()
    np.testing.assert_array_equal(np.isinf(told["costs"]), without_cost)
    assert np.isfinite(told["gradients"]).all()
    still = (told["gradients"] == 0).all(axis=(1, 2, 3))
    np.testing.assert_array_equal(still, without_cost | without_slope)
    assert found.cost == told["costs"].min()


# --- one after another ----------------------------------------------------------------------------


def test_a_descent_starts_from_the_best_plans_and_goes_down():
    asked = []
    found = on_host(quadratic(), ALGORITHMS["descent"], 0, asked)
    drawn = [each for each in asked if each[0] == "cost"]
    costs = np.concatenate([each[2] for each in drawn])
    picks, moves = (
        np.concatenate([getattr(each[1], name) for each in drawn])
        for name in ("pick", "displacement")
    )
    _, first, first_costs = next(each for each in asked if each[0] == "gradient")
    np.testing.assert_array_equal(first.pick[0], picks[costs.argmin()])
    np.testing.assert_array_equal(first.displacement[0], moves[costs.argmin()])
    # Distinct, and in the order of their costs.
    assert np.all(np.diff(first_costs) > 0)
    steps = [each for each in asked if each[0] == "gradient"]
    for _, actions, _ in steps:
        np.testing.assert_array_equal(actions.pick, first.pick)
    path = np.stack([each[2] for each in steps])
    # Every step is short of the least of this quadratic: all costs fall.
    assert np.all(np.diff(path, axis=0) < 0)
    assert found.cost == path.min()


def test_reranking_returns_what_settles_best_of_the_best_plans():
    asked = []
    found = on_host(quadratic(), ALGORITHMS["reranking"], 0, asked)
    (_, plans, settled) = next(each for each in asked if each[0] == "settled")
    assert len(settled) == 4
    np.testing.assert_array_equal(found.actions.displacement, plans.displacement[settled.argmin()])
    alone = on_host(quadratic(), SHORT, 0)
    np.testing.assert_array_equal(plans.displacement[0], alone.actions.displacement)
    # Costs are costs, not the numbers that it was chosen by: its own, and those of the archive.
    archived = jax.vmap(quadratic().cost)(quadratic().space.actions(found.archive.plans))
    np.testing.assert_allclose(found.archive.costs, archived, rtol=1e-6)  # float32
    assert found.cost == pytest.approx(float(quadratic().cost(found.actions)), rel=1e-6)
    assert found.cost >= alone.cost


@pytest.mark.parametrize("size", [1, 4, 10])
def test_screening_ranks_the_best_by_their_second_look_and_all_others_behind(size):
    rng = np.random.default_rng(size)
    cheap, dear = rng.permutation(size).astype(float), rng.permutation(size) + 3.0
    cheap[rng.integers(size)] = np.inf if size > 4 else 0.0
    looked = []

    def by_name(costs):
        def told(actions):
            names = np.asarray(actions.pick)[:, 0, 0]
            looked.append(names.tolist())
            return Told(costs[names])

        return told

    picks = np.broadcast_to(np.arange(size)[:, None, None], (size, 2, 2))
    plans = Actions(jnp.asarray(picks), jnp.zeros((size, 2, 2, 3)))
    costs = np.asarray(screened(by_name(cheap), by_name(dear), plans).costs)
    again = np.argsort(cheap, kind="stable")[: num_again(size)]
    assert looked == [list(range(size)), again.tolist()]
    assert len(again) == max(1, -(-size // 4))
    np.testing.assert_array_equal(costs[again], dear[again])
    others = np.delete(np.arange(size), again)
    np.testing.assert_array_equal(costs[others], cheap[others] + dear[again].max())


def test_a_second_look_that_fails_ranks_last_and_hides_no_other():
    plans = Actions(jnp.zeros((8, 2, 2), int), jnp.zeros((8, 2, 2, 3)))
    cheap = Told(jnp.arange(8.0))
    found = screened(lambda _: cheap, lambda _: Told(jnp.array([jnp.nan, 5.0])), plans)
    np.testing.assert_array_equal(found.costs, [np.nan, 5, 7, 8, 9, 10, 11, 12])


def test_algorithms_of_a_sequence_draw_by_themselves():
    asked, shots = [], RandomShooting(num_asks=1, num_plans=4)
    on_host(quadratic(), Sequence((shots, shots)), 0, asked)
    (_, first, _), (_, second, _) = asked
    assert np.all(first.displacement != second.displacement)


def test_a_second_search_keeps_the_best_of_the_first_among_its_elites():
    first, _ = ALGORITHMS["two"].algorithms
    found = on_host(quadratic(), ALGORITHMS["two"])
    before = found.best_costs[first.num_asks - 1]
    elites = np.asarray(found.traces[1]["elite_costs"])
    assert before in elites[0]
    np.testing.assert_array_equal(elites[:, 0], found.best_costs[first.num_asks :])


# --- tasks ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["rope_folding", "cloth_side_folding"])
def test_optimize_costs_plans_of_a_task_as_a_planner_does(name):
    task = dataclasses.replace(make_task(name, 9), num_actions=1, action_seconds=0.05)
    probe = Probe(num_asks=1, num_plans=4, wants="cost")
    planner = Planner(task, evaluator=MassSprings(), layout=Layout(2, 1))
    problem = make_problem(task, np.array([0, 8]))

    def costs_of(episode):
        found = optimize(dataclasses.replace(problem, episode=episode), probe, jax.random.key(0))
        return (
            found.traces[0]["costs"][0],
            found.traces[0]["choice"][0],
            found.traces[0]["direction"][0],
        )

    episodes = [task.episode_fn(seed) for seed in range(2)]
    stacked = jax.tree.map(
        lambda *leaves: jnp.stack([jnp.asarray(leaf, float) for leaf in leaves]), *episodes
    )
    together = jax.jit(jax.vmap(costs_of))(stacked)
    alone = jax.jit(costs_of)
    for index, episode in enumerate(episodes):
        costs, choice, direction = alone(jax.tree.map(lambda leaf, i=index: leaf[i], stacked))
        pick = jnp.array([0, 8, NONE])[choice]
        limits = jnp.broadcast_to(jnp.asarray(task.limits, float), direction.shape)
        # float32, other machine code: 1e-7 a step, over some tens of steps of a damped body.
        wanted = planner.costs(episode, Actions(pick, direction * limits))
        np.testing.assert_allclose(costs, wanted, rtol=1e-5)
        np.testing.assert_allclose(together[0][index], costs, rtol=1e-5)
        assert np.ptp(costs) > 1e-3 * np.max(costs)  # it matters what is grasped


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize(
    ("costs", "message"),
    [
        (np.ones((2, 1)), r"costs of shape \(2, 1\); return shape \(2,\), for 2 plans"),
        (1.0, r"costs of shape \(\); return shape \(2,\)"),
        (np.array([1j, 2.0]), "costs of evaluate is an array of complex128; give an array"),
    ],
)
def test_costs_from_outside_are_one_for_each_plan(costs, message):
    space, key = make_problem(make_task("rope_folding", 5), [0]).space, jax.random.key(0)
    search = partial(search_on_host, RandomShooting(1, 2), space, key)
    with pytest.raises(ValueError, match=message):
        search(lambda *_: Told(costs))
    with pytest.raises(ValueError, match=r"evaluate returns a list; return Told\(costs\)"):
        search(lambda *_: [1.0, 2.0])
    assert float(search(lambda *_: Told(np.array([3, 2]))).cost) == 2.0
    wrong = Told(np.ones(1), np.zeros((1, 3)))
    with pytest.raises(ValueError, match=r"gradients of shape \(1, 3\); return shape \(1, \d+, 2"):
        search_on_host(Descent(num_asks=1), space, key, lambda *_: wrong)
