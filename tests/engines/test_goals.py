"""What goals score."""

import dataclasses

import numpy as np
import pytest

from jaxsimp.engines import MassSprings, goal_scores
from jaxsimp.tasks import Episode, make_task, score


def test_a_goal_at_rest_scores_the_same_let_go_and_a_lifted_one_falls():
    task = dataclasses.replace(
        make_task("rope_letter_u", 9), settle_actions=2, action_seconds=0.2, num_pickers=1
    )
    episode = task.episode_fn(0)
    # A straight goal is at rest; the costs are 0.
    straight = Episode(episode.start + np.array([0.0, 0.1, 0.0]), episode.start)
    found = goal_scores(task, straight, MassSprings())
    assert found.laid == 1.0
    assert found.settled == pytest.approx(1.0, abs=1e-4)
    # One that is 5 cm up falls by its height, in a quarter of the time.
    lifted = Episode(straight.start, straight.goal + np.array([0.0, 0.0, 0.05]))
    found = goal_scores(task, lifted, MassSprings())
    assert found.laid == 1.0
    fallen = float(score(task, lifted, straight.goal))
    assert found.settled == pytest.approx(fallen, abs=1e-3)


def test_layers_of_a_fold_cost_their_distance():
    task = dataclasses.replace(make_task("cloth_side_folding", 5), settle_actions=0)
    episode = task.episode_fn(0)
    found = goal_scores(task, episode)
    assert found.laid == found.settled == float(score(task, episode, np.asarray(episode.goal)))
    assert 0.9 < found.laid < 1.0


@pytest.mark.usefixtures("unchecked_shapes")
def test_an_episode_of_another_body_is_refused():
    with pytest.raises(ValueError, match=r"start of the episode has shape \(4, 3\)"):
        goal_scores(make_task("rope_letter_u", 9), Episode(np.zeros((4, 3)), np.zeros((9, 3))))
