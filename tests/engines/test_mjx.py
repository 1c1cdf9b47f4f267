"""MJX: the springs that we step are those that it steps, and it carries out the same plans."""

import dataclasses
import subprocess
import sys
from functools import lru_cache

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from jaxsimp.bodies import Body, cloth, garments, rope
from jaxsimp.dynamics import (
    NONE,
    Actions,
    Sphere,
    State,
    Table,
    at_rest,
    largest_time_step,
    make_pickers,
    make_simulation,
    rollout,
)
from jaxsimp.engines import Layout, MassSprings
from jaxsimp.engines.mjx import MJX, compare_with_mjx, make_mjx_simulation, mjx_rollout, tendon_spec
from jaxsimp.engines.mjx import engine as mjx_module
from jaxsimp.planning import CEM, Planner
from jaxsimp.tasks import make_task

# MJX relies on rank promotion.
pytestmark = pytest.mark.usefixtures("rank_promotion")

BODIES = {
    "rope": lambda: rope(7),
    "cloth": lambda: cloth((5, 5), (0.15, 0.15)),
    "garment": lambda: garments.t_shirt(num_particles=30).body,
}


def flung(body: Body, height: float, seed: int = 0) -> State:
    """A rough shape high above the table, every particle with a velocity of its own."""
    rng = np.random.default_rng(seed)
    position = body.rest + rng.uniform(-0.1, 0.1, body.rest.shape) * body.spacing
    velocity = rng.uniform(-1.0, 1.0, body.rest.shape)
    position[:, 2] += height
    return State(jnp.asarray(position, dtype=float), jnp.asarray(velocity, dtype=float))


def step_of(body: Body) -> float:
    return min(2e-3, 0.9 * largest_time_step(body))


# --- the oracle ----------------------------------------------------------------------------------


@pytest.mark.slow  # MJX compiles for long
@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("name", BODIES)
@pytest.mark.long
def test_mjx_moves_springs_as_we_do(name):
    body = BODIES[name]()
    found = compare_with_mjx(body, flung(body, 3.0), num_steps=200, time_step=step_of(body))
    # The same equations by other code: what is left is rounding of float64, 1e-16 of the 3 m of
    # height in springs of 1 cm, which grows at most some hundredfold on the way. A coefficient
    # that is off by a millionth shows.
    assert max(dataclasses.astuple(found)) < 1e-10


@pytest.mark.slow  # MJX compiles for long
def test_float32_agrees_to_float32():
    body = rope(5)
    found = compare_with_mjx(body, flung(body, 0.5), num_steps=200, time_step=1e-3, gravity=0.0)
    # 6e-8 of 1 m in springs of 0.1 m, strained by some hundredths: 1e-5 of the forces.
    assert max(dataclasses.astuple(found)) < 1e-5


@pytest.mark.slow  # MJX compiles for long
def test_what_reaches_the_table_is_not_compared():
    body = rope(5)
    with pytest.raises(
        ValueError, match=r"falls to -.* m, below the table.*0\.004 m; start higher"
    ):
        compare_with_mjx(body, flung(body, 0.1), num_steps=200)


def test_the_model_is_the_body():
    body = rope(6)
    spec = tendon_spec(body, 1e-3, 5.0)
    model = spec.compile()
    np.testing.assert_array_equal(model.qpos0.reshape(-1, 3), body.rest)
    np.testing.assert_array_equal(model.body_pos[1:], body.rest)
    np.testing.assert_allclose(model.body_mass[1:], body.mass, rtol=1e-15)
    np.testing.assert_array_equal(model.tendon_stiffness, body.stiffness)
    np.testing.assert_array_equal(model.tendon_damping, body.damping)
    np.testing.assert_array_equal(model.tendon_lengthspring[:, 0], body.rest_length)
    np.testing.assert_array_equal(model.tendon_lengthspring[:, 1], body.rest_length)
    np.testing.assert_array_equal(model.dof_damping, np.repeat(body.material.drag * body.mass, 3))
    np.testing.assert_array_equal(model.opt.gravity, [0.0, 0.0, -5.0])
    assert model.opt.timestep == 1e-3
    assert model.ngeom == 0
    again = mujoco.MjModel.from_xml_string(spec.to_xml())
    for name in ("qpos0", "body_mass", "tendon_stiffness", "tendon_lengthspring", "dof_damping"):
        # MuJoCo writes six digits.
        np.testing.assert_allclose(getattr(again, name), getattr(model, name), rtol=1e-5)
    assert again.opt.disableflags == model.opt.disableflags


# --- plans ---------------------------------------------------------------------------------------


@lru_cache(None)
def small_task():
    task = make_task("rope_folding", 11)
    return dataclasses.replace(task, num_actions=2, action_seconds=0.1, settle_actions=3)


def actions_of(picks, displacements) -> Actions:
    return Actions(jnp.asarray(picks), jnp.asarray(displacements, dtype=float))


LIFT_AND_PULL = (
    [[0, 10], [0, NONE], [0, 0], [2, 8]],
    [
        [[0.1, 0.05, 0.1], [-0.1, 0.1, 0.05]],
        [[0.1, 0.1, -0.2], [0.0, 0.0, 0.0]],  # into the table, where it stops
        [[0.0, 0.1, 0.05], [0.0, -0.1, 0.05]],  # the second picker comes too late
        [[-0.15, 0.0, 0.0], [0.15, 0.0, 0.0]],  # refused: too far apart
    ],
)


@pytest.mark.slow  # MJX compiles for long
@pytest.mark.usefixtures("x64")
def test_a_rollout_on_the_table_is_ours():
    body, step = rope(11), 1e-3
    pickers = make_pickers((0.15, 0.15, 0.15), steps=80)
    # One rollout stays in the air long enough to fall, one lies on the table.
    starts = jnp.stack([jnp.asarray(body.rest) + jnp.array([0.0, 0.0, h]) for h in (0.004, 0.05)])
    actions = actions_of(*LIFT_AND_PULL)
    ours, theirs = make_simulation(body, step), make_mjx_simulation(body, step)

    def of(run, simulation):
        return jax.jit(jax.vmap(lambda start: run(simulation, pickers, at_rest(start), actions)))

    expected = of(rollout, ours)(starts)
    found = of(mjx_rollout, theirs)(starts)
    # It moved, and slid: metres
    assert jnp.abs(expected[1][:, -1] - starts).max() > 0.05
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        # Rounding of float64, which impacts and 320 steps let grow.
        np.testing.assert_allclose(a, b, atol=1e-9)


@pytest.mark.slow  # MJX compiles for long
@pytest.mark.usefixtures("x64")
def test_a_rollout_on_an_obstacle_is_ours():
    body, step = rope(7, 0.15), 1e-3
    ball = Sphere((0.0, 0.0, 0.0), 0.05)
    task = dataclasses.replace(
        make_task("rope_folding", 7),
        body=body,
        goal=body.rest,
        obstacles=(ball, Table()),
        longest_time_step=step,
    )
    theirs, pickers = MJX().physics(task)
    start = at_rest(body.rest + np.array([0.002, 0.001, 0.06]))
    # Down beside the ball, and into it, where the path ends.
    actions = actions_of([[0, NONE], [3, NONE]], [[[0.0, 0.0, -0.03]] * 2, [[0.0, 0.0, -0.1]] * 2])
    found, frames = jax.jit(mjx_rollout)(theirs, pickers, start, actions)
    expected, wanted = jax.jit(rollout)(theirs.ours, pickers, start, actions)
    lying = np.asarray(ball.distance(*expected.position.T)[0]) - body.radius
    assert (np.abs(lying) < 1e-4).any()
    np.testing.assert_allclose(found.position, expected.position, atol=1e-9)  # as above
    np.testing.assert_allclose(frames, wanted, atol=1e-9)


@pytest.mark.slow  # MJX compiles for long
@pytest.mark.long
def test_a_plan_scores_the_same_in_both_engines():
    task, candidates = small_task(), np.array([0, 5, 10])
    algorithm = CEM(num_iterations=2, population=8, initial_populations=2)
    planners = {
        type(engine): Planner(task, engine, engine, Layout(2, 2))
        for engine in (MassSprings(), MJX())
    }
    episode = task.episode_fn(0)
    plans = {kind: p.plan(episode, candidates, algorithm, 0) for kind, p in planners.items()}
    found = plans[MJX]
    again = planners[MJX].plan(episode, candidates, algorithm, 0)
    np.testing.assert_array_equal(again.actions.displacement, found.actions.displacement)
    assert found.optimum.failed == 0
    assert found.optimum.best_costs[-1] <= found.optimum.best_costs[0]
    # Rounding of float32, 1e-7 m, grows at most some hundredfold over 300 time steps: costs and
    # scores are means of distances of 0.1 m.
    assert found.optimum.cost == pytest.approx(float(plans[MassSprings].optimum.cost), rel=1e-4)
    for plan in plans.values():
        one, other = (p.execute(episode, plan.actions) for p in planners.values())
        assert other.score == pytest.approx(one.score, abs=1e-3)
        np.testing.assert_allclose(other.positions, one.positions, atol=1e-4)
        assert np.abs(one.positions[-1] - one.positions[0]).max() > 0.01


# --- what is refused, and what is left alone -----------------------------------------------------


def test_a_large_body_is_refused_by_name():
    task = make_task("cloth_side_folding", 25)
    with pytest.raises(ValueError, match=r"the cloth has 625 particles; MJX takes at most \d+"):
        Planner(task, engine=MJX())


def test_an_unstable_time_step_is_refused():
    with pytest.raises(ValueError, match=r"time_step is 0\.1 s"):
        make_mjx_simulation(rope(5), 0.1)


def test_a_flex_is_refused_by_name():
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><flexcomp name="rope" type="grid" count="4 1 1" spacing=".1 .1 .1" '
        'dim="1" mass="0.1"><edge equality="true"/><contact selfcollide="none"/></flexcomp>'
        "</worldbody></mujoco>"
    )
    with pytest.raises(ValueError, match="has 1 flex; MJX has none"):
        mjx_module.to_mjx(model)


ALONE = """
import sys
import jaxsimp.engines
assert "mujoco" not in sys.modules
sys.modules["warp"] = None  # what MJX misses, and says so
from jaxsimp.bodies import rope
from jaxsimp.engines.mjx import make_mjx_simulation
make_mjx_simulation(rope(3), 1e-3)
assert "mujoco.mjx" in sys.modules
"""


def test_mujoco_is_imported_when_asked_for_and_says_nothing():
    run = subprocess.run([sys.executable, "-c", ALONE], check=True, capture_output=True, text=True)
    assert run.stdout == ""


@pytest.mark.usefixtures("unchecked_shapes")
def test_a_state_of_another_body_is_not_compared():
    body = rope(5)
    with pytest.raises(ValueError, match=r"position of the state has shape \(4, 3\); give shape"):
        compare_with_mjx(body, at_rest(body.rest[:4] + 1.0), 2)
    with pytest.raises(ValueError, match=r"state.position\[0, 0\] is nan; give numbers"):
        compare_with_mjx(body, at_rest(body.rest * np.nan), 2)
