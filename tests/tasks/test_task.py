"""Tasks: what they refuse when they are made; pickling."""

import copy
import dataclasses
import pickle
import re
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsimp.dynamics import NONE, Actions, Sphere, Table, at_rest, table_with_edge
from jaxsimp.tasks import Episode, Task, make_task, task_names

# --- pickling -------------------------------------------------------------------------------------

IN_ANOTHER_PROCESS = """
import pickle, runpy, sys
import jax
import numpy as np

jax.config.update("jax_platforms", "cpu")
numbers = runpy.run_path(sys.argv[1])["numbers"]
with open(sys.argv[2], "rb") as file:
    for _ in range(int(sys.argv[3])):
        task, expected = pickle.load(file)
        for array, other in zip(numbers(task), expected, strict=True):
            np.testing.assert_array_equal(array, other, task.name)
"""

NO_DEVICE = """
import jax
from jaxsimp.tasks import make_task, task_names

jax.config.update("jax_platforms", "cpu")
for name in task_names():
    make_task(name, 5)
jax.config.update("jax_num_cpu_devices", 3)  # refused once there are devices
assert jax.local_device_count() == 3
"""


def numbers(task: Task) -> list[np.ndarray]:
    """Start, goal, both costs of the start moved at random, and what a key draws."""
    episode = task.episode_fn(1)
    drawn = () if task.draw_fn is None else jax.tree.leaves(task.draw_episode(jax.random.key(2)))
    moved = episode.start + 0.05 * np.random.default_rng(0).standard_normal(episode.start.shape)
    action = Actions(jnp.full(task.num_pickers, NONE), jnp.zeros((task.num_pickers, 3)))
    state = at_rest(moved)
    costs = task.running_cost(episode, state, action), task.terminal_cost(episode, state)
    return [np.asarray(array) for array in (episode.start, episode.goal, *costs, *drawn)]


# The start of a crumpled rope takes the compilation of a simulation.
NAMES = [
    pytest.param(name, marks=pytest.mark.slow) if name == "rope_straightening" else name
    for name in task_names()
]


def pickled(name: str) -> tuple[Task, list[np.ndarray], bytes]:
    task = make_task(name, 5)
    expected = numbers(task)
    return task, expected, pickle.dumps((task, expected))


@pytest.mark.parametrize("name", NAMES)
def test_a_pickled_task_has_the_same_start_goal_and_costs(name):
    task, expected, data = pickled(name)
    found, _ = pickle.loads(data)
    assert (found.name, found.limits, found.time_step) == (task.name, task.limits, task.time_step)
    for array, other in zip(numbers(found), expected, strict=True):
        np.testing.assert_array_equal(array, other)


def test_copies_of_a_task_are_tasks():
    task = make_task("rope_folding", 5)
    for made in (copy.copy(task), copy.deepcopy(task)):
        assert (made.name, made.resolution) == ("rope_folding", 5)
        for array, other in zip(numbers(made), numbers(task), strict=True):
            np.testing.assert_array_equal(array, other)


# One of each kind of start and of cost.
@pytest.mark.parametrize(
    "names",
    [
        ("rope_folding", "cloth_side_folding", "t_shirt_sleeves_in"),
        pytest.param(("rope_straightening",), marks=pytest.mark.slow),
    ],
)
def test_another_process_finds_the_same_in_a_pickled_task(names, tmp_path):
    path = tmp_path / "tasks.pickle"
    path.write_bytes(b"".join(pickled(name)[2] for name in names))
    command = [sys.executable, "-c", IN_ANOTHER_PROCESS, __file__, path, str(len(names))]
    subprocess.run(command, check=True, cwd=Path(__file__).parents[2])


# --- refusals -------------------------------------------------------------------------------------


def changed(**fields) -> Task:
    """A task of a rope of 9 particles and 2 pickers, made again with other fields."""
    return dataclasses.replace(make_task("rope_letter_m", 9), **fields)


def test_a_goal_that_does_not_fit_is_refused():
    with pytest.raises(ValueError, match=r"goal of particle 0 is .* give finite coordinates"):
        changed(goal=np.full((9, 3), np.nan))


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize(
    ("field", "value", "remedy"),
    [
        *(("num_actions", value, "from 1 to 10000") for value in (0, -1, 2.5, True, np.nan)),
        *(("num_pickers", value, "from 1 to 1000") for value in (0, 1.0, "2")),
        *(("settle_actions", value, "from 0 to 10000") for value in (-2, 0.5)),
        *(("action_seconds", value, "0.0001 to 10000 s") for value in (0.0, -1, np.nan, np.inf)),
        *(("running_weight", value, "from 0 to 1e") for value in (-0.1, np.nan, "1", 1e9)),
        *(("longest_time_step", value, "1e-06 to 1 s") for value in (0, np.inf, "1", 1j)),
        *(("limits", value, "three displacements in metres") for value in ((0.1, 0.1), 0.1)),
    ],
)
def test_numbers_out_of_range_are_refused_by_name(field, value, remedy):
    told = re.escape(repr(value))
    with pytest.raises(ValueError, match=f"^{field} is {told}; give .*{re.escape(remedy)}"):
        changed(**{field: value})


@pytest.mark.parametrize("value", [(0.1, 0.0, 0.1), (0.1, np.nan, 0.1), (0.1, np.inf, 0.1)])
def test_a_limit_out_of_range_is_refused_by_its_axis(value):
    told = rf"^limits\[1\] is {value[1]:g}; give numbers from 1e-06 to 1000 m"
    with pytest.raises(ValueError, match=told):
        changed(limits=value)


def test_an_action_shorter_than_a_time_step_is_refused():
    task = changed(action_seconds=5e-4, longest_time_step=2e-3)
    with pytest.raises(ValueError, match=r"action_seconds is 0\.0005, less than half .*longer"):
        task.pickers()


@pytest.mark.usefixtures("unchecked_shapes")
def test_numbers_at_the_end_of_their_range_are_accepted():
    task = changed(num_actions=np.int64(1), num_pickers=1, settle_actions=0, action_seconds=1)
    assert task.num_actions == 1


def of_each_particle(episode, state, action=None):
    return jnp.linalg.norm(state.position - jnp.asarray(episode.goal), axis=1)


def in_numpy(episode, state, action=None):
    return np.linalg.norm(np.asarray(state.position)).mean()


def with_a_branch(episode, state, action=None):
    return state.position[0, 2] if state.position[0, 2] > 0 else jnp.float32(0)


def counted(episode, state, action=None):
    return (state.position[:, 2] > 0.1).sum()


def in_a_pair(episode, state, action=None):
    return state.position.mean(), state.velocity.mean()


def of_ten_particles(episode, state, action=None):
    return (state.position - jnp.zeros((10, 3))).mean()


def of_positions(position):
    return position.mean()


@pytest.mark.parametrize("field", ["running_cost", "terminal_cost"])
@pytest.mark.parametrize(
    ("cost", "said"),
    [
        (of_each_particle, r"an array of shape \(9,\); return a scalar"),
        (in_numpy, r"values of arrays.*TracerArrayConversionError.*with jax.numpy"),
        (with_a_branch, r"values of arrays.*TracerBoolConversionError.*jnp.where instead of if"),
        (counted, r"a scalar of type int32; return a float"),
        (in_a_pair, r"returns a tuple; return one float"),
        (of_ten_particles, r"fails with TypeError.*positions of shape \(N, 3\)"),
        (of_positions, r"\(episode, state.*too many positional arguments; give a function of"),
    ],
)
def test_a_cost_that_cannot_be_planned_with_is_refused_in_one_sentence(field, cost, said):
    with pytest.raises(ValueError, match=f"^{field} .*{said}") as refusal:
        changed(**{field: cost})
    assert "\n" not in str(refusal.value)


def test_a_cost_that_keeps_what_it_sees_is_refused():
    seen = []

    def kept(episode, state, action=None):
        seen.append(state.position.mean())
        return seen[-1]

    with pytest.raises(ValueError, match=r"^running_cost keeps an array .* return all that counts"):
        changed(running_cost=kept)
    seen.clear()


def test_a_running_cost_without_the_action_is_refused_and_a_terminal_cost_is_not():
    def of_state(episode, state):
        return state.position.mean()

    with pytest.raises(ValueError, match=r"running_cost\(episode, state, action\)"):
        changed(running_cost=of_state)
    assert changed(terminal_cost=of_state).terminal_cost is of_state


def test_a_running_cost_sees_an_action_of_all_pickers():
    seen = []

    def effort(episode, state, action):
        seen.append((action.pick.shape, action.displacement.shape))
        return jnp.square(action.displacement).sum()

    changed(running_cost=effort, num_pickers=3)
    assert seen == [((3,), (3, 3))]


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize(
    ("draw_fn", "said"),
    [
        (
            lambda key: key,
            r"returns no Episode; return an Episode of .*shape \(9, 3\)",
        ),
        (
            lambda key: Episode(jnp.zeros((9, 3)), jnp.zeros((8, 3))),
            r"returns arrays of shapes .*\(8, 3\).*shape \(9, 3\) each",
        ),
        (
            lambda key: Episode(*np.random.default_rng(int(key)).uniform(size=(2, 9, 3))),
            r"asks for the values of arrays",
        ),
        (lambda: None, r"fails with TypeError: .*; let it take a key"),
    ],
)
def test_what_draws_no_episode_by_a_key_is_refused(draw_fn, said):
    with pytest.raises(ValueError, match=f"^draw_fn {said}"):
        changed(draw_fn=draw_fn)


def test_costs_are_traced_and_nothing_is_computed():
    # What is computed needs a device, and a process that has one cannot choose its number any more.
    subprocess.run([sys.executable, "-c", NO_DEVICE], check=True, cwd=Path(__file__).parents[2])


# --- obstacles -----------------------------------------------------------------------------------


def test_a_task_refuses_an_obstacle_that_is_too_small_for_its_body():
    task = make_task("rope_folding", 9)
    with pytest.raises(ValueError, match=r"Sphere: radius is 0.001 m; .* of this rope leave gaps"):
        dataclasses.replace(task, obstacles=(Sphere((0.0, 0.0, 0.0), 0.001),))


def test_the_simulation_of_a_task_has_its_obstacles():
    task = make_task("rope_folding", 9)
    assert task.simulation().obstacles == (Table(),)
    ball = Sphere((0.1, 0.2, 0.3), 0.5)
    (found,) = dataclasses.replace(task, obstacles=(ball,)).simulation().obstacles
    np.testing.assert_array_equal(found.center, np.float32(ball.center))
    assert float(found.radius) == 0.5


def test_a_goal_below_the_edge_of_a_table_is_a_goal():
    task = make_task("rope_folding", 9)
    below = np.asarray(task.goal) - np.array([0.0, 0.0, 0.3])
    dataclasses.replace(task, goal=below, obstacles=(table_with_edge(-1.0),))
    with pytest.raises(ValueError, match="under the table"):
        dataclasses.replace(task, goal=below)


@pytest.mark.usefixtures("unchecked_shapes")
def test_numbers_in_another_form_are_kept_as_plain_ones():
    given = {"limits": np.array([0.1, 0.2, 0.3]), "num_actions": np.int64(3)}
    task = changed(action_seconds=jnp.asarray(0.5), **given)
    assert task.limits == (0.1, 0.2, 0.3)
    assert type(task.num_actions) is int
    assert type(task.action_seconds) is float
    with pytest.raises(ValueError, match="name is 3; give a text"):
        changed(name=3)
