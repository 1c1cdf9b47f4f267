"""Obstacles in MuJoCo: the same surfaces, and bodies that come to rest on them alike."""

from dataclasses import replace

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from jaxsimp.bodies import cloth, rope
from jaxsimp.dynamics import (
    Actions,
    Box,
    Capsule,
    Plane,
    Sphere,
    Table,
    at_rest,
    largest_time_step,
    make_simulation,
    settle,
)
from jaxsimp.dynamics.contact.obstacles import make_obstacles
from jaxsimp.engines.mujoco import make_model, replay
from jaxsimp.engines.mujoco.geoms import obstacle_geoms
from jaxsimp.tasks import Episode, FixedStart, Task, distance_cost

OBSTACLES = {
    "table": Table(),
    "plane": Plane((0.0, 0.0, 0.1), (0.5, -0.3, 2.0)),
    "sphere": Sphere((0.01, 0.02, 0.1), 0.05),
    "capsule": Capsule((-0.08, 0.0, 0.1), (0.07, 0.03, 0.13), 0.03),
    "rounded box": Box((0.01, 0.0, 0.1), (0.09, 0.05, 0.04), 0.015, 0.3),
    "sharp box": Box((0.01, 0.0, 0.1), (0.09, 0.05, 0.04), 0.0, -0.8),
}
PROBE = 1e-4


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("grown", [0.0, 0.002])
@pytest.mark.parametrize("obstacle", OBSTACLES.values(), ids=OBSTACLES.keys())
def test_geoms_have_the_distances_of_the_obstacle(obstacle, grown):
    spec = mujoco.MjSpec()
    made = make_obstacles((obstacle,), rope(5, 0.01))
    for name, geom in obstacle_geoms(made, grown).items():
        spec.worldbody.add_geom(name=name, **geom)
    probe = spec.worldbody.add_body(name="probe", mocap=True)
    probe.add_geom(name="probe", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[PROBE, 0, 0])
    model = spec.compile()
    data = mujoco.MjData(model)
    probe_id, count = model.geom("probe").id, model.ngeom - 1
    points = np.random.default_rng(0).uniform(-0.2, 0.2, (200, 3)) + np.array([0.0, 0.0, 0.1])
    points = points[np.asarray(obstacle.distance(*points.T)[0]) > 0.005]
    assert len(points) > 30
    for point in points:
        data.mocap_pos[0] = point
        mujoco.mj_kinematics(model, data)
        found = min(
            mujoco.mj_geomDistance(model, data, each, probe_id, 1.0, None) for each in range(count)
        )
        wanted = float(obstacle.distance(*point)[0]) - grown - PROBE
        assert found == pytest.approx(wanted, abs=1e-6)  # MuJoCo's own tolerance


def rest_in_both(body, obstacles, start, seconds):
    """Positions at rest in MuJoCo and in ours."""
    model = make_model(body, "full", obstacles=obstacles)
    data = mujoco.MjData(model)
    data.qpos[:] = (start - body.rest).ravel()
    for _ in range(round(seconds / model.opt.timestep)):
        mujoco.mj_step(model, data)
    assert not data.warning.number.any()
    dt = min(2e-3, 0.9 * largest_time_step(body))
    simulation = make_simulation(body, dt, obstacles=obstacles)
    final = settle(simulation, at_rest(start), round(seconds / dt))
    return body.rest + data.qpos.reshape(-1, 3), np.asarray(final.position)


@pytest.mark.parametrize(
    ("obstacle", "height"),
    [
        (Sphere((0.0, 0.0, 0.05), 0.045), 0.1),
        (Box((0.0, 0.0, 0.04), (0.04, 0.03, 0.04), 0.01, 0.3), 0.085),
        (Capsule((0.0, -0.06, 0.05), (0.0, 0.06, 0.05), 0.03), 0.085),
    ],
    ids=["sphere", "box", "capsule"],
)
def test_a_cloth_drapes_over_an_obstacle_as_in_mujoco(obstacle, height):
    # Stiff, and in thick air: where strains are small, grid and flex are the same sheet, and it
    # settles where it lands.
    body = cloth((9, 9), (0.12, 0.12)).scaled(stiffness=10.0, damping=3.0, drag=5.0)
    start = body.rest + np.array([0.002, 0.001, height])
    theirs, ours = rest_in_both(body, (obstacle, Table()), start, 0.8)
    apart = np.linalg.norm(theirs - ours, axis=1)
    moved = np.linalg.norm(ours - start, axis=1)
    assert moved.max() > 0.02  # it hangs over the obstacle
    # Corners of the cloth fold differently (4 to 7 mm RMS); through the obstacle it is 50 mm.
    assert np.sqrt(np.mean(apart**2)) < 0.01
    # Both rest on it: MuJoCo's soft contacts give way by 0.4 mm, and its triangles, chords of
    # round obstacles, are in contact, where ours are particles.
    for found, low, high in ((theirs, -5e-4, 2e-3), (ours, -1e-6, 1e-4)):
        clear = np.asarray(obstacle.distance(*found.T)[0]) - body.radius
        assert low < clear.min() < high


def over_a_wall():
    """A task of a rope that is drawn over a box."""
    body = rope(11, 0.2)
    start = body.rest + np.array([-0.15, 0.0, body.radius])
    wall = Box((0.0, 0.0, 0.02), (0.03, 0.1, 0.02), 0.01)
    return Task(
        body=body,
        goal=start,
        episode_fn=FixedStart(Episode(start, start)),
        running_cost=distance_cost,
        terminal_cost=distance_cost,
        limits=(0.3, 0.1, 0.2),
        num_actions=2,
        num_pickers=1,
        obstacles=(wall, Table()),
    )


def test_a_plan_meets_the_same_obstacle_in_mujoco():
    task = over_a_wall()
    (episode,) = [task.episode_fn(0)]
    moves = jnp.array([[[0.05, 0.0, 0.1]], [[0.0, 0.0, -0.2]]])
    plan = Actions(jnp.array([[10], [10]]), moves)
    (found,) = replay(task, [episode], [plan])
    held = found.positions[2, 10]
    # The path ends on top of the wall, 0.04 m high, at the radius of the rope.
    wall = task.obstacles[0]
    assert float(wall.distance(*held)[0]) == pytest.approx(task.body.radius, abs=1e-3)
    assert held[2] > 0.03
    # The rest of the rope, which hangs down from there, is at the wall and not in it.
    clear = np.asarray(wall.distance(*found.positions[2, :10].T)[0]) - task.body.radius
    assert -2.5e-3 < clear.min() < 3e-3  # pulled taut into a soft contact; 4 mm is the radius
    bare = replace(task, obstacles=(Table(),))
    (found,) = replay(bare, [episode], [plan])
    assert found.positions[2, 10, 2] == pytest.approx(task.body.radius, abs=1e-3)


class Cone:
    """A shape that has no geom."""


@pytest.mark.usefixtures("unchecked_shapes")
def test_an_obstacle_without_a_geom_is_refused():
    with pytest.raises(ValueError, match=r"Cone has no geom of MuJoCo; add a case to _geoms"):
        obstacle_geoms((Cone(),), 0.0)
