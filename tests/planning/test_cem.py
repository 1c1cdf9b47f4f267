"""The cross-entropy method: on costs whose best plan is known, with failures, and its settings."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsimp.dynamics import NONE, Actions
from jaxsimp.planning import CEM, ENCODINGS, ActionSpace, Optimum, Told, price, search_on_host

LIMITS = np.array([0.1, 0.2, 0.05])
CANDIDATES = np.array([3, 11, 42, 7])
WANTED_PICK = np.array([[11, NONE], [42, 3]])
WANTED_MOVE = np.array([[0.5, -0.3, 0.2], [-0.6, 0.1, 0.7]])[:, None] * LIMITS
encodings = pytest.mark.parametrize("encoding", ENCODINGS.values(), ids=ENCODINGS)
categorical = ENCODINGS["categorical"]


def space() -> ActionSpace:
    return ActionSpace(
        jnp.asarray(CANDIDATES), jnp.asarray(LIMITS, dtype=float), num_actions=2, num_pickers=2
    )


def sphere(actions: Actions) -> np.ndarray:
    """Least, 0, for the wanted picks and displacements: squares of what each is off."""
    off = (np.asarray(actions.displacement) - WANTED_MOVE) / LIMITS
    wrong = np.asarray(actions.pick) != WANTED_PICK
    return (off**2).sum(axis=(1, 2, 3)) + wrong.sum(axis=(1, 2))


DEFAULTS = {"num_iterations": 6, "population": 24, "initial_populations": 1}


def found_by(cost_fn, encoding=categorical, key=0, on_ask=lambda: None, **settings) -> Optimum:
    algorithm = CEM(encoding=encoding, **DEFAULTS | settings)

    def evaluate(wants: str, actions: Actions) -> Told:
        assert wants == "cost"
        return Told(jnp.asarray(cost_fn(actions), dtype=float))

    return search_on_host(algorithm, space(), jax.random.key(key), evaluate, on_ask)


def elite_costs_of(found: Optimum) -> list[float]:
    """Mean cost of the elites after each question."""
    (trace,) = found.traces
    return np.asarray(trace["elite_costs"]).mean(axis=1).tolist()


def recorded(cost_fn, batches):
    """The cost function, keeping every batch that it is asked about; costs as JAX sees them."""

    def record(actions: Actions) -> np.ndarray:
        costs = np.asarray(cost_fn(actions), np.float32)
        batches.append((np.asarray(actions.pick), np.asarray(actions.displacement), costs))
        return costs

    return record


# --- finding the best plan ------------------------------------------------------------------------


@pytest.mark.parametrize("returns", ["best", "mean"])
@encodings
def test_the_best_plan_is_found(encoding, returns):
    found = found_by(sphere, encoding, num_iterations=40, population=400, returns=returns)
    np.testing.assert_array_equal(found.actions.pick, WANTED_PICK)
    # The spread shrinks by more than a tenth a round (0.2 kept of it, of 40 elites some
    # 60 % of the deviation): after 40 rounds it is under 1 % of the limits.
    off = (np.asarray(found.actions.displacement) - WANTED_MOVE) / LIMITS
    assert np.abs(off).max() < 0.02
    assert found.cost == pytest.approx(float(sphere(batch_of(found.actions))[0]), rel=1e-6)


def batch_of(actions: Actions) -> Actions:
    return jax.tree.map(lambda array: array[None], actions)


@encodings
def test_the_best_plan_drawn_is_returned(encoding):
    batches = []
    found = found_by(recorded(sphere, batches), encoding)
    costs = np.stack([costs for _, _, costs in batches])
    assert costs.shape == (6, 24)
    assert price(CEM(**DEFAULTS)) == costs.size
    assert found.failed == 0
    assert found.cost == costs.min()
    np.testing.assert_array_equal(found.best_costs, np.minimum.accumulate(costs.min(axis=1)))
    round_, index = np.unravel_index(costs.argmin(), costs.shape)
    np.testing.assert_array_equal(found.actions.pick, batches[round_][0][index])
    np.testing.assert_array_equal(found.actions.displacement, batches[round_][1][index])


def test_the_mean_is_returned_and_evaluated_once_more():
    batches = []
    found = found_by(recorded(sphere, batches), returns="mean")
    assert [len(costs) for _, _, costs in batches] == [24] * 6 + [1]
    np.testing.assert_array_equal(found.actions.displacement, batches[-1][1][0])
    assert found.cost == batches[-1][2][0]
    assert all(found.cost != costs.min() for _, _, costs in batches[:-1])


def test_the_mean_is_that_of_the_elites_of_the_last_round():
    # Without smoothing and without the best of earlier rounds, in NumPy.
    batches = []
    found = found_by(
        recorded(sphere, batches),
        returns="mean",
        smoothing=0.0,
        keep_best=False,
        elite_fraction=0.25,
    )
    pick, move, costs = batches[-2]
    elites = np.argsort(costs)[:6]
    expected = move[elites].mean(axis=0)
    # float32 means of 6 numbers of up to 0.2
    np.testing.assert_allclose(found.actions.displacement, expected, atol=1e-7)
    choices = [*CANDIDATES, NONE]
    counted = (pick[elites, ..., None] == choices).sum(axis=0)
    for counts, picked in zip(counted.reshape(4, 5), found.actions.pick.ravel(), strict=True):
        assert counts[choices.index(picked)] == counts.max()


@pytest.mark.parametrize("keep_best", [True, False])
def test_elites_of_each_round(keep_best):
    batches = []
    found = found_by(recorded(sphere, batches), keep_best=keep_best, elite_fraction=0.125)
    best = np.inf
    for (_, _, costs), elite_cost in zip(batches, elite_costs_of(found), strict=True):
        pool = np.append(costs, best) if keep_best and np.isfinite(best) else costs
        assert elite_cost == pytest.approx(np.sort(pool)[:3].mean(), rel=1e-6)  # order of a sum
        best = min(best, costs.min())


def test_a_kept_best_plan_stays_an_elite_when_all_later_ones_are_worse():
    calls = []

    def only_first(actions: Actions) -> np.ndarray:
        calls.append(None)
        return np.arange(24.0) + 100 * (len(calls) > 1)

    kept = found_by(only_first, elite_fraction=1 / 12)
    assert elite_costs_of(kept) == [0.5] + [50.0] * 5  # of 0 and 1; then of 0 and 100
    calls.clear()
    forgotten = found_by(only_first, elite_fraction=1 / 12, keep_best=False)
    assert elite_costs_of(forgotten) == [0.5] + [100.5] * 5
    assert forgotten.cost == kept.cost == 0.0  # what is returned does not depend on it
    np.testing.assert_array_equal(forgotten.actions.pick, kept.actions.pick)


@encodings
def test_best_costs_never_rise(encoding):
    rng = np.random.default_rng(0)
    found = found_by(lambda actions: rng.normal(size=24), encoding, num_iterations=10)
    assert len(found.best_costs) == len(elite_costs_of(found)) == 10
    assert np.all(np.diff(found.best_costs) <= 0)


def test_every_population_is_reported():
    ticks = []
    found_by(sphere, on_ask=lambda: ticks.append(None), initial_populations=3)
    assert len(ticks) == 8


@encodings
def test_the_first_round_draws_more_populations_from_one_distribution(encoding):
    batches = []
    found = found_by(recorded(sphere, batches), encoding, initial_populations=3, num_iterations=2)
    costs = np.concatenate([costs for _, _, costs in batches])
    assert len(batches) == 4
    assert len(costs) == 96
    assert not np.array_equal(batches[0][1], batches[1][1])
    # The elites of the first round are those of all 72 plans; 2 are a tenth of 24.
    first = np.sort(costs[:72])[:2]
    assert elite_costs_of(found)[2] == pytest.approx(first.mean(), rel=1e-6)
    np.testing.assert_array_equal(found.best_costs[2:], [costs[:72].min(), costs.min()])


@encodings
def test_the_same_key_finds_the_same_plan_bit_for_bit(encoding):
    first, again, other = (found_by(sphere, encoding, key=key) for key in (5, 5, 6))
    np.testing.assert_array_equal(first.actions.pick, again.actions.pick)
    np.testing.assert_array_equal(first.actions.displacement, again.actions.displacement)
    np.testing.assert_array_equal(first.best_costs, again.best_costs)
    assert elite_costs_of(first) == elite_costs_of(again)
    assert np.any(first.best_costs != other.best_costs)


# --- rollouts that fail ---------------------------------------------------------------------------


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@encodings
def test_non_finite_costs_rank_last_and_are_counted(encoding, bad):
    # Picker 0 is given particle 11 in the best plan; grasping it ruins a rollout here.
    batches = []

    def cost_fn(actions: Actions) -> np.ndarray:
        ruined = np.asarray(actions.pick)[:, 0, 0] == 11
        return np.where(ruined, bad, sphere(actions))

    found = found_by(recorded(cost_fn, batches), encoding, num_iterations=10)
    costs = np.stack([costs for _, _, costs in batches])
    assert found.failed == np.sum(~np.isfinite(costs)) > 0
    assert found.cost == costs[np.isfinite(costs)].min()
    assert np.all(np.isfinite(elite_costs_of(found)))
    assert found.actions.pick[0, 0] != 11
    # Never an elite, so the categorical draws it ever more rarely: half as often at the least.
    failures = np.sum(~np.isfinite(costs), axis=1)
    if encoding is categorical:
        assert failures[5:].sum() < failures[:5].sum()


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("returns", ["best", "mean"])
@pytest.mark.parametrize("keep_best", [True, False])
def test_a_search_in_which_every_rollout_fails_ends(bad, returns, keep_best):
    found = found_by(
        lambda actions: np.full(len(actions.pick), bad), returns=returns, keep_best=keep_best
    )
    assert found.cost == np.inf
    np.testing.assert_array_equal(found.best_costs, [np.inf] * 6)
    assert found.failed == 6 * 24 + (returns == "mean")  # all that were evaluated
    assert np.all(np.isfinite(found.actions.displacement))
    assert set(found.actions.pick.ravel().tolist()) <= {*CANDIDATES.tolist(), NONE}


def test_a_search_recovers_from_a_first_round_without_a_finite_rollout():
    calls = []

    def cost_fn(actions: Actions) -> np.ndarray:
        calls.append(None)
        return sphere(actions) if len(calls) > 1 else np.full(24, np.nan)

    found = found_by(cost_fn)
    assert found.best_costs[0] == np.inf
    assert np.isfinite(found.best_costs[1:]).all()
    assert found.failed == 24


# --- settings -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("num_iterations", 0),
        ("initial_populations", 0),
        ("population", -5),
        ("elite_fraction", 0.0),
        ("elite_fraction", 1.5),
        ("elite_fraction", float("nan")),
        ("smoothing", -0.1),
        ("smoothing", 1.0),
        ("initial_spread", 0.0),
        ("initial_spread", float("nan")),
        ("initial_spread", float("inf")),
        ("returns", "median"),
        *(("population", value) for value in (2.5, True, "8", 10**9)),
        ("encoding", "joint"),
    ],
)
def test_settings_out_of_range_are_refused(name, value, unchecked_shapes):
    with pytest.raises(ValueError, match=f"^{name} is {re.escape(repr(value))}; (give|choose)"):
        CEM(**{name: value})


@pytest.mark.parametrize(
    ("population", "fraction", "elites"), [(100, 0.1, 10), (8, 0.1, 2), (1, 0.5, 1), (7, 1.0, 7)]
)
def test_number_of_elites(population, fraction, elites):
    assert CEM(population=population, elite_fraction=fraction).num_elites == elites


@encodings
def test_a_population_of_one(encoding):
    batches = []
    found = found_by(recorded(sphere, batches), encoding, population=1, num_iterations=3)
    assert np.isfinite(found.cost)
    assert [len(costs) for _, _, costs in batches] == [1, 1, 1]


@pytest.mark.usefixtures("unchecked_shapes")
def test_settings_in_another_form_are_the_same_key_of_what_is_compiled():
    given = CEM(initial_spread=jnp.asarray(0.5), smoothing=np.array(0.25))
    assert given == CEM(initial_spread=0.5, smoothing=0.25)
    assert hash(given) == hash(CEM(initial_spread=0.5, smoothing=0.25))
    with pytest.raises(ValueError, match=r"keep_best is {}; give True or False"):
        CEM(keep_best={})
