"""Ensembles: members as wanted, and costs that are those of rollouts in each member alone."""

import dataclasses
from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsimp.dynamics import (
    NONE,
    Actions,
    Capsule,
    Table,
    at_rest,
    largest_time_step,
    make_pickers,
    make_simulation,
    rollout,
)
from jaxsimp.engines import Ensemble, Layout, MassSprings, Spread, make_ensemble
from jaxsimp.engines.ensemble import QUANTITIES, draw_factors
from jaxsimp.planning import CEM, Planner
from jaxsimp.tasks import Task, make_task

ALGORITHM = CEM(num_iterations=2, population=6, initial_populations=1)
LAYOUT = Layout(chunk_size=3, num_workers=2)
NO_SPREAD = Spread(**dict.fromkeys(QUANTITIES, 1.0))
"""Every member is the body itself."""


@lru_cache(None)
def small_task() -> Task:
    """A short rope whose actions take few time steps: plans take milliseconds."""
    task = make_task("rope_letter_u", 9)
    return dataclasses.replace(task, num_actions=2, action_seconds=0.05, settle_actions=2)


@lru_cache(None)
def ensemble() -> Ensemble:
    return make_ensemble(small_task(), size=3, seed=1, spread=Spread(stiffness=2.5))


@lru_cache(None)
def robust_planner() -> Planner:
    return planner_in(ensemble())


def planner_in(engine: Ensemble | MassSprings | None = None) -> Planner:
    return Planner(small_task(), engine, MassSprings(), LAYOUT)


jit_rollout = jax.jit(rollout)


def plans(seed: int = 0) -> Actions:
    """Plans that drag ends of the rope over the table and lift them, and one that does nothing."""
    rng = np.random.default_rng(seed)
    pick = jnp.asarray(rng.choice([0, 4, 8, NONE], (6, 2, 2))).at[5].set(NONE)
    return Actions(pick, jnp.asarray(rng.uniform(-0.1, 0.15, (6, 2, 2, 3)), dtype=float))


def costs_alone(task: Task, members: Ensemble, index: int) -> np.ndarray:
    """Costs of `plans()` in one member: by rollouts of a body made from its factors."""
    factors = dict(zip(QUANTITIES, members.factors[index].tolist(), strict=True))
    time_step = float(members.simulations.time_step[0]) * factors.pop("time_step")
    simulation = make_simulation(task.body.scaled(**factors), time_step)
    pickers, episode = make_pickers(task.limits, steps=members.action_steps), task.episode_fn(0)
    found = []
    for pick, displacement in zip(plans().pick, plans().displacement, strict=True):
        actions = Actions(
            jnp.concatenate([pick, jnp.full((1, 2), NONE)]),
            jnp.concatenate([displacement, jnp.zeros((1, 2, 3))]),
        )
        _, frames = jit_rollout(simulation, pickers, at_rest(episode.start), actions)
        *running, last = (float(task.terminal_cost(episode, at_rest(frame))) for frame in frames)
        found.append(task.running_weight * sum(running) + last)
    return np.array(found)


# --- costs ---------------------------------------------------------------------------------------


def test_an_ensemble_of_the_body_itself_plans_bit_for_bit_as_without():
    task = small_task()
    episode, candidates = task.episode_fn(0), np.array([0, 4, 8])
    nominal, one = planner_in(), planner_in(make_ensemble(task, size=1))
    np.testing.assert_array_equal(one.costs(episode, plans()), nominal.costs(episode, plans()))
    found, wanted = (made.plan(episode, candidates, ALGORITHM, 3) for made in (one, nominal))
    np.testing.assert_array_equal(found.actions.pick, wanted.actions.pick)
    np.testing.assert_array_equal(found.actions.displacement, wanted.actions.displacement)
    for pair in zip(jax.tree.leaves(found.optimum), jax.tree.leaves(wanted.optimum), strict=True):
        np.testing.assert_array_equal(*pair)
    assert (found.num_rollouts, found.price) == (wanted.num_rollouts, wanted.price)


def test_members_touch_themselves_where_asked_to():
    task = dataclasses.replace(make_task("rope_folding", 9), num_actions=2)
    episode, pick, move = task.episode_fn(0), np.full((6, 2, 2), NONE), np.zeros((6, 2, 2, 3))
    pick[:, :, 0] = 0  # One end is carried over, and laid on the rope.
    move[:, :, 0] = [[0.14, 0.0, 0.08], [0.14, 0.0, -0.08]]
    move[:, 1, 0, 0] -= np.linspace(0.0, 0.1, 6)
    folds = Actions(jnp.asarray(pick), jnp.asarray(move, dtype=float))

    def costs(engine) -> np.ndarray:
        return Planner(task, engine, MassSprings(), LAYOUT).costs(episode, folds)

    touching, passing = (make_ensemble(task, 1, self_contact=touches) for touches in (True, False))
    found = costs(touching)
    # A batch of one, compiled otherwise, in float32.
    np.testing.assert_allclose(found, costs(MassSprings(self_contact=True)), rtol=3e-6)
    assert (np.abs(costs(passing) - found) > 0.01 * found).any()


def test_costs_are_the_mean_of_those_in_each_member_alone():
    task = small_task()
    episode = task.episode_fn(0)
    each = np.stack([costs_alone(task, ensemble(), e) for e in range(3)], axis=1)
    found = robust_planner().costs(episode, plans())
    # Other machine code rounds by 1e-7 a step; 1e-4 of the cost as in test_plan.py.
    np.testing.assert_allclose(found, each.mean(axis=1), rtol=1e-4)
    # It matters which member it is, by far more than rounding; not to the plan that does nothing.
    assert (np.ptp(each, axis=1)[:5] > 1e-2 * each.mean(axis=1)[:5]).all()
    np.testing.assert_allclose(each[5], each[5, 0], rtol=1e-4)


def test_a_robust_plan_is_the_same_every_time_and_lowers_the_robust_cost():
    task = small_task()
    episode, candidates = task.episode_fn(0), np.array([0, 4, 8])
    first, again = (robust_planner().plan(episode, candidates, ALGORITHM, 3) for _ in range(2))
    np.testing.assert_array_equal(first.actions.displacement, again.actions.displacement)
    np.testing.assert_array_equal(first.optimum.best_costs, again.optimum.best_costs)
    one = jax.tree.map(lambda leaf: leaf[None], first.actions)
    # The cost that the search reports is that of its plan, in the same machine code.
    assert first.optimum.cost == robust_planner().costs(episode, one)[0]


COSTS = np.array([[1.0, 3.0, 2.0], [2.0, 2.0, 2.0]])


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize(
    ("statistic", "caution", "wanted"),
    [
        ("mean", 0.0, [2.0, 2.0]),
        # The population's deviation of 1, 2, 3 is the root of 2 / 3.
        ("mean", 1.5, [2.0 + 1.5 * np.sqrt(2 / 3), 2.0]),
        ("worst", 0.0, [3.0, 2.0]),
    ],
)
def test_statistics_of_costs(statistic, caution, wanted):
    made = dataclasses.replace(ensemble(), statistic=statistic, caution=caution)
    found = [float(made.risk(jnp.asarray(costs))) for costs in COSTS]
    np.testing.assert_allclose(found, wanted, rtol=1e-15)


@pytest.mark.parametrize("statistic", ["mean", "worst"])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_plan_that_fails_in_one_member_ranks_last(statistic, bad):
    costs = COSTS.copy()
    costs[1, 2] = bad
    made = dataclasses.replace(ensemble(), statistic=statistic)
    found = [float(made.risk(jnp.asarray(each, dtype=float))) for each in costs]
    assert np.isfinite(found[0])
    assert found[1] == np.inf


def test_a_member_that_is_not_finite_is_counted():
    # All rollouts of one member fail: no plan is found.
    made = ensemble()
    mass = made.simulations.mass.at[1].set(jnp.nan)
    broken = dataclasses.replace(made, simulations=dataclasses.replace(made.simulations, mass=mass))
    task = small_task()
    plan = planner_in(broken).plan(task.episode_fn(0), np.array([0, 8]), ALGORITHM, 0)
    assert plan.optimum.cost == np.inf
    assert plan.optimum.failed == 12  # two rounds of six plans


def test_an_ensemble_of_another_body_is_refused():
    longer = make_task("rope_letter_u", 11)
    with pytest.raises(ValueError, match=r"of 9 particles and rope_letter_u has 11; make one of"):
        Planner(longer, ensemble())


@pytest.mark.parametrize(("statistic", "caution"), [("worst", 0.0), ("mean", 1.5)])
def test_costs_are_the_risk_of_those_in_each_member_alone(statistic, caution):
    each = np.stack([costs_alone(small_task(), ensemble(), e) for e in range(3)], axis=1)
    made = dataclasses.replace(ensemble(), statistic=statistic, caution=caution)
    found = planner_in(made).costs(small_task().episode_fn(0), plans())
    wanted = each.max(axis=1) if statistic == "worst" else each.mean(1) + 1.5 * each.std(1)
    np.testing.assert_allclose(found, wanted, rtol=1e-4)  # as above


def test_a_plan_is_executed_in_the_first_member():
    task, episode = small_task(), small_task().episode_fn(0)
    one = jax.tree.map(lambda leaf: leaf[0], plans())
    done = ensemble().executor(task)(episode, one)
    factors = dict.fromkeys(QUANTITIES[:-1], 1.0)
    simulation = make_simulation(
        task.body.scaled(**factors), float(ensemble().simulations.time_step[0])
    )
    pickers = make_pickers(task.limits, steps=ensemble().action_steps)
    _, frames = jit_rollout(simulation, pickers, at_rest(episode.start), one)
    # metres; float32, other machine code
    np.testing.assert_allclose(done.positions[1:3], frames, atol=1e-5)
    # Not as in the second member, by far more than rounding.
    second = jax.tree.map(lambda leaf: leaf[1], ensemble().simulations)
    _, others = jit_rollout(second, pickers, at_rest(episode.start), one)
    assert np.abs(done.positions[1:3] - others).max() > 1e-3


# --- members -------------------------------------------------------------------------------------


def test_every_member_has_the_obstacles_of_the_task():
    bar = Capsule((0.0, -0.2, 0.1), (0.0, 0.2, 0.1), 0.08)
    task = dataclasses.replace(small_task(), obstacles=(bar, Table()))
    members = make_ensemble(task, 3).simulations
    found, table = members.obstacles
    np.testing.assert_array_equal(found.radius, np.float32([0.08] * 3))
    np.testing.assert_array_equal(found.end, np.float32([bar.end] * 3))
    assert isinstance(table, Table)


def test_the_first_member_is_the_body_itself():
    task, first = small_task(), jax.tree.map(lambda leaf: leaf[0], ensemble().simulations)
    wanted = dataclasses.replace(task.simulation(), time_step=first.time_step)
    for found, leaf in zip(jax.tree.leaves(first), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_array_equal(found, leaf)
    assert float(first.time_step) <= np.float32(task.time_step)
    # Actions keep their duration, to half a time step.
    duration = ensemble().action_steps * float(first.time_step)
    assert duration == pytest.approx(task.action_seconds, abs=0.51 * float(first.time_step))


def test_members_have_the_physics_that_their_factors_say():
    made, body = ensemble(), small_task().body
    first, rest = made.simulations, made.factors
    assert len(made) == 3
    simulated = {
        "stiffness": first.springs.stiffness.max(axis=(1, 2)),
        "damping": first.springs.damping.max(axis=(1, 2)),
        "drag": first.drag,
        "friction": first.friction,
        "mass": first.mass[:, 0],
        "time_step": first.time_step,
    }
    for column, name in enumerate(QUANTITIES):
        values = np.asarray(simulated[name])
        # One rounding to float32.
        np.testing.assert_allclose(values / values[0], rest[:, column], rtol=1e-6)
        assert len(set(values.tolist())) == 3, name  # all members differ
    np.testing.assert_array_equal(first.rest, np.stack([np.float32(body.rest)] * 3))


def test_every_member_is_stable():
    task, made = small_task(), make_ensemble(small_task(), 7, 4, Spread(stiffness=2.5))
    for row, time_step in zip(made.factors, made.simulations.time_step, strict=True):
        factors = dict(zip(QUANTITIES[:-1], row[:-1].tolist(), strict=True))
        largest = largest_time_step(task.body.scaled(**factors))
        assert float(time_step) <= 0.9 * largest * (1 + 1e-6)  # rounded to float32


def test_factors_fill_the_spread_evenly():
    spread = Spread(stiffness=4.0, mass=1.0)
    factors = draw_factors(9, 5, spread)
    np.testing.assert_array_equal(factors[0], 1.0)
    np.testing.assert_array_equal(factors[:, QUANTITIES.index("mass")], 1.0)
    for column, name in enumerate(QUANTITIES):
        largest = np.log(getattr(spread, name))
        if largest:
            # One in each eighth of the logarithm.
            part = np.floor(4 * (np.log(factors[1:, column]) / largest + 1))
            assert sorted(part.tolist()) == list(range(8)), name
    np.testing.assert_array_equal(factors, draw_factors(9, 5, spread))
    assert np.any(factors != draw_factors(9, 6, spread))


def test_no_spread_makes_equal_members():
    made = make_ensemble(small_task(), 3, spread=NO_SPREAD)
    for leaf in jax.tree.leaves(made.simulations):
        np.testing.assert_array_equal(leaf, np.stack([leaf[0]] * 3))
    assert made.action_steps == small_task().action_steps


# --- refusals ------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", QUANTITIES)
@pytest.mark.parametrize("factor", [-2.0, 0.0, 0.99, np.inf, np.nan])
def test_a_spread_below_one_is_refused(name, factor):
    with pytest.raises(ValueError, match=f"^{name} is {factor}; give a number from 1 to"):
        Spread(**{name: factor})


def test_a_spread_that_is_stable_at_tiny_time_steps_only_is_refused():
    with pytest.raises(ValueError, match=r"stable up to .* smaller spread of stiffness"):
        make_ensemble(small_task(), 5, spread=Spread(stiffness=1e4))


def test_what_no_ensemble_can_have_is_refused():
    with pytest.raises(ValueError, match="size is 0; give a whole number from 1"):
        make_ensemble(small_task(), 0)
    with pytest.raises(ValueError, match="caution is -1"):
        make_ensemble(small_task(), 2, caution=-1.0)
    with pytest.raises(ValueError, match="caution is nan"):
        make_ensemble(small_task(), 2, caution=float("nan"))
    with pytest.raises(ValueError, match="goes with the mean"):
        make_ensemble(small_task(), 2, statistic="worst", caution=1.0)


@pytest.mark.usefixtures("unchecked_shapes")
def test_an_unknown_statistic_is_refused():
    with pytest.raises(ValueError, match="statistic is 'median'; choose from mean, worst"):
        make_ensemble(small_task(), 2, statistic="median")


@pytest.mark.usefixtures("unchecked_shapes")
def test_a_spread_and_self_contact_are_of_their_types():
    for spread in (0.5, jnp.asarray(0.5), {}, np.ones(2)):
        with pytest.raises(ValueError, match=r"spread is .*; give Spread\(\.\.\.\), of factors"):
            make_ensemble(small_task(), spread=spread)
    with pytest.raises(ValueError, match="self_contact is 'yes'; give True or False"):
        MassSprings(self_contact="yes")
