"""Obstacles: distances, contact, friction, the pickers' door and gradients, against oracles."""

from dataclasses import dataclass, fields, replace
from functools import partial
from types import FunctionType

import igl
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from jaxsimp import goals
from jaxsimp.bodies import cloth, from_mesh, rope, rope_along
from jaxsimp.dynamics import (
    NONE,
    Actions,
    Box,
    Capsule,
    Plane,
    Sphere,
    State,
    Table,
    at_rest,
    largest_time_step,
    least_radius,
    make_pickers,
    make_simulation,
    rollout,
    settle,
    table_with_edge,
)
from jaxsimp.dynamics.contact.obstacles import LEAST_SIZE, gap, make_obstacles
from jaxsimp.dynamics.contact.rigid import contact
from jaxsimp.dynamics.pickers import GRAZE, grasp

jit_settle = jax.jit(settle, static_argnames="num_steps")
jit_rollout = jax.jit(rollout, static_argnames="adjoint")
WIDE = (10.0, 10.0, 10.0)

SPHERE = Sphere((0.01, 0.02, 0.1), 0.05)
CAPSULE = Capsule((-0.08, 0.0, 0.1), (0.07, 0.03, 0.13), 0.03)
ROUNDED = Box((0.01, 0.0, 0.1), (0.09, 0.05, 0.04), 0.015, 0.3)
SHARP = Box((0.01, 0.0, 0.1), (0.09, 0.05, 0.04), 0.0, -0.8)
SLOPE = Plane((0.0, 0.0, 0.1), (0.5, -0.3, 2.0))
SOLIDS = {"sphere": SPHERE, "capsule": CAPSULE, "rounded box": ROUNDED, "sharp box": SHARP}
EVERY = SOLIDS | {"plane": SLOPE, "table": Table()}


def each(obstacles):
    return pytest.mark.parametrize("obstacle", obstacles.values(), ids=obstacles.keys())


def at(obstacle, points):
    """Signed distances and normals, shapes (K,) and (K, 3)."""
    distance, normal = obstacle.distance(*jnp.asarray(points).T)
    normal = [np.broadcast_to(part, distance.shape) for part in normal]
    return np.asarray(distance), np.stack(normal, axis=1)


# --- distances ------------------------------------------------------------------------------------


def as_mesh(obstacle):
    """The obstacle as a convex hull, made by trimesh, of points on its surface."""
    if isinstance(obstacle, Sphere):
        ball = trimesh.creation.icosphere(subdivisions=4, radius=obstacle.radius)
        return ball.apply_translation(obstacle.center)
    ball = trimesh.creation.icosphere(subdivisions=4, radius=1.0).vertices
    if isinstance(obstacle, Capsule):
        balls = [obstacle.radius * ball + middle for middle in (obstacle.start, obstacle.end)]
        return trimesh.convex.convex_hull(np.concatenate(balls))
    core = np.array(obstacle.half_sizes) - obstacle.rounding
    corners = np.array(np.meshgrid(*np.stack([-core, core], axis=1))).reshape(3, -1).T
    points = (corners[:, None] + obstacle.rounding * ball[None]).reshape(-1, 3)
    turned = trimesh.transformations.rotation_matrix(obstacle.turn, (0, 0, 1))
    turned[:3, 3] = obstacle.center
    return trimesh.convex.convex_hull(points).apply_transform(turned)


@pytest.mark.usefixtures("x64")
@each(SOLIDS)
def test_distances_are_those_of_libigl(obstacle):
    mesh = as_mesh(obstacle)
    rng = np.random.default_rng(0)
    points = mesh.centroid + rng.uniform(-1.2, 1.2, (400, 3)) * mesh.extents / 2
    wanted = igl.signed_distance(points, np.array(mesh.vertices), np.array(mesh.faces))[0]
    found, _ = at(obstacle, points)
    is_outside = wanted > 0
    assert is_outside.sum() > 50
    assert (~is_outside).sum() > 50
    # The hull's facets are below a ball by up to 0.0012 of its radius (edges of 0.07 radii).
    np.testing.assert_allclose(found[is_outside], wanted[is_outside], rtol=0, atol=1e-4)
    np.testing.assert_allclose(found[~is_outside], wanted[~is_outside], rtol=0, atol=1e-4)


@pytest.mark.usefixtures("x64")
@each(EVERY)
def test_normals_are_the_slope_of_the_distance(obstacle):
    points = np.random.default_rng(1).uniform(-0.2, 0.2, (400, 3)) + np.array([0.0, 0.0, 0.1])
    distance, normal = at(obstacle, points)
    h = 1e-6
    slope = np.stack(
        [(at(obstacle, points + h * e)[0] - at(obstacle, points - h * e)[0]) for e in np.eye(3)],
        axis=1,
    ) / (2 * h)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, rtol=1e-12)
    # Differences err by h^2 over the squared radius of curvature, near the kinks inside by more.
    smooth = distance > 1e-3
    np.testing.assert_allclose(normal[smooth], slope[smooth], rtol=0, atol=1e-6)
    assert np.mean(np.abs(normal - slope).max(axis=1) < 1e-6) > 0.99


def test_a_plane_has_the_distance_of_hesse():
    points = np.random.default_rng(2).uniform(-1, 1, (50, 3))
    wanted = (points - SLOPE.point) @ np.array(SLOPE.normal) / np.linalg.norm(SLOPE.normal)
    np.testing.assert_allclose(at(SLOPE, points)[0], wanted, rtol=0, atol=1e-6)


@pytest.mark.usefixtures("x64")
@each(EVERY)
def test_distances_are_convex(obstacle):
    # Contact and pickers rely on it: no point is nearer than the plane at the nearest point says.
    points = np.random.default_rng(3).uniform(-0.3, 0.3, (2, 2000, 3)) + np.array([0.0, 0.0, 0.1])
    (here, normal), (there, _) = at(obstacle, points[0]), at(obstacle, points[1])
    assert np.all(there >= here + np.sum(normal * (points[1] - points[0]), axis=1) - 1e-12)


@pytest.mark.usefixtures("x64")
@each(EVERY)
def test_gradients_are_finite_at_special_points(obstacle):
    middle = np.array(getattr(obstacle, "center", getattr(obstacle, "start", (0.0, 0.0, 0.1))))
    points = [
        middle,
        middle + np.array([0.09, 0.05, 0.04]),
        middle + np.array([0.0, 0.0, 0.04]),
        middle + np.array([0.09, 0, 0]),
    ]
    obstacle = make_obstacles((obstacle,), rope(5, 0.01))[0]

    def total(obstacle, point):
        distance, normal = obstacle.distance(*point)
        return distance + sum(normal)

    for point in points:
        found = jax.grad(total, (0, 1))(obstacle, jnp.asarray(point))
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))


def test_a_table_with_an_edge_is_the_table_up_to_there():
    points = np.random.default_rng(4).uniform(-0.4, 0.4, (200, 3))
    points = points[(points[:, 0] < 0.05) & (points[:, 2] > -0.05)]  # the rounding is at 0.09
    distance, normal = at(table_with_edge(0.1, rounding=0.01), points)
    np.testing.assert_allclose(distance, points[:, 2], rtol=0, atol=1e-6)
    np.testing.assert_allclose(normal, [[0, 0, 1]] * len(points), rtol=0, atol=1e-6)
    assert at(table_with_edge(0.1), np.array([[0.2, 0.0, -0.2]]))[0] == pytest.approx(0.1)


# --- contact --------------------------------------------------------------------------------------

DUST = rope(2, 0.02, stretch_stiffness=0.0, damping=0.0, bend_stiffness=0.0, drag=0.0)


@pytest.mark.usefixtures("x64")
@each(EVERY)
def test_no_particle_enters_an_obstacle_at_any_speed(obstacle):
    simulation = make_simulation(DUST, 2e-3, obstacles=(obstacle,))
    radius = DUST.radius

    @given(seed=st.integers(0, 2**32 - 1), speed=st.floats(0.0, 200.0))
    def check(seed, speed):
        rng = np.random.default_rng(seed)
        position = rng.uniform(-0.3, 0.3, (2, 3)) + np.array([0.0, 0.0, 0.1])
        distance, normal = at(obstacle, position)
        position += np.maximum(radius - distance, 0.0)[:, None] * normal  # outside, or on it
        distance, _ = at(obstacle, position)
        velocity = speed * rng.normal(size=(2, 3))
        start = State(jnp.asarray(position), jnp.asarray(velocity))
        final = jit_settle(simulation, start, 1)
        # Rounding of positions below 1 m.
        assert at(obstacle, final.position)[0].min() > min(radius, distance.min()) - 1e-12

    check()


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("angle", [0.3, 0.6])
@pytest.mark.parametrize("friction", [0.2, 0.5])
def test_a_block_slides_down_a_slope_as_coulomb_says(angle, friction):
    slope = Plane((0.0, 0.0, 0.0), (np.sin(angle), 0.0, np.cos(angle)))
    body = rope(2, 0.02, friction=friction, drag=0.0)
    along, normal = np.array([np.cos(angle), 0, -np.sin(angle)]), np.array(slope.normal)
    position = np.outer([0.0, 0.02], [0, 1, 0]) + body.radius * normal
    dt, steps = 1e-3, 200
    simulation = make_simulation(body, dt, obstacles=(slope,))
    final = jit_settle(simulation, at_rest(position), steps)
    pull = 9.81 * (np.sin(angle) - friction * np.cos(angle))
    wanted = max(0.0, pull) * dt * steps * along
    np.testing.assert_allclose(final.velocity, [wanted] * 2, rtol=1e-9, atol=1e-9)


def pull_to_move(flat, friction, radius, smooth):
    """Pull, as a length of rope, that just moves a length on a table over a quarter turn.

    Along the turn, from the top: dT/da = f (T + R cos a) - R sin a, with R the weight of an arc of
    one radian; the last term is the weight that helps, the first is friction, 0 where smooth.
    """
    rub = 0.0 if smooth else friction

    def slope(angle, tension):
        return rub * (tension + radius * np.cos(angle)) - radius * np.sin(angle)

    return solve_ivp(slope, (0, np.pi / 2), [friction * flat], rtol=1e-9).y[0, -1]


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("smooth", [True, False], ids=["smooth edge", "rough edge"])
@pytest.mark.parametrize("friction", [0.25, 0.5, 0.8])
def test_a_rope_slides_over_an_edge_when_its_overhang_outweighs_friction(friction, smooth):
    length, rounding, count = 0.6, 0.02, 61
    body = rope(count, length, stretch_stiffness=600.0, bend_stiffness=0.0, drag=5.0)
    radius = rounding + body.radius
    arc, margin = np.pi / 2 * radius, 0.03 if smooth else 0.0  # also smooth: what comes next

    def excess(flat):
        hanging = length - arc - margin - flat
        return hanging - pull_to_move(flat, friction, radius, smooth)

    limit = brentq(excess, 0.01, 0.5)  # length that rubs on the table, if it is about to slide
    if smooth:  # the textbook's threshold, with the height of the overhang for its length
        height = length - arc - margin - limit + radius
        assert height / (height + limit) == pytest.approx(friction / (1 + friction), abs=1e-6)
    dt = 0.9 * largest_time_step(body)
    simulation = make_simulation(body, dt, obstacles=(table_with_edge(rounding=rounding),))

    def slides(flat):
        """Motion of the rope's end from 0.3 s to 0.5 s."""
        past = np.linspace(0, length, count) - flat - margin
        turn = np.clip(past / radius, 0, np.pi / 2)
        x = -rounding + np.minimum(past, 0) + radius * np.sin(turn)
        z = -rounding + radius * np.cos(turn) - np.maximum(past - arc, 0)
        # It stretches first, with so much friction that nothing slides.
        stuck = replace(simulation, friction=jnp.full(count, 50.0))
        start = at_rest(np.stack([x, 0 * x, z], axis=1))
        held = jit_settle(stuck, start, round(0.5 / dt))
        rubs = jnp.where(jnp.asarray(past > -margin) & smooth, 0.0, friction)
        slippery = replace(simulation, friction=rubs)
        before = jit_settle(slippery, held, round(0.3 / dt))
        after = jit_settle(slippery, before, round(0.2 / dt))
        return float((after.position - before.position)[0, 0])

    # A particle is 1.6 % of the rope, and the rope stretches by 1 to 2 %.
    assert abs(slides(1.04 * limit)) < 1e-5
    assert slides(0.96 * limit) > 5e-3


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("friction", [0.2, 0.4, 0.6])
def test_a_rope_over_a_cylinder_holds_up_to_the_ratio_of_the_capstan(friction):
    count, length, light = 41, 0.3, 0.02
    body = rope(count, length, stretch_stiffness=3000.0, bend_stiffness=0.0, drag=5.0, damping=0.05)
    bar = Capsule((0.0, -0.2, 0.0), (0.0, 0.2, 0.0), 0.04)
    reach = bar.radius + body.radius
    along = np.linspace(-length / 2, length / 2, count)
    turn = np.clip(along / reach, -np.pi / 2, np.pi / 2)
    hanging = np.abs(along - turn * reach)
    start = np.stack([reach * np.sin(turn), 0 * turn, reach * np.cos(turn) - hanging], axis=1)
    mass = np.full(count, 2e-3 / count)  # a tenth of the lighter weight in all

    def slides(ratio):
        """Motion of the rope's middle from 0.3 s to 0.5 s."""
        weighed = replace(body, mass=np.concatenate([[light], mass[1:-1], [light * ratio]]))
        dt = 0.9 * largest_time_step(weighed)
        simulation = make_simulation(weighed, dt, obstacles=(bar,))
        stuck = replace(simulation, friction=jnp.asarray(50.0))
        held = jit_settle(stuck, at_rest(start), round(0.5 / dt))
        slippery = replace(simulation, friction=jnp.asarray(friction))
        before = jit_settle(slippery, held, round(0.3 / dt))
        after = jit_settle(slippery, before, round(0.2 / dt))
        return float((after.position - before.position)[count // 2, 0])

    # T2 / T1 = exp(f pi). The rope's own weight, a tenth of the lighter one over a half turn,
    # and polygon for circle, change the threshold by 2 to 3 %.
    threshold = np.exp(friction * np.pi)
    assert slides(0.94 * threshold) < 1e-4
    assert slides(1.06 * threshold) > 2e-3


def of_heights(simulation, position, velocity):
    """Contact with the table alone, written out."""
    x, y, z = velocity
    above = position[2] - simulation.radius
    along = jnp.maximum(z, -above * (1.0 / simulation.time_step))
    squared = x * x + y * y
    slowdown = simulation.friction * (along - z)
    slowdown = slowdown * jax.lax.rsqrt(jnp.maximum(squared, 1e-12))
    kept = jnp.maximum(0.0, 1.0 - slowdown)
    return [x * kept, y * kept, along]


def test_the_table_alone_is_the_arithmetic_of_heights_and_nothing_else():
    # The same program, and so the same bits and cost, forwards and backwards.
    simulation = make_simulation(rope(5), 1e-3)
    rows = [jnp.asarray(row) for row in np.random.default_rng(0).normal(size=(6, 5, 3))]

    def backwards(run, *rows):
        after, pullback = jax.vjp(lambda *rows: run(simulation, [*rows[:3]], [*rows[3:]]), *rows)
        return pullback(after)

    found, wanted = (
        str(jax.make_jaxpr(partial(backwards, run))(*rows)) for run in (contact, of_heights)
    )
    assert found == wanted


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Ceiling:
    """An obstacle of one's own: everything above a height."""

    height: float

    def distance(self, x, y, z):
        return self.height - z, (0.0, 0.0, -1.0)

    def size(self):
        return "height", np.inf


def test_an_obstacle_of_ones_own_acts_and_stops_pickers():
    body = rope(5, 0.1)
    simulation = make_simulation(body, 1e-3, obstacles=(Ceiling(0.3), Table()))
    start = State(jnp.asarray(body.rest + np.array([0, 0, 0.2]), float), jnp.full((5, 3), 3.0))
    final = jit_settle(simulation, start, 100)
    assert float(final.position[:, 2].max()) == pytest.approx(0.3 - body.radius, abs=2e-2)
    assert float(final.position[:, 2].max()) <= 0.3 - body.radius + 1e-6
    way = moved((Ceiling(0.3), Table()), (0.0, 0.0, 0.1), (0.1, 0.0, 0.5))
    np.testing.assert_allclose(way, [0.1, 0.0, 0.2 - 0.004], rtol=0, atol=2 * GRAZE)


def test_the_table_does_not_depend_on_company_that_is_far_away():
    body = cloth((5, 5), (0.1, 0.1))
    far = Sphere((5.0, 0.0, 0.0), 0.5)
    start = goals.flat(body) + np.random.default_rng(0).uniform(0, 2e-3, body.rest.shape)
    ends = [
        jit_settle(make_simulation(body, 2e-3, obstacles=obstacles), at_rest(start), 50).position
        for obstacles in ((Table(),), (far, Table()), (Table(), far))
    ]
    np.testing.assert_allclose(ends[1], ends[0], rtol=0, atol=1e-7)
    np.testing.assert_allclose(ends[2], ends[0], rtol=0, atol=1e-7)


def test_a_level_plane_is_the_table():
    body = cloth((5, 5), (0.1, 0.1))
    start = goals.flat(body) + np.random.default_rng(0).uniform(0, 2e-3, body.rest.shape)
    level = Plane((0.3, 0.2, 0.0), (0.0, 0.0, 2.0))
    plain, other = (
        jit_settle(make_simulation(body, 2e-3, **options), at_rest(start), 100)
        for options in ({}, {"obstacles": (level,)})
    )
    np.testing.assert_allclose(other.position, plain.position, rtol=0, atol=1e-6)
    assert np.ptp(plain.position[:, 2]) < 1e-6  # it lies


# --- pickers --------------------------------------------------------------------------------------


def moved(obstacles, start, displacement, radius=0.004):
    """Displacement of one held particle."""
    position = jnp.stack([jnp.asarray(start, float), jnp.zeros(3) + 9.0])
    actions = Actions(jnp.array([0]), jnp.asarray(displacement, float)[None])
    around = position, obstacles, jnp.asarray(radius)
    return grasp(make_pickers(WIDE), *around, position, actions)[1][0]


@pytest.mark.usefixtures("x64")
@each(SOLIDS | {"plane": SLOPE})
def test_paths_of_pickers_end_at_their_first_touch(obstacle):
    radius = 0.004
    run = jax.jit(lambda start, way: moved((obstacle,), start, way))
    counts = np.zeros(2, int)

    @given(seed=st.integers(0, 2**32 - 1))
    def check(seed):
        rng = np.random.default_rng(seed)
        start = rng.uniform(-0.2, 0.2, 3) + np.array([0.0, 0.0, 0.1])
        distance, normal = at(obstacle, start[None])
        start = start + max(radius - distance[0], 0.0) * normal[0]
        # To around the middle of the obstacle, or beyond.
        goal = np.array([0.0, 0.0, 0.1]) + rng.normal(size=3) * 0.05
        asked = rng.uniform(0.2, 2.0) * (goal - start)
        way = np.asarray(run(jnp.asarray(start), jnp.asarray(asked)))
        path = start + np.linspace(0, 1, 500)[:, None] * way
        clear = at(obstacle, path)[0] - radius
        assert clear.min() > -1.2 * GRAZE
        counts[int(clear[-1] < 1e-4 and np.linalg.norm(way) > 0)] += 1

    check()
    # Some end at the obstacle, some do not: at a rate of a third or more each, of 25 examples.
    assert counts.min() > 0


def test_a_path_through_a_sphere_is_cut_where_a_line_meets_it():
    ball = Sphere((0.0, 0.0, 0.0), 0.05)
    found = moved((ball,), (-0.2, 0.03, 0.0), (0.5, 0.0, 0.0))
    wanted = 0.2 - np.sqrt(0.054**2 - 0.03**2)
    # It may graze by 10 micrometres, which is a little more along a slanting path.
    np.testing.assert_allclose(found, [wanted, 0.0, 0.0], rtol=0, atol=2 * GRAZE)
    past = moved((ball,), (-0.2, 0.0541, 0.0), (0.5, 0.0, 0.0))
    np.testing.assert_array_equal(past, np.float32([0.5, 0.0, 0.0]))


def test_a_target_inside_is_pushed_out_and_slides_along_a_face():
    block = Box((0.0, 0.0, 0.0), (0.2, 0.2, 0.05), 0.01)
    start = np.array([0.0, 0.0, 0.054])
    found = moved((block,), start, (0.1, 0.02, -0.03))
    np.testing.assert_allclose(found, [0.1, 0.02, 0.0], rtol=0, atol=1e-6)
    through = moved((block,), start, (0.0, 0.0, -0.5))  # to the other side
    np.testing.assert_allclose(through, 0.0, rtol=0, atol=2 * GRAZE)


def test_a_target_that_is_pushed_out_stays_within_the_limits():
    # Nearly along a tangent of a ball; the target, just inside, is pushed up by 0.09 m.
    ball = Sphere((0.0, 0.0, 0.0), 0.996)
    position = jnp.array([[-1.073, 0.0, 0.59], [9.0, 9.0, 9.0]])
    action = Actions(jnp.array([0]), jnp.array([[0.673, 0.0, 0.21]]))
    around = position, (ball,), jnp.asarray(0.004)
    moves = [grasp(make_pickers((1.0, 1.0, z)), *around, position, action)[1] for z in (0.22, 0.5)]
    assert moves[1][0, 2] > 0.29
    assert 0.2 < moves[0][0, 2] <= 0.22 * (1 + 1e-6)
    np.testing.assert_allclose(
        moves[0][0] / moves[0][0, 2], moves[1][0] / moves[1][0, 2], rtol=1e-5
    )


def test_with_the_table_alone_displacements_are_clipped_as_a_maximum_of_heights():
    rng = np.random.default_rng(0)
    start = rng.uniform(-0.2, 0.2, (500, 3)) * [1, 1, 0] + np.array([0, 0, 0.004])
    start[250:, 2] += rng.uniform(-1e-4, 0.2, 250)
    way = rng.normal(size=(500, 3)) * 0.2
    start, way = jnp.asarray(start, float), jnp.asarray(way, float)
    found = jax.jit(jax.vmap(lambda start, way: moved((Table(),), start, way)))(start, way)
    target = start + way
    wanted = target.at[:, 2].set(jnp.maximum(target[:, 2], 0.004)) - start
    np.testing.assert_array_equal(found, wanted)


@pytest.mark.usefixtures("x64")
@each({"sphere": SPHERE, "capsule": CAPSULE, "rounded box": ROUNDED, "plane": SLOPE})
def test_the_touch_of_a_path_has_the_slope_of_differences(obstacle):
    start, way = jnp.array([-0.25, 0.01, 0.16]), jnp.array([0.5, 0.02, -0.13])
    obstacle = make_obstacles((obstacle,), rope(5, 0.01))[0]

    def total(obstacle, start, way):
        return jnp.vdot(jnp.array([1.0, 0.7, -0.4]), moved((obstacle,), start, way))

    arguments = obstacle, start, way
    assert np.linalg.norm(moved(*((obstacle,), start, way)) - way) > 0.01  # it is cut
    leaves, tree = jax.tree.flatten(arguments)
    rng = np.random.default_rng(0)
    ways = [jnp.asarray(rng.normal(size=leaf.shape)) for leaf in leaves]
    found = jax.jit(jax.grad(total, (0, 1, 2)))(*arguments)
    wanted = central(lambda *leaves: total(*jax.tree.unflatten(tree, leaves)), leaves, ways)
    by_gradient = sum(jnp.vdot(a, b) for a, b in zip(jax.tree.leaves(found), ways, strict=True))
    np.testing.assert_allclose(by_gradient, wanted, rtol=1e-6)


def central(value, leaves, ways, h=1e-6):
    """The derivative in a direction, by central differences."""
    ends = [
        float(value(*(leaf + s * h * way for leaf, way in zip(leaves, ways, strict=True))))
        for s in (1.0, -1.0)
    ]
    return (ends[0] - ends[1]) / (2 * h)


# --- gradients ------------------------------------------------------------------------------------

ALL = (
    Box((0.08, 0.0, 0.0), (0.03, 0.06, 0.03), 0.01, 0.2),
    Capsule((-0.085, -0.1, 0.005), (-0.075, 0.1, 0.0), 0.025),
    Sphere((0.0, 0.0, -0.01), 0.04),
    Plane((0.0, -0.006, 0.0), (0.05, 1.0, 0.1)),
)


def problem(obstacles, **options):
    """A weighed sum of the motion of a rope on obstacles, as a function of its numbers."""
    body = rope(9, 0.2)
    names = ("springs", "families", "rest_length", "stiffness", "damping")
    body = replace(body, **{name: getattr(body, name)[:8] for name in names})  # quick to compile
    simulation = make_simulation(body, 2e-3, obstacles=obstacles)
    pickers = make_pickers(steps=20)
    weights = jnp.asarray(np.random.default_rng(0).normal(size=(2, 9, 3)))
    pick = jnp.array([[2, NONE], [6, NONE]])
    rng = np.random.default_rng(1)
    inputs = {
        "start": jnp.asarray(
            body.rest + np.array([0.0, 0.0, 0.037]) + rng.uniform(0, 1e-3, (9, 3))
        ),
        "velocity": jnp.asarray(rng.uniform(-0.3, 0.3, (9, 3)) - np.array([0.0, 0.0, 0.3])),
        "displacement": jnp.asarray(
            rng.uniform(-0.01, 0.01, (2, 2, 3)) - np.array([0.0, 0.0, 0.005])
        ),
        "obstacles": simulation.obstacles,
        "numbers": {name: getattr(simulation, name) for name in ("friction", "radius", "mass")},
    }

    def loss(inputs):
        changed = replace(simulation, obstacles=inputs["obstacles"], **inputs["numbers"])
        state = State(inputs["start"], inputs["velocity"])
        actions = Actions(pick, inputs["displacement"])
        final, _ = rollout(changed, pickers, state, actions, **options)
        moved = weights[0] * final.position + 0.01 * weights[1] * final.velocity
        return jnp.sum(moved), final

    return loss, inputs


@pytest.mark.usefixtures("x64")
def test_the_adjoint_with_obstacles_is_the_slope_of_differences():
    loss, inputs = problem(ALL)
    value = jax.jit(lambda inputs: loss(inputs)[0])
    found, final = jax.jit(jax.grad(loss, has_aux=True))(inputs)
    lying = [np.abs(at(each, final.position)[0] - 0.004) < 1e-4 for each in inputs["obstacles"]]
    assert all(each.any() for each in lying)  # all of them count
    rng = np.random.default_rng(2)
    for name, leaves in inputs.items():
        for place, leaf in enumerate(jax.tree.leaves(leaves)):
            flat, tree = jax.tree.flatten(leaves)
            way = jnp.asarray(rng.normal(size=leaf.shape))

            def along(step, place=place, flat=flat, tree=tree, way=way, name=name):
                moved = [each + step * way if i == place else each for i, each in enumerate(flat)]
                return value(inputs | {name: jax.tree.unflatten(tree, moved)})

            h = 1e-7
            wanted = float(along(h) - along(-h)) / (2 * h)
            gradient = float(jnp.vdot(jax.tree.leaves(found[name])[place], way))
            # As in test_gradients.py; 1e-8 for what is next to nothing.
            np.testing.assert_allclose(gradient, wanted, rtol=1e-5, atol=1e-7, err_msg=name)


@pytest.mark.slow
@pytest.mark.usefixtures("x64")
@pytest.mark.long
def test_forward_and_reverse_mode_with_obstacles_agree():
    (reverse, inputs), (plain, _) = problem(ALL), problem(ALL, adjoint=False)
    found = jax.jit(jax.grad(lambda inputs: reverse(inputs)[0]))(inputs)
    rng = np.random.default_rng(3)
    way = jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape)), inputs)
    _, forward = jax.jit(lambda way: jax.jvp(lambda i: plain(i)[0], (inputs,), (way,)))(way)
    both = zip(jax.tree.leaves(found), jax.tree.leaves(way), strict=True)
    np.testing.assert_allclose(sum(jnp.vdot(a, b) for a, b in both), forward, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("name", ["displacement", "obstacles"])
@pytest.mark.long
def test_a_batch_of_plans_and_of_obstacles_is_a_loop(name):
    # Cotangents of plans alone have the batch last, those of a simulation have it first.
    loss, inputs = problem(ALL[1:3])

    def gradient(each):
        return jax.grad(lambda each: loss(inputs | {name: each})[0])(each)

    scales = 1.0 + jnp.array([0.0, 0.1, -0.1])
    each = [jax.tree.map(lambda leaf, s=scale: s * leaf, inputs[name]) for scale in scales]
    together = jax.jit(jax.vmap(gradient))(jax.tree.map(lambda *rows: jnp.stack(rows), *each))
    alone = jax.jit(gradient)
    for row, one in enumerate(each):
        for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(alone(one)), strict=True):
            np.testing.assert_allclose(a[row], b, rtol=1e-8, atol=1e-10)
            assert np.abs(a[0] - a[1]).max() > 1e-6 * np.abs(a[0]).max()


def test_self_contact_beside_an_obstacle_keeps_layers_off_it():
    body = cloth((7, 7), (0.06, 0.06))
    ball = Sphere((0.0, 0.0, 0.1), 0.03)
    simulation = make_simulation(body, 1e-3, obstacles=(ball, Table()), self_contact=True)
    start = at_rest(body.rest + np.array([0.002, 0.001, 0.135]))
    final = jit_settle(simulation, start, 300)
    assert at(ball, final.position)[0].min() > 0.9 * body.radius
    assert np.isfinite(final.velocity).all()


def test_without_a_table_there_is_no_floor():
    body = cloth((5, 5), (0.1, 0.1), drag=0.0)
    for self_contact in (False, True):
        simulation = make_simulation(body, 1e-3, obstacles=(), self_contact=self_contact)
        final = jit_settle(simulation, at_rest(goals.flat(body)), 100)
        fallen = -9.81 * 1e-6 * 100 * 101 / 2  # semi-implicit Euler
        np.testing.assert_allclose(final.position[:, 2], body.radius + fallen, rtol=1e-4)


@pytest.mark.parametrize(("obstacles", "is_free"), [((), True), ((Table(),), False)])
def test_layers_below_the_height_of_the_table_part_evenly_without_one(obstacles, is_free):
    one = cloth((5, 5), (0.05, 0.05), drag=0.0)
    twice = ("mass", "families", "rest_length", "stiffness", "damping")
    apart = np.array([0.0, 0.0, 0.003])  # of a thickness of 4 mm
    body = replace(
        one,
        rest=np.concatenate([one.rest, one.rest + apart]),
        springs=np.concatenate([one.springs, one.springs + 25]),
        faces=np.concatenate([one.faces, one.faces + 25]),
        shape=(50,),
        **{name: np.tile(getattr(one, name), 2) for name in twice},
    )
    start = body.rest - np.array([0.0, 0.0, 1e-3])  # the lower layer; a table is at its radius
    simulation = make_simulation(body, 1e-3, 0.0, obstacles=obstacles, self_contact=True)
    final = jit_settle(simulation, at_rest(start), 1)
    lower, upper = (np.asarray(final.position)[half, 2] for half in (slice(25), slice(25, 50)))
    assert upper.mean() - lower.mean() > 0.0035
    moved = (lower - start[:25, 2]).mean()
    if is_free:
        assert moved == pytest.approx(-(upper - start[25:, 2]).mean(), rel=1e-3)
    else:
        assert moved > 0  # the table lifts it


# --- the door -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("obstacle", "message"),
    [
        (Sphere((0, 0, 0), -0.1), "Sphere: radius is -0.1; give metres above zero"),
        (Sphere((0, 0, np.nan), 0.1), r"Sphere: center is \(0, 0, nan\); give three finite"),
        (
            Capsule((0, 0, 1), (0, 0, 1), 0.1),
            r"start and end are both \(0, 0, 1\); give two points .* or a Sphere",
        ),
        (Capsule((0, 0, 1), (0, 0, 2), np.inf), "Capsule: radius is inf; give a finite number"),
        (Plane((0, 0, 0), (0, 0, 0)), r"Plane: normal is \(0, 0, 0\); give a direction"),
        (Box((0, 0, 0), (1, 0, 1)), r"Box: half_sizes is \(1, 0, 1\); give metres above zero"),
        (Box((0, 0, 0), (1, 1, 0.1), 0.2), r"rounding is 0.2 m; give zero or more, and at most"),
        (Box((0, 0, 0), (1, 1, 1), -0.1), r"rounding is -0.1 m"),
    ],
)
def test_obstacles_refuse(obstacle, message):
    with pytest.raises(ValueError, match=message):
        make_simulation(rope(5, 0.1), 1e-3, obstacles=(obstacle,))


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize(
    ("obstacle", "message"),
    [
        (lambda: "table", r"obstacles has 'table'; give Table\(\)"),
        (lambda: Table, r"obstacles has <class .*Table'>; give Table\(\)"),
        (lambda: Sphere((0.0, 0.0), 0.1), r"center is \(0, 0\); give three finite numbers"),
        (lambda: Sphere((0, 0, 0), (0.1, 0.2)), r"radius is \(0.1, 0.2\); give a finite number"),
    ],
)
def test_what_is_no_obstacle_is_refused(obstacle, message):
    with pytest.raises(ValueError, match=message):
        make_simulation(rope(5, 0.1), 1e-3, obstacles=(obstacle(),))


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize(
    ("obstacles", "message"),
    [
        (Table(), r"obstacles is Table\(\); give a tuple of them"),
        (
            lambda: (Sphere(("a", 0.0, 0.0), 0.1),),
            r"center is \('a', 0.0, 0.0\); give three finite numbers",
        ),
        ((Sphere((0.0, 0.0, 0.0), 1e7),), r"radius is 1e\+07; give a finite number up to 1e\+06"),
        ((Plane((0, 0, 0), (0, 0, 1e-30)),), r"normal is .* length of 1e-06 to 1e\+06"),
        ((Capsule((0, 0, 1), (0, 0, 1 + 1e-9), 0.1),), "start and end are both"),
    ],
)
def test_what_float32_cannot_square_is_refused(obstacles, message):
    obstacles = obstacles() if isinstance(obstacles, FunctionType) else obstacles
    with pytest.raises(ValueError, match=message):
        make_simulation(rope(5, 0.1), 1e-3, obstacles=obstacles)


def thin(radius):
    return {
        "Sphere: radius": Sphere((0, 0, 0.2), radius),
        "Capsule: radius": Capsule((0, -1, 0.2), (0, 1, 0.2), radius),
        "Box: half_sizes": Box((0, 0, 0.2), (0.2, radius, 0.2), radius / 2),
    }


@pytest.mark.parametrize("name", thin(0.1))
def test_an_obstacle_that_slips_between_particles_is_refused(name):
    body = cloth((9, 9))
    least = least_radius(body)
    make_simulation(body, 1e-3, obstacles=(thin(least)[name],))
    with pytest.raises(ValueError, match=rf"{name} is .* gaps of radius .* thinner than .* slip"):
        make_simulation(body, 1e-3, obstacles=(thin(0.99 * least)[name],))


def test_gaps_are_radii_of_balls_between_particles():
    assert gap(rope(11, 0.5)) == pytest.approx(0.025)
    uneven = rope_along(np.array([[0.0, 0, 0], [0.1, 0, 0], [0.4, 0, 0], [0.5, 0, 0]]))
    assert gap(uneven) == pytest.approx(0.15)
    assert gap(cloth((5, 5), (0.2, 0.2))) == pytest.approx(0.05 / np.sqrt(2))
    # Of equilateral triangles of side s: s / sqrt(3).
    up = 0.1 * np.sqrt(0.75)
    corners = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.05, up, 0], [0.15, up, 0]])
    sheet = from_mesh(corners, np.array([[0, 1, 2], [1, 3, 2]]))
    assert gap(sheet) == pytest.approx(0.1 / np.sqrt(3))
    # Of three particles in a line, half their distance.
    line = replace(sheet, rest=corners * [1.0, 0, 0])
    assert gap(line) == pytest.approx(0.05)
    body = rope(11, 0.5)
    assert least_radius(body) == pytest.approx(LEAST_SIZE * 0.025 - body.radius)
    assert least_radius(rope(11, 0.01)) == 0


@pytest.mark.parametrize(("share", "holds"), [(1.0, True), (0.4, False)])
def test_a_rope_pulled_over_the_thinnest_bar_does_not_slip_through_it(share, holds):
    # Both ends are pulled down by 0.2 m in 0.3 s; the rope then has 1.3 times its length.
    body = rope(21)
    bar = Capsule((0.0, -0.5, 1.0), (0.0, 0.5, 1.0), share * least_radius(body))
    dt = 0.9 * largest_time_step(body)
    made = make_obstacles((bar,), rope(500))  # a rope that no bar slips through
    simulation = replace(make_simulation(body, dt), obstacles=made)
    start = body.rest + np.array([0.0125, 0.0, 1.0 + bar.radius + body.radius + 1e-4])
    down = jnp.array([[[0.0, 0.0, -0.2]] * 2])
    pickers = make_pickers(WIDE, max_stretch=10.0, steps=round(0.3 / dt))
    final, _ = jit_rollout(simulation, pickers, at_rest(start), Actions(jnp.array([[0, 20]]), down))
    assert (float(final.position[10, 2]) > 1.0) == holds


def test_obstacles_are_trees_of_arrays():
    made = make_obstacles(tuple(EVERY.values()), rope(5, 0.01))
    for obstacle in made:
        leaves = jax.tree.leaves(obstacle)
        assert len(leaves) == len(fields(obstacle))
        assert all(isinstance(leaf, jax.Array) and leaf.dtype == jnp.float32 for leaf in leaves)
        assert jax.tree.structure(jax.tree.map(lambda leaf: leaf[None], obstacle)) is not None
