"""Plans: the same every time, costed and scored as an independent rollout says."""

import dataclasses
import os
import subprocess
import sys
from functools import lru_cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsimp.dynamics import NONE, Actions, at_rest, make_pickers, rollout, settle
from jaxsimp.engines import Layout, MassSprings, MuJoCo, make_ensemble
from jaxsimp.planning import (
    CEM,
    ENCODINGS,
    Descent,
    Plan,
    Planner,
    Reranking,
    Sequence,
    default_algorithm,
    host,
    make_problem,
    optimize,
    price,
    problem,
)
from jaxsimp.records import load_plan, save_plan
from jaxsimp.tasks import Episode, make_task, score

ALGORITHM = CEM(num_iterations=2, population=6, initial_populations=1)
SEQUENCE = Sequence((ALGORITHM, Descent(num_asks=2, num_starts=2), Reranking(num_starts=2)))
CANDIDATES = np.array([0, 4, 8])
LAYOUT = Layout(chunk_size=1, num_workers=2)


@lru_cache(None)
def small_task():
    """A short rope whose actions take few time steps: plans take milliseconds."""
    task = make_task("rope_folding", 9)
    return dataclasses.replace(task, num_actions=2, action_seconds=0.05, settle_actions=2)


@lru_cache(None)
def planner(layout: Layout = LAYOUT) -> Planner:
    # Its pickers are too fast for self-contact.
    return Planner(small_task(), evaluator=MassSprings(), layout=layout)


def planned(
    seed: int = 3, encoding: str = "categorical", layout: Layout = LAYOUT, returns: str = "best"
) -> Plan:
    algorithm = dataclasses.replace(ALGORITHM, returns=returns, encoding=ENCODINGS[encoding])
    return planner(layout).plan(small_task().episode_fn(seed), CANDIDATES, algorithm, seed)


def assert_same(first: Plan, second: Plan) -> None:
    np.testing.assert_array_equal(first.actions.pick, second.actions.pick)
    np.testing.assert_array_equal(first.actions.displacement, second.actions.displacement)
    for pair in zip(jax.tree.leaves(first.optimum), jax.tree.leaves(second.optimum), strict=True):
        np.testing.assert_array_equal(*pair)
    assert (first.num_rollouts, first.price) == (second.num_rollouts, second.price)


def independent_frames(actions: Actions) -> list[np.ndarray]:
    """Positions at the start, after each action and released: an action at a time."""
    task = small_task()
    simulation = task.simulation()
    pickers = make_pickers(task.limits, steps=task.action_steps)
    state = at_rest(task.episode_fn(0).start)
    frames = [state.position]
    for t in range(task.num_actions):
        one = Actions(
            jnp.asarray(actions.pick)[t : t + 1], jnp.asarray(actions.displacement)[t : t + 1]
        )
        state, _ = rollout(simulation, pickers, state, one)
        frames.append(state.position)
    frames.append(settle(simulation, state, task.action_steps).position)
    frames.append(settle(simulation, state, 2 * task.action_steps).position)
    return frames


# --- the same plan every time --------------------------------------------------------------------


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_the_same_seed_gives_the_same_plan_bit_for_bit(encoding):
    first = planned(3, encoding)
    assert_same(first, planned(3, encoding))
    other = planned(4, encoding)
    assert np.any(other.actions.displacement != first.actions.displacement)


def test_a_planner_made_anew_gives_the_same_plan():
    anew = Planner(small_task(), evaluator=MassSprings(), layout=LAYOUT)
    task = small_task()
    assert_same(anew.plan(task.episode_fn(3), CANDIDATES, ALGORITHM, 3), planned(3))


IN_A_PROCESS = """
import dataclasses, sys
import jax
import numpy as np
from jaxsimp.engines import Layout, MassSprings
from jaxsimp.planning import CEM, Planner
from jaxsimp.tasks import make_task
path, population, num_devices, layout = sys.argv[1], *map(int, sys.argv[2:4]), sys.argv[4:]
jax.config.update("jax_num_cpu_devices", num_devices)
task = dataclasses.replace(
    make_task("rope_folding", 9),
    num_actions=2, action_seconds=0.05, settle_actions=2,
)
algorithm = CEM(num_iterations=2, population=population, initial_populations=1)
layout = Layout(*map(int, layout)) if layout else None
planner = Planner(task, evaluator=MassSprings(), layout=layout)
assert jax.local_device_count() == num_devices
assert planner.layout_of(algorithm).num_workers >= num_devices
episode = task.episode_fn(3)
plan = planner.plan(episode, np.array([0, 4, 8]), algorithm, 3)
np.savez(
    path,
    pick=plan.actions.pick,
    displacement=plan.actions.displacement,
    costs=plan.optimum.best_costs,
    positions=planner.execute(episode, plan.actions).positions,
)
"""


def in_another_process(path: Path, *arguments: int) -> dict[str, np.ndarray]:
    root = Path(__file__).parents[2]
    command = [sys.executable, "-c", IN_A_PROCESS, path, *map(str, arguments)]
    # It compiles for itself: that gives the same code, too.
    environment = os.environ | {"JAX_ENABLE_COMPILATION_CACHE": "false"}
    subprocess.run(command, check=True, cwd=root, env=environment)
    with np.load(path) as found:
        return dict(found)


def test_another_process_finds_the_same_plan_bit_for_bit(tmp_path):
    other = in_another_process(tmp_path / "other.npz", 6, 1, 1, 2)
    assert_found(other, planner(), planned(3))


def assert_found(other: dict[str, np.ndarray], planner: Planner, plan: Plan) -> None:
    execution = planner.execute(small_task().episode_fn(3), plan.actions)
    np.testing.assert_array_equal(other["pick"], plan.actions.pick)
    np.testing.assert_array_equal(other["displacement"], plan.actions.displacement)
    np.testing.assert_array_equal(other["costs"], plan.optimum.best_costs)
    np.testing.assert_array_equal(other["positions"], execution.positions)


def test_any_number_of_devices_finds_the_same_plan_bit_for_bit(tmp_path):
    # By the default layout: each has a share of 64 plans, which 3 devices cannot share evenly.
    more = in_another_process(tmp_path / "more.npz", 64, 3)
    assert jax.local_device_count() == 1
    one = Planner(small_task(), evaluator=MassSprings())
    algorithm = dataclasses.replace(ALGORITHM, population=64)
    plan = one.plan(small_task().episode_fn(3), CANDIDATES, algorithm, 3)
    assert_found(more, one, plan)


@pytest.mark.parametrize("layout", [Layout(3, 1), Layout(2, 3)], ids=str)
def test_layouts_agree_on_the_costs(layout):
    # Other machine code rounds differently. Over 130 time steps of a damped rope a rounding of
    # 1e-7 m grows at most some hundredfold, so costs of a sum of three distances of 0.1 m
    # agree to 1e-4; the two plans are of the same draws as long as no two costs are closer.
    first, second = planned(3).optimum, planned(3, "categorical", layout).optimum
    np.testing.assert_allclose(second.best_costs, first.best_costs, rtol=1e-4)
    (one,), (other,) = first.traces, second.traces
    np.testing.assert_allclose(other["elite_costs"], one["elite_costs"], rtol=1e-4)


def test_the_number_of_workers_changes_nothing():
    # Three workers of two samples run the loop that one worker of six runs, a sample at a time;
    # the length of a loop does not change the code inside it.
    assert_same(planned(3, "categorical", Layout(1, 1)), planned(3, "categorical", Layout(1, 3)))


def test_plans_side_by_side_are_those_alone_bit_for_bit():
    # Starts and goals differ, as do the numbers of candidates; one question of SEQUENCE fills a
    # part of a call alone, and several together a whole one.
    task, made = small_task(), planner(Layout(chunk_size=2, num_workers=2))
    starts = [task.episode_fn(0).start + np.array([0.0, 0.01 * i, 0.0]) for i in range(3)]
    episodes = [Episode(each, task.goal) for each in starts]
    candidates = [CANDIDATES, CANDIDATES[:2], CANDIDATES[1:]]
    for algorithm in (SEQUENCE, dataclasses.replace(ALGORITHM, wants="screened")):
        together = made.plan_batch(episodes, candidates, algorithm, [5, 6, 7])
        for index, plan in enumerate(together):
            alone = made.plan(episodes[index], candidates[index], algorithm, 5 + index)
            assert_same(plan, alone)
    assert np.any(together[0].optimum.best_costs != together[2].optimum.best_costs)


def test_as_many_of_each_are_planned_side_by_side():
    episode = small_task().episode_fn(0)
    for counts in ((0, 0), (2, 1), (1, 2)):
        with pytest.raises(ValueError, match=r"there are .* give as many of each, at least one"):
            planner().plan_batch([episode] * counts[0], [CANDIDATES] * counts[1], ALGORITHM)
    with pytest.raises(
        ValueError, match=r"1 sets of candidates, 2 seeds and 1 initial plans; give as many"
    ):
        planner().plan_batch([episode], [CANDIDATES], ALGORITHM, [0, 1])


# --- costs and scores ----------------------------------------------------------------------------


@pytest.mark.parametrize("returns", ["best", "mean"])
def test_the_cost_of_a_plan_is_that_of_an_independent_rollout(returns):
    plan = planned(3, "categorical", LAYOUT, returns)
    task, episode = small_task(), small_task().episode_fn(3)
    frames = independent_frames(plan.actions)
    steps = [float(task.terminal_cost(episode, at_rest(frame))) for frame in frames[1:-1]]
    assert len(steps) == 3  # two actions, and the state that is left
    steps[:2] = [task.running_weight * step for step in steps[:2]]
    # rounding of other machine code, see test_layouts_agree_on_the_costs
    assert plan.optimum.cost == pytest.approx(sum(steps), rel=1e-4)
    assert plan.num_rollouts == plan.price == 12 + (returns == "mean")


def test_an_execution_is_that_of_an_independent_rollout():
    plan = planned(3)
    task, episode = small_task(), small_task().episode_fn(3)
    execution = planner().execute(episode, plan.actions)
    frames = independent_frames(plan.actions)
    expected = np.stack([*frames[:-2], frames[-1]])
    assert execution.positions.shape == (task.num_actions + 2, 9, 3)
    # metres; rounding as above
    np.testing.assert_allclose(execution.positions, expected, atol=1e-5)
    last = jnp.asarray(execution.positions[-1])
    # the same formula, compiled with other code around it
    assert execution.score == pytest.approx(float(score(task, episode, last)), abs=1e-6)


def test_a_plan_is_made_of_candidates_within_the_limits():
    plan = planned(3)
    assert plan.actions.pick.shape == (2, 2)
    assert set(np.asarray(plan.actions.pick).ravel().tolist()) <= {*CANDIDATES.tolist(), NONE}
    assert np.all(np.abs(plan.actions.displacement) <= np.float32(0.15))
    assert plan.num_rollouts == 12
    assert plan.seconds > 0


def test_doing_nothing_scores_nothing():
    idle = Actions(jnp.full((2, 2), NONE), jnp.zeros((2, 2, 3)))
    execution = planner().execute(small_task().episode_fn(0), idle)
    # A straight rope at rest stays: rounding of 0.3 m only.
    assert execution.score == pytest.approx(0.0, abs=1e-5)


def test_plans_do_not_compile_again(monkeypatch):
    # Another seed, and as many candidates: nothing is traced anew.
    traces, original = [], problem.plan_cost

    def counted(*arguments):
        traces.append(None)
        return original(*arguments)

    monkeypatch.setattr(problem, "plan_cost", counted)
    fresh = Planner(small_task(), evaluator=MassSprings(), layout=LAYOUT)
    fresh.plan(small_task().episode_fn(0), CANDIDATES, ALGORITHM)
    compiled, exchanges = len(traces), host._compile.cache_info().misses
    for seed in (1, 2):
        fresh.plan(small_task().episode_fn(seed), CANDIDATES // seed, ALGORITHM, seed)
    fresh.estimate_seconds(ALGORITHM)
    assert compiled > 0
    assert len(traces) == compiled
    assert host._compile.cache_info().misses == exchanges


def test_what_a_sequence_costs_adds_up_and_is_compiled_once(monkeypatch):
    made, episode = planner(), small_task().episode_fn(3)
    plan = made.plan(episode, CANDIDATES, SEQUENCE, 3)
    # Six plans twice; two descend twice; two settle; and the cost of the one that is returned.
    assert plan.num_rollouts == 12 + 4 + 2 + 1
    assert plan.price == 12 + 6 * 4 + 4 * 2 + 1 == price(SEQUENCE) + 1
    assert len(plan.optimum.best_costs) == 2 + 2 + 1
    one = jax.tree.map(lambda leaf: leaf[None], plan.actions)
    # The same plan in the same machine code.
    assert plan.optimum.cost == made.costs(episode, one)[0]
    exchanges = host._compile.cache_info().misses
    monkeypatch.setattr(problem, "plan_cost", None)  # what is traced fails
    monkeypatch.setattr(problem, "settled_cost", None)
    assert_same(made.plan(episode, CANDIDATES, SEQUENCE, 3), plan)
    assert host._compile.cache_info().misses == exchanges


def test_an_evaluators_physics_needs_an_evaluator():
    alone = make_problem(small_task(), CANDIDATES)
    for algorithm in (Reranking(2), dataclasses.replace(ALGORITHM, wants="screened")):
        with pytest.raises(ValueError, match=r"problem has no evaluator; give `make_problem` one"):
            optimize(alone, algorithm, jax.random.key(0))


def test_screened_costs_are_those_of_the_evaluator_and_are_counted(monkeypatch):
    # Pure `optimize` gives the same; where all plans are looked at again the engine has no say.
    task, episode = small_task(), small_task().episode_fn(3)
    algorithm = dataclasses.replace(ALGORITHM, wants="screened", population=8)
    ensemble = make_ensemble(task, 2)
    made = Planner(task, evaluator=ensemble, layout=LAYOUT)
    plan = made.plan(episode, CANDIDATES, algorithm, 3)
    assert (plan.num_rollouts, plan.price) == (2 * (8 + 2), 2 * 16)
    wanted = Planner(task, ensemble, layout=LAYOUT).costs(
        episode, jax.tree.map(lambda leaf: leaf[None], plan.actions)
    )
    assert plan.optimum.cost == pytest.approx(wanted[0], rel=1e-4)  # see the layouts above
    pure = optimize(
        make_problem(task, CANDIDATES, episode, evaluator=ensemble), algorithm, jax.random.key(3)
    )
    np.testing.assert_allclose(pure.best_costs, plan.optimum.best_costs, rtol=1e-4)


@pytest.mark.parametrize(
    ("name", "price_at_most"), [("rope_folding", 2560), ("cloth_side_folding", 1920)]
)
def test_the_default_search_keeps_to_its_price(name, price_at_most):
    task = make_task(name, 5)
    whole = default_algorithm(task)
    assert 0.95 * price_at_most < price(whole) < price_at_most
    assert [type(each) for each in whole.algorithms] == [CEM, Descent, Reranking]
    assert default_algorithm(task, reranks=False).algorithms == whole.algorithms[:2]


def test_a_planner_searches_by_default_with_what_its_evaluator_allows(monkeypatch):
    monkeypatch.setattr(
        "jaxsimp.planning.planner.default_algorithm",
        lambda task, reranks: SEQUENCE if reranks else Sequence(SEQUENCE.algorithms[:2]),
    )
    episode = small_task().episode_fn(3)
    assert_same(
        planner().plan(episode, CANDIDATES, seed=3),
        planner().plan(episode, CANDIDATES, SEQUENCE, 3),
    )
    made = Planner(small_task(), evaluator=MuJoCo(), layout=LAYOUT)
    assert made.plan(episode, CANDIDATES, seed=3).price == 12 + 6 * 4


def test_float64_plans(x64):
    task = dataclasses.replace(
        make_task("rope_folding", 5),
        num_actions=1,
        action_seconds=0.02,
        settle_actions=1,
    )
    algorithm = CEM(num_iterations=1, population=2, initial_populations=1)
    made = Planner(task, evaluator=MassSprings(), layout=Layout(1, 1))
    plan = made.plan(task.episode_fn(0), np.array([0]), algorithm, 0)
    assert plan.actions.displacement.dtype == np.float64
    assert made.execute(task.episode_fn(0), plan.actions).positions.dtype == np.float64


def test_a_loaded_plan_replays_bit_for_bit(tmp_path):
    plan, episode = planned(3), small_task().episode_fn(3)
    execution = planner().execute(episode, plan.actions)
    path = tmp_path / "plan.npz"
    save_plan(path, small_task(), episode, plan.actions, execution, engine=planner().evaluator)
    saved = load_plan(path)
    assert saved.actions.displacement.dtype == plan.actions.displacement.dtype
    replay = planner().execute(saved.episode, saved.actions)
    np.testing.assert_array_equal(replay.positions, saved.positions)
    assert replay.score == execution.score


# --- whatever was planned before -----------------------------------------------------------------


@pytest.mark.parametrize("first", [3, 64])
def test_a_plan_does_not_depend_on_what_was_planned_before(first):
    task = dataclasses.replace(
        make_task("cloth_side_folding", 5), num_actions=1, action_seconds=0.1, settle_actions=1
    )
    episode, candidates = task.episode_fn(0), np.array([0, 4, 20, 24])

    def with_population(size: int) -> CEM:
        return CEM(2, size, initial_populations=1, keep_best=False, returns="mean")

    used, wanted = Planner(task), Planner(task)
    used.plan(episode, candidates, with_population(first))
    found = used.plan(episode, candidates, with_population(12)).optimum
    alone = wanted.plan(episode, candidates, with_population(12)).optimum
    np.testing.assert_array_equal(found.best_costs, alone.best_costs)
    assert found.cost == alone.cost
    assert set(used._evaluations.sizes("cost")) == {
        first,
        12,
    }  # none was padded to the size of another, nor compiled for one plan


def test_a_plan_of_another_length_is_refused():
    task = dataclasses.replace(make_task("rope_folding", 5), num_actions=2)
    plan = Actions(jnp.zeros((3, 2), int), jnp.zeros((3, 2, 3)))
    with pytest.raises(ValueError, match=r"has \(3, 2\) actions and pickers.*takes \(2, 2\); give"):
        Planner(task).execute(task.episode_fn(0), plan)


@pytest.mark.usefixtures("unchecked_shapes")
def test_what_is_not_of_the_task_is_refused_at_the_door():
    task = dataclasses.replace(make_task("rope_folding", 5), num_actions=1)
    made, episode = Planner(task), task.episode_fn(0)
    far = Actions(np.array([[[0, 5]]]), np.zeros((1, 1, 2, 3)))
    with pytest.raises(ValueError, match=r"pick\[0, 0, 1\] is 5; a body of 5 particles"):
        made.costs(episode, far)
    with pytest.raises(ValueError, match=r"pick\[0, 1\] is 5; a body of 5 particles"):
        made.execute(episode, jax.tree.map(lambda leaf: leaf[0], far))
    with pytest.raises(ValueError, match=r"give shapes \(B, T, G\) and \(B, T, G, 3\)"):
        made.costs(episode, jax.tree.map(lambda leaf: leaf[0], far))
    with pytest.raises(ValueError, match="there are no plans; give at least one"):
        made.costs(episode, Actions(np.zeros((0, 1, 2), int), np.zeros((0, 1, 2, 3))))
    with pytest.raises(ValueError, match=r"has \(2, 2\) actions and pickers.*takes \(1, 2\)"):
        made.costs(episode, Actions(np.zeros((1, 2, 2), int), np.zeros((1, 2, 2, 3))))
    idle = Actions(np.full((1, 2), NONE), np.zeros((1, 2, 3)))
    start = np.array(episode.start)
    start[3, 1] = np.nan
    for wrong, message in (
        (Episode(start, episode.goal), r"episode.start\[3, 1\] is nan; give numbers"),
        (Episode(episode.start, start[:4]), r"goal of the episode has shape \(4, 3\).*\(5, 3\)"),
        (episode.start, r"the episode is a ndarray; give Episode\(start, goal\)"),
    ):
        with pytest.raises(ValueError, match=message):
            made.plan(wrong, [0])
        with pytest.raises(ValueError, match=message):
            made.costs(wrong, jax.tree.map(lambda leaf: leaf[None], idle))
        with pytest.raises(ValueError, match=message):
            made.execute(wrong, idle)
        with pytest.raises(ValueError, match=message):
            make_problem(task, [0], wrong)
    for seed in (-1, 0.5, 2**32, True):
        with pytest.raises(ValueError, match=f"seed is {seed}; give a whole number from 0 to"):
            made.plan(episode, [0], seed=seed)


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"engine": "mjx"}, "engine is 'mjx'; give an engine"),
        ({"engine": MassSprings}, "engine is <class .*; give an engine"),
        ({"evaluator": 3}, "evaluator is 3; give an engine"),
        ({"layout": 8}, r"layout is 8; give Layout\("),
    ],
)
def test_what_is_no_engine_or_layout_is_refused(given, message):
    with pytest.raises(ValueError, match=message):
        Planner(make_task("rope_folding", 5), **given)


def test_a_callback_that_raises_leaves_the_planner_as_it_was():
    def stop():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        planner().plan(small_task().episode_fn(3), np.array([0, 4]), CEM(2, 8), 3, stop)
    again = planner().plan(small_task().episode_fn(3), np.array([0, 4]), CEM(2, 8), 3)
    alone = Planner(small_task()).plan(small_task().episode_fn(3), np.array([0, 4]), CEM(2, 8), 3)
    np.testing.assert_array_equal(again.optimum.best_costs, alone.optimum.best_costs)
