"""The seam between planner and physics: an engine that is no physics at all, in closed form."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsimp import goals
from jaxsimp.dynamics import NONE, Actions, State, at_rest
from jaxsimp.engines import (
    Execution,
    ExecutionStatus,
    Layout,
    MassSprings,
    MuJoCo,
    replay,
)
from jaxsimp.engines.rollouts import RolloutExecutor
from jaxsimp.planning import CEM, Planner, Reranking, Sequence, action_space, price
from jaxsimp.tasks import Episode, make_task

ALGORITHM = CEM(num_iterations=8, population=32, initial_populations=2)


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

        def act(state, step):
            move, action = step
            state = State(state.position + move[None], state.velocity)
            return state, observe(state, action)

        return jax.lax.scan(act, state, (moves, actions))

    def risk(self, costs):
        return costs

    def chunk_size(self, physics):
        return 4

    def executor(self, task):
        return RolloutExecutor(task, self, self.physics(task))


def glided(share: float):
    """A rope that is to be moved 0.1 m along x, and its planner."""
    task = make_task("rope_letter_u", 5)
    shift = np.array([0.1, 0.0, 0.0])
    episode = task.episode_fn(0)
    episode = dataclasses.replace(episode, goal=np.asarray(episode.start) + shift)
    task = dataclasses.replace(task, num_actions=2)
    return episode, Planner(task, Gliding(share), Gliding(share), Layout(4, 1))


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


def test_a_plan_is_executed_by_the_evaluator():
    episode, planner = glided(1.0)
    evaluated = Planner(planner.task, Gliding(1.0), Gliding(0.5), Layout(4, 1))
    moves = jnp.full((2, 2, 3), jnp.array([0.05, 0.0, 0.0]))
    actions = Actions(jnp.full((2, 2), NONE), moves)
    assert planner.execute(episode, actions).score == pytest.approx(1.0, abs=1e-5)
    assert evaluated.execute(episode, actions).score == pytest.approx(0.5, abs=1e-5)
    batch = Actions(actions.pick[None], actions.displacement[None])
    np.testing.assert_array_equal(evaluated.costs(episode, batch), planner.costs(episode, batch))


@pytest.mark.slow
def test_a_plan_is_executed_with_self_contact_unless_told_otherwise():
    task = make_task("cloth_side_folding", 9)
    # By default.
    planner = Planner(task)
    # One side laid on the other, its corners well inside: laid on an edge, corners of a cloth as
    # coarse as this one (cells of 38 mm, layers of 4 mm) slip past it.
    moves = np.array([[[0.0, 0.12, 0.1]] * 2, [[0.0, 0.12, -0.1]] * 2])
    carried = Actions(jnp.array([[0, 72]] * 2), jnp.asarray(moves, dtype=float))
    episode = task.episode_fn(0)
    episode = dataclasses.replace(episode, start=goals.flat(task.body))
    done = planner.execute(episode, carried)
    assert isinstance(done.missed, int)
    assert np.isfinite(done.positions).all()
    without = Planner(task, evaluator=MassSprings())
    plain = without.execute(episode, carried)
    assert plain.missed == 0
    # Without it the corners come to lie on the table, with it on what lies there.
    above = [each.positions[-1][[0, 72], 2] - task.body.radius for each in (plain, done)]
    assert np.abs(above[0]).max() < 1e-4
    assert above[1].min() > 0.8 * 2 * task.body.radius


def test_a_plan_is_searched_with_the_engine():
    episode, planner = glided(1.0)
    plan = planner.plan(episode, np.array([0, 4]), ALGORITHM, 0)
    done = planner.execute(episode, plan.actions)
    # In our dynamics a plan that need not grasp anything could not come near.
    assert done.score > 0.7
    first, second, left = (
        np.linalg.norm(done.positions[t] - episode.goal, axis=1).mean() for t in (1, 2, 3)
    )
    cost = planner.task.running_weight * (first + second) + left
    assert plan.optimum.cost == pytest.approx(cost, rel=1e-5)  # rounding


def test_an_engine_that_refuses_the_task_is_heard():
    task = dataclasses.replace(make_task("rope_letter_u", 5), num_pickers=1)
    with pytest.raises(ValueError, match="rope_letter_u has 1 pickers; it takes 2"):
        Planner(task, engine=Gliding(1.0))


@pytest.mark.parametrize("engine", [MassSprings(), Gliding(0.5)], ids=["springs", "gliding"])
def test_a_rollout_observes_the_state_after_each_action_and_goes_on_from_any(engine):
    """What the planner asks of whatever is an engine."""
    task = dataclasses.replace(make_task("rope_letter_u", 5), action_seconds=0.05)
    physics = engine.physics(task)
    pick = jnp.array([[0, NONE], [4, 0], [NONE, NONE]])
    moves = jnp.linspace(-0.05, 0.1, 18).reshape(3, 2, 3)
    first, rest = (Actions(pick[part], moves[part]) for part in (slice(0, 1), slice(1, None)))
    start = at_rest(task.episode_fn(0).start)

    def observe(state, action=None):
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


# --- what users write, and what fails ------------------------------------------------------------


class Still:
    """The least engine: nothing moves, and all scores are a half."""

    def executor(self, task):
        def execute(episode, actions):
            frames = [np.asarray(episode.start)] * (len(actions.pick) + 2)
            return Execution(np.stack(frames), 0.5)

        return execute


def test_an_engine_with_an_executor_alone_evaluates_and_does_not_search():
    episode, planner = glided(1.0)
    planner = Planner(planner.task, planner.engine, Still(), planner.layout)
    plan = planner.plan(episode, np.array([0, 4]), ALGORITHM, 0)
    done = planner.execute(episode, plan.actions)
    assert done.score == 0.5
    assert done.status == ExecutionStatus.FINE
    np.testing.assert_array_equal(done.positions, np.stack([episode.start] * 4))
    settled = Sequence((ALGORITHM, Reranking(2)))
    with pytest.raises(
        ValueError, match=r"settled scores or screened costs and the evaluator is .*Still.* give an"
    ):
        planner.plan(episode, np.array([0, 4]), settled, 0)


def test_plans_are_ranked_by_what_the_evaluator_makes_of_them():
    # The engine glides half as far as the evaluator: what costs least goes too far there.
    episode, planner = glided(0.5)
    planner = Planner(planner.task, Gliding(0.5), Gliding(1.0), Layout(4, 1))
    algorithm = Sequence((ALGORITHM, Reranking(8)))
    plan = planner.plan(episode, np.array([0, 4]), algorithm, 0)
    plain = planner.plan(episode, np.array([0, 4]), ALGORITHM, 0)
    scores = [planner.execute(episode, each.actions).score for each in (plan, plain)]
    assert scores[0] >= scores[1]
    # Oracle: each of the eight archived plans, carried out by itself.
    space, archive = action_space(planner.task, np.array([0, 4])), plan.optimum.archive
    each = [jax.tree.map(lambda leaf, i=i: leaf[i], archive.plans) for i in range(8)]
    ranked = [planner.execute(episode, space.actions(one)).score for one in each]
    assert archive.filled.all()
    assert scores[0] == pytest.approx(max(ranked), abs=1e-6)  # float32, other machine code
    assert plan.num_rollouts == plain.num_rollouts + 8 + 1  # and the cost of what is returned
    assert plan.price == price(algorithm) + 1


@pytest.mark.parametrize("self_contact", [False, True])
def test_a_simulation_that_is_not_finite_is_a_status(self_contact):
    task = make_task("rope_folding", 7)
    task = dataclasses.replace(task, num_actions=1, settle_actions=1)
    engine, idle = MassSprings(self_contact), jnp.full((1, 2), NONE)
    simulation, pickers = engine.physics(task)
    broken = dataclasses.replace(simulation, gravity=jnp.asarray(jnp.nan)), pickers
    for physics, status in (
        ((simulation, pickers), ExecutionStatus.FINE),
        (broken, ExecutionStatus.UNSTABLE),
    ):
        execute = RolloutExecutor(task, engine, physics)
        done = execute(task.episode_fn(0), Actions(idle, jnp.zeros((1, 2, 3))))
        assert done.status == status
        assert np.isfinite(done.positions[0]).all()
        assert np.isnan(done.score) == (status == ExecutionStatus.UNSTABLE)


@pytest.mark.parametrize("self_contact", [False, True])
@pytest.mark.parametrize("move", [np.nan, np.inf])
def test_an_executor_refuses_a_plan_that_is_not_finite(move, self_contact):
    task = dataclasses.replace(make_task("rope_folding", 7), num_actions=1)
    plan = Actions(jnp.array([[0, NONE]]), jnp.full((1, 2, 3), move))
    with pytest.raises(ValueError, match=rf"displacement\[0, 0, 0\] is {move}; give numbers"):
        MassSprings(self_contact).executor(task)(task.episode_fn(0), plan)


def test_a_free_start_that_ends_at_a_cost_is_fine_and_scores_minus_infinity():
    task = dataclasses.replace(make_task("rope_letter_u", 7), num_actions=1, settle_actions=0)
    start = np.asarray(task.episode_fn(0).start)
    plan = Actions(jnp.array([[0, NONE]]), jnp.full((1, 2, 3), 0.05))
    done = MassSprings().executor(task)(Episode(start, start), plan)
    assert (done.status, done.score) == (ExecutionStatus.FINE, -np.inf)


def test_a_planner_executes_in_mujoco():
    task = make_task("rope_folding", 7)
    task = dataclasses.replace(task, num_actions=1, settle_actions=1)
    planner = Planner(task, evaluator=MuJoCo())
    actions = Actions(jnp.array([[0, NONE]]), jnp.full((1, 2, 3), 0.05))
    done = planner.execute(task.episode_fn(0), actions)
    (wanted,) = replay(task, [task.episode_fn(0)], [actions])
    np.testing.assert_array_equal(done.positions, wanted.positions)
    assert (done.score, done.status) == (wanted.score, ExecutionStatus.FINE)
    with pytest.raises(ValueError, match=r"evaluator is MuJoCo.*, no engine in JAX; give another"):
        planner.plan(task.episode_fn(0), np.array([0]), Reranking(2))
