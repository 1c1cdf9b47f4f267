"""A task of one's own, as the package documents it: one file, costs that are plain functions."""

import importlib
import pickle
import textwrap

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsimp import tasks
from jaxsimp.dynamics import Actions, at_rest
from jaxsimp.tasks import make_task, registry, score, task_names


@pytest.fixture
def own_module(monkeypatch, tmp_path):
    """The example of the package's documentation, as a module."""
    source = tasks.__doc__.split("```python\n")[1].split("```")[0]
    (tmp_path / "example_of_a_task.py").write_text(textwrap.dedent(source))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(registry, "_REGISTRY", dict(registry._REGISTRY))
    return importlib.import_module("example_of_a_task")


def test_the_documented_example_is_a_registered_task_that_can_be_pickled(own_module):
    assert "rope_letter_s" in task_names("others")
    task = pickle.loads(pickle.dumps(make_task("rope_letter_s", 9)))
    assert (task.name, task.resolution, task.running_cost.__module__) == (
        "rope_letter_s",
        9,
        "example_of_a_task",
    )
    episode = task.draw_episode(jax.random.key(0))
    np.testing.assert_array_equal(episode.start, task.episode_fn(0).start.astype(np.float32))
    action = Actions(jnp.array([0, 8]), jnp.full((2, 3), -0.1))
    state = at_rest(episode.goal)
    assert float(task.running_cost(episode, state, action)) == pytest.approx(0.01 * 6 * 0.1)
    assert float(score(task, episode, state)) == 1.0
