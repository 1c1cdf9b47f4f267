"""Tasks refuse, when they are made, what cannot be planned for."""

import numpy as np
import pytest

from jaxsimp.tasks import Task, make_task


def test_a_goal_that_does_not_fit_is_refused():
    task = make_task("rope_folding", 9)
    with pytest.raises(ValueError, match=r"goal of particle 0 is .* give finite coordinates"):
        Task(
            name="broken",
            body=task.body,
            goal=np.full((9, 3), np.nan),
            episode_fn=task.episode_fn,
            running_cost=task.running_cost,
            terminal_cost=task.terminal_cost,
            limits=task.limits,
        )
