"""Plans: the same every time, costed and scored as an independent rollout says, saved whole."""

import dataclasses
import os
import subprocess
import sys
from functools import lru_cache
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from jaxsimp.dynamics import NONE, Actions, at_rest, make_pickers, rollout, settle
from jaxsimp.engines import MassSprings
from jaxsimp.planning import ENCODINGS, CEMConfig, Layout, Plan, Planner, load_plan, save_plan
from jaxsimp.planning import plan as plan_module
from jaxsimp.tasks import make_task, score

CONFIG = CEMConfig(num_iterations=2, population=6, initial_populations=1)
CANDIDATES = np.array([0, 4, 8])
LAYOUT = Layout(chunk_size=1, num_workers=2)


@lru_cache(None)
def small_task():
    """A short rope whose actions take few time steps: plans take milliseconds."""
    task = make_task("rope_folding", 9)
    return dataclasses.replace(task, num_actions=2, action_seconds=0.05, settle_actions=2)


@lru_cache(None)
def planner(layout: Layout = LAYOUT, returns: str = "best") -> Planner:
    # Its pickers are too fast for self-contact.
    config = dataclasses.replace(CONFIG, returns=returns)
    return Planner(small_task(), config, layout, judge=MassSprings())


def planned(seed: int = 3, encoding: str = "categorical", *args, **kwargs) -> Plan:
    task = small_task()
    return planner(*args, **kwargs).plan(
        task.episode_fn(seed), CANDIDATES, ENCODINGS[encoding], seed
    )


def assert_same(first: Plan, second: Plan) -> None:
    np.testing.assert_array_equal(first.actions.pick, second.actions.pick)
    np.testing.assert_array_equal(first.actions.displacement, second.actions.displacement)
    assert dataclasses.astuple(first.search)[1:] == dataclasses.astuple(second.search)[1:]


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
    anew = Planner(small_task(), CONFIG, LAYOUT, judge=MassSprings())
    task = small_task()
    assert_same(anew.plan(task.episode_fn(3), CANDIDATES, ENCODINGS["categorical"], 3), planned(3))


IN_A_PROCESS = """
import dataclasses, sys
import jax
import numpy as np
from jaxsimp.planning import ENCODINGS, CEMConfig, Layout, MassSprings, Planner
from jaxsimp.tasks import make_task
path, population, num_devices, layout = sys.argv[1], *map(int, sys.argv[2:4]), sys.argv[4:]
jax.config.update("jax_num_cpu_devices", num_devices)
task = dataclasses.replace(
    make_task("rope_folding", 9),
    num_actions=2, action_seconds=0.05, settle_actions=2,
)
config = CEMConfig(num_iterations=2, population=population, initial_populations=1)
layout = Layout(*map(int, layout)) if layout else None
planner = Planner(task, config, layout, judge=MassSprings())
assert jax.local_device_count() == num_devices
assert planner.layout.num_workers >= num_devices
episode = task.episode_fn(3)
plan = planner.plan(episode, np.array([0, 4, 8]), ENCODINGS["categorical"], 3)
np.savez(
    path,
    pick=plan.actions.pick,
    displacement=plan.actions.displacement,
    costs=plan.search.best_costs,
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
    plan = planned(3)
    execution = planner().execute(small_task().episode_fn(3), plan.actions)
    np.testing.assert_array_equal(other["pick"], plan.actions.pick)
    np.testing.assert_array_equal(other["displacement"], plan.actions.displacement)
    np.testing.assert_array_equal(other["costs"], plan.search.best_costs)
    np.testing.assert_array_equal(other["positions"], execution.positions)


def test_any_number_of_devices_finds_the_same_plan_bit_for_bit(tmp_path):
    # By the default layout: each has a share of 64 plans, which 3 devices cannot share evenly.
    one = in_another_process(tmp_path / "one.npz", 64, 1)
    more = in_another_process(tmp_path / "more.npz", 64, 3)
    for name, array in one.items():
        np.testing.assert_array_equal(more[name], array)


@pytest.mark.parametrize("layout", [Layout(3, 1), Layout(2, 3)], ids=str)
def test_layouts_agree_on_the_costs(layout):
    # Other machine code rounds differently. Over 130 time steps of a damped rope a rounding of
    # 1e-7 m grows at most some hundredfold, so costs of a sum of three distances of 0.1 m
    # agree to 1e-4; the two plans are of the same draws as long as no two costs are closer.
    first, second = planned(3).search, planned(3, "categorical", layout).search
    np.testing.assert_allclose(second.best_costs, first.best_costs, rtol=1e-4)
    np.testing.assert_allclose(second.elite_costs, first.elite_costs, rtol=1e-4)


def test_the_number_of_workers_changes_nothing():
    # Three workers of two samples run the loop that one worker of six runs, a sample at a time;
    # the length of a loop does not change the code inside it.
    assert_same(planned(3, "categorical", Layout(1, 1)), planned(3, "categorical", Layout(1, 3)))


# --- costs and scores ----------------------------------------------------------------------------


@pytest.mark.parametrize("returns", ["best", "mean"])
def test_the_cost_of_a_plan_is_that_of_an_independent_rollout(returns):
    plan = planned(3, "categorical", LAYOUT, returns)
    task, episode = small_task(), small_task().episode_fn(3)
    frames = independent_frames(plan.actions)
    steps = [float(task.terminal_cost(episode, at_rest(frame))) for frame in frames[1:-1]]
    assert len(steps) == 3  # two actions, and the state that is left
    # rounding of other machine code, see test_layouts_agree_on_the_costs
    assert plan.search.cost == pytest.approx(sum(steps), rel=1e-4)


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
    assert plan.search.num_rollouts == 12
    assert plan.seconds > 0


def test_doing_nothing_scores_nothing():
    idle = Actions(jnp.full((2, 2), NONE), jnp.zeros((2, 2, 3)))
    execution = planner().execute(small_task().episode_fn(0), idle)
    # A straight rope at rest stays: rounding of 0.3 m only.
    assert execution.score == pytest.approx(0.0, abs=1e-5)


def test_plans_do_not_compile_again():
    # Another seed, and as many candidates: nothing is traced anew.
    planned(3)
    traces = []

    def counted(*arguments):
        traces.append(None)
        return original(*arguments)

    original, plan_module._plan_cost = plan_module._plan_cost, counted
    try:
        fresh = Planner(small_task(), CONFIG, LAYOUT, judge=MassSprings())
        compiled = len(traces)
        for seed in (1, 2):
            fresh.plan(
                small_task().episode_fn(seed), CANDIDATES + 0, ENCODINGS["categorical"], seed
            )
        fresh.estimate_seconds()
    finally:
        plan_module._plan_cost = original
    assert compiled > 0
    assert len(traces) == compiled


def test_float64_plans(x64):
    task = dataclasses.replace(
        make_task("rope_folding", 5),
        num_actions=1,
        action_seconds=0.02,
        settle_actions=1,
    )
    config = CEMConfig(num_iterations=1, population=2, initial_populations=1)
    made = Planner(task, config, Layout(1, 1), judge=MassSprings())
    plan = made.plan(task.episode_fn(0), np.array([0]), ENCODINGS["categorical"], 0)
    assert plan.actions.displacement.dtype == np.float64
    assert made.execute(task.episode_fn(0), plan.actions).positions.dtype == np.float64


# --- saved plans ---------------------------------------------------------------------------------


def test_a_loaded_plan_replays_bit_for_bit(tmp_path):
    plan, episode = planned(3), small_task().episode_fn(3)
    execution = planner().execute(episode, plan.actions)
    save_plan(tmp_path / "plan.npz", plan.actions, execution.positions)
    assert [path.name for path in tmp_path.iterdir()] == ["plan.npz"]
    actions, arrays = load_plan(tmp_path / "plan.npz")
    np.testing.assert_array_equal(actions.pick, plan.actions.pick)
    np.testing.assert_array_equal(actions.displacement, plan.actions.displacement)
    assert actions.displacement.dtype == plan.actions.displacement.dtype
    np.testing.assert_array_equal(arrays["positions"], execution.positions)
    replay = planner().execute(episode, actions)
    np.testing.assert_array_equal(replay.positions, arrays["positions"])
    assert replay.score == execution.score


def some_plan() -> tuple[Actions, np.ndarray]:
    actions = Actions(jnp.zeros((2, 2), dtype=int), jnp.zeros((2, 2, 3)))
    return actions, np.zeros((4, 9, 3), np.float32)


def test_a_save_that_fails_leaves_the_old_plan(tmp_path, monkeypatch):
    path = tmp_path / "plan.npz"
    save_plan(path, *some_plan())
    before = path.read_bytes()

    def full(file, **arrays):
        file.write(b"half of a pl")
        raise OSError("no space left on device")

    monkeypatch.setattr(np, "savez_compressed", full)
    for name in ("plan.npz", "new.npz"):
        with pytest.raises(OSError, match="no space"):
            save_plan(tmp_path / name, *some_plan())
    assert path.read_bytes() == before
    assert not (tmp_path / "new.npz").exists()


def broken_files() -> dict[str, bytes]:
    import io

    other, single = io.BytesIO(), io.BytesIO()
    np.savez(other, pick=np.zeros((1, 2), int))
    np.save(single, np.zeros(3))
    return {
        "garbage": b"not a plan at all",
        "nothing": b"",
        "another archive": other.getvalue(),
        "one array": single.getvalue(),
    }


@pytest.mark.parametrize("content", broken_files().values(), ids=broken_files())
def test_a_file_that_is_no_plan_is_refused_by_name(tmp_path, content):
    path = tmp_path / "plan.npz"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"plan\.npz .*not a saved plan"):
        load_plan(path)


@pytest.mark.parametrize("share", [0.3, 0.9])
def test_a_plan_cut_short_is_refused_by_name(tmp_path, share):
    path = tmp_path / "plan.npz"
    save_plan(path, *some_plan())
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(ValueError, match=r"plan\.npz .*not a saved plan"):
        load_plan(path)


def test_a_plan_that_is_not_there(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"plan\.npz"):
        load_plan(tmp_path / "plan.npz")
