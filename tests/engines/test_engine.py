"""The seam between planner and physics: an engine that is no physics at all, in closed form."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from jaxsimp import goals
from jaxsimp.dynamics import NONE, Actions, State, at_rest
from jaxsimp.engines import MassSprings
from jaxsimp.planning import ENCODINGS, CEMConfig, Layout, Planner
from jaxsimp.tasks import make_task

CONFIG = CEMConfig(num_iterations=8, population=32, initial_populations=2)


@dataclasses.dataclass(frozen=True)
class Gliding:
    """The whole body moves by a share of the mean of all displacements."""

    share: float

    def physics(self, task):
        if task.num_pickers != 2:
            raise ValueError(f"{task.name} has {task.num_pickers} pickers; it takes 2 to glide")
        return {"share": jnp.asarray(self.share, dtype=float)}

    def rollout(self, physics, state, actions, observe):
        moves = physics["share"] * actions.displacement.mean(axis=1)
        moves = jnp.cumsum(moves, axis=0)
        states = [State(state.position + move[None], state.velocity) for move in moves]
        return states[-1], jnp.stack([observe(each) for each in states])


def glided(share: float):
    """A rope that is to be moved 0.1 m along x, and its planner."""
    task = make_task("rope_letter_u", 5)
    shift = np.array([0.1, 0.0, 0.0])
    episode = task.episode_fn(0)
    episode = dataclasses.replace(episode, goal=np.asarray(episode.start) + shift)
    task = dataclasses.replace(task, num_actions=2)
    return episode, Planner(task, CONFIG, Layout(4, 1), Gliding(share))


def test_the_engine_carries_out_the_plan():
    episode, planner = glided(0.5)
    start = np.asarray(episode.start)
    moves = np.array([[0.06, 0.02, 0.0], [0.04, -0.02, 0.0]])
    actions = Actions(jnp.full((2, 2), NONE), jnp.asarray(np.stack([moves] * 2, axis=1)))
    done = planner.execute(episode, actions)
    # Half of each move, then nothing: float32 of 0.3 m.
    expected = start + np.array([[[0.0] * 3], [[0.03, 0.01, 0.0]], [[0.05, 0.0, 0.0]]])
    np.testing.assert_allclose(done.positions[:3], expected, atol=1e-7)
    np.testing.assert_allclose(done.positions[3], expected[2], atol=1e-7)
    assert done.score == pytest.approx(0.5, abs=1e-5)  # half the way


def test_a_plan_is_executed_by_the_judge():
    episode, planner = glided(1.0)
    judged = Planner(planner.task, CONFIG, Layout(4, 1), Gliding(1.0), judge=Gliding(0.5))
    moves = jnp.full((2, 2, 3), jnp.array([0.05, 0.0, 0.0]))
    actions = Actions(jnp.full((2, 2), NONE), moves)
    assert planner.execute(episode, actions).score == pytest.approx(1.0, abs=1e-5)
    assert judged.execute(episode, actions).score == pytest.approx(0.5, abs=1e-5)
    batch = Actions(actions.pick[None], actions.displacement[None])
    np.testing.assert_array_equal(judged.costs(episode, batch), planner.costs(episode, batch))


@pytest.mark.slow
def test_a_plan_is_executed_with_self_contact_unless_told_otherwise():
    task = make_task("cloth_side_folding", 9)
    # By default.
    planner = Planner(task, CEMConfig(num_iterations=1, population=8))
    # One side laid on the other, its corners well inside: laid on an edge, corners of a cloth as
    # coarse as this one (cells of 38 mm, layers of 4 mm) slip past it.
    moves = np.array([[[0.0, 0.12, 0.1]] * 2, [[0.0, 0.12, -0.1]] * 2])
    carried = Actions(jnp.array([[0, 72]] * 2), jnp.asarray(moves, dtype=float))
    episode = task.episode_fn(0)
    episode = dataclasses.replace(episode, start=goals.flat(task.body))
    done = planner.execute(episode, carried)
    assert isinstance(done.missed, int)
    assert np.isfinite(done.positions).all()
    without = Planner(task, CEMConfig(num_iterations=1, population=8), judge=MassSprings())
    plain = without.execute(episode, carried)
    assert plain.missed is None
    # Without it the corners come to lie on the table, with it on what lies there.
    above = [each.positions[-1][[0, 72], 2] - task.body.radius for each in (plain, done)]
    assert np.abs(above[0]).max() < 1e-4
    assert above[1].min() > 0.8 * 2 * task.body.radius


def test_a_plan_is_searched_with_the_engine():
    episode, planner = glided(1.0)
    plan = planner.plan(episode, np.array([0, 4]), ENCODINGS["categorical"], 0)
    done = planner.execute(episode, plan.actions)
    # In our dynamics a plan that need not grasp anything could not come near.
    assert done.score > 0.7
    costs = [np.linalg.norm(done.positions[t] - episode.goal, axis=1).mean() for t in (1, 2, 3)]
    assert plan.search.cost == pytest.approx(sum(costs), rel=1e-5)  # rounding


def test_an_engine_that_refuses_the_task_is_heard():
    task = dataclasses.replace(make_task("rope_letter_u", 5), num_pickers=1)
    with pytest.raises(ValueError, match="rope_letter_u has 1 pickers; it takes 2"):
        Planner(task, CONFIG, engine=Gliding(1.0))


@pytest.mark.parametrize("engine", [MassSprings(), Gliding(0.5)], ids=["springs", "gliding"])
def test_a_rollout_observes_the_state_after_each_action_and_goes_on_from_any(engine):
    """What the planner asks of whatever is an engine."""
    task = dataclasses.replace(make_task("rope_letter_u", 5), action_seconds=0.05)
    physics = engine.physics(task)
    pick = jnp.array([[0, NONE], [4, 0], [NONE, NONE]])
    moves = jnp.linspace(-0.05, 0.1, 18).reshape(3, 2, 3)
    first, rest = (Actions(pick[part], moves[part]) for part in (slice(0, 1), slice(1, None)))
    start = at_rest(task.episode_fn(0).start)

    def observe(state):
        return {"tip": state.position[0], "height": state.position[:, 2].mean()}

    final, seen = engine.rollout(physics, start, Actions(pick, moves), observe)
    assert seen["tip"].shape == (3, 3)
    assert seen["height"].shape == (3,)
    between, before = engine.rollout(physics, start, first, observe)
    after, later = engine.rollout(physics, between, rest, observe)
    assert np.abs(after.position - start.position).max() > 0.01
    # The same steps in loops of other lengths, in float32, of 0.3 m.
    np.testing.assert_allclose(final.position, after.position, atol=1e-6)
    for name in ("tip", "height"):
        joined = np.concatenate([before[name], later[name]])
        np.testing.assert_allclose(seen[name], joined, atol=1e-6)
        np.testing.assert_allclose(seen[name][-1], observe(final)[name], atol=1e-6)
