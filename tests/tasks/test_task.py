"""Tasks: what they refuse when they are made; pickling."""

import pickle
import subprocess
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from jaxsimp.dynamics import NONE, Actions, at_rest
from jaxsimp.tasks import Task, make_task, task_names

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


def numbers(task: Task) -> list[np.ndarray]:
    """Start, goal, and both costs of the start moved at random."""
    episode = task.episode_fn(1)
    moved = episode.start + 0.05 * np.random.default_rng(0).standard_normal(episode.start.shape)
    action = Actions(jnp.full(task.num_pickers, NONE), jnp.zeros((task.num_pickers, 3)))
    state = at_rest(moved)
    costs = task.running_cost(episode, state, action), task.terminal_cost(episode, state)
    return [np.asarray(array) for array in (episode.start, episode.goal, *costs)]


def pickled(name: str) -> tuple[Task, list[np.ndarray], bytes]:
    task = make_task(name, 5)
    expected = numbers(task)
    return task, expected, pickle.dumps((task, expected))


@pytest.mark.parametrize("name", task_names())
def test_a_pickled_task_has_the_same_start_goal_and_costs(name):
    task, expected, data = pickled(name)
    copy, _ = pickle.loads(data)
    assert (copy.name, copy.limits, copy.time_step) == (task.name, task.limits, task.time_step)
    for array, other in zip(numbers(copy), expected, strict=True):
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


def test_a_goal_that_does_not_fit_is_refused():
    task = make_task("rope_folding", 9)
    with pytest.raises(ValueError, match=r"goal of particle 0 is .* give finite coordinates"):
        Task(
            body=task.body,
            goal=np.full((9, 3), np.nan),
            episode_fn=task.episode_fn,
            running_cost=task.running_cost,
            terminal_cost=task.terminal_cost,
            limits=task.limits,
        )
