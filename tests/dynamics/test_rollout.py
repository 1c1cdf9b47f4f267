"""Motion: against a slow implementation with loops, and against mechanics in closed form."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from jaxsimp import goals
from jaxsimp.bodies import MATERIALS, Body, cloth, rope
from jaxsimp.dynamics import (
    NONE,
    Actions,
    Simulation,
    State,
    at_rest,
    largest_time_step,
    make_pickers,
    make_simulation,
    rollout,
    settle,
)

G = 9.81
# jitted once, so that tests on bodies with the same springs share what was compiled
jit_settle = jax.jit(settle, static_argnames="num_steps")


def irregular(seed: int = 0, num_particles: int = 9, num_springs: int = 16) -> Body:
    """A body with springs between random particles, and a different value for each of them."""
    rng = np.random.default_rng(seed)
    pairs = np.array([(i, j) for i in range(num_particles) for j in range(num_particles) if i < j])
    pairs = rng.permuted(rng.permutation(pairs)[:num_springs], axis=1)  # ends in either order
    rest = rng.uniform(-0.1, 0.1, (num_particles, 3))
    return Body(
        name="irregular body",
        rest=rest,
        mass=rng.uniform(0.01, 0.03, num_particles),
        springs=pairs,
        families=np.zeros(num_springs, dtype=int),
        rest_length=np.linalg.norm(np.diff(rest[pairs], axis=1)[:, 0], axis=1),
        stiffness=rng.uniform(10.0, 50.0, num_springs),
        damping=rng.uniform(0.0, 0.05, num_springs),
        faces=np.zeros((0, 3), dtype=int),
        material=MATERIALS["rope"].changed(thickness=0.01, drag=0.7, friction=0.4),
        shape=(num_particles,),
    )


def one_particle(friction: float = 0.5, drag: float = 0.0) -> Body:
    return replace(
        rope(2, drag=drag, friction=friction),
        name="particle",
        rest=np.zeros((1, 3)),
        mass=np.array([0.02]),
        springs=np.zeros((0, 2), dtype=int),
        families=np.zeros(0, dtype=int),
        rest_length=np.zeros(0),
        stiffness=np.zeros(0),
        damping=np.zeros(0),
        shape=(1,),
    )


def in_air(body: Body, **changes: float) -> Simulation:
    """The body's simulation, without gravity unless `gravity` is given."""
    return make_simulation(body, **{"gravity": 0.0, "time_step": 1e-3} | changes)


def state_of(position: np.ndarray, velocity: np.ndarray) -> State:
    return State(jnp.asarray(position, dtype=float), jnp.asarray(velocity, dtype=float))


def trajectory(simulation: Simulation, state: State, samples: int, every: int = 1) -> State:
    """States after each `every` time steps with nothing held, stacked along a first axis."""
    idle = Actions(jnp.full((samples, 1), NONE), jnp.zeros((samples, 1, 3)))
    pickers = make_pickers(steps=every)
    run = jax.jit(lambda *args: rollout(*args, observe=lambda state: state))
    return run(simulation, pickers, state, idle)[1]


# --- a slow implementation, with loops over springs and particles ------------------------------


def slow_step(body, x, v, dt, gravity, carried):
    """One time step. `carried` maps the ids of held particles to their velocity."""
    force = np.zeros_like(x)
    for (i, j), k, c, rest in zip(
        body.springs, body.stiffness, body.damping, body.rest_length, strict=True
    ):
        between = x[j] - x[i]
        length = np.sqrt(between @ between)
        towards = between / length
        pull = k * (length - rest) + c * (v[j] - v[i]) @ towards
        force[i] += pull * towards
        force[j] -= pull * towards
    new_x, new_v = x.copy(), v.copy()
    for i in range(len(x)):
        if i in carried:
            new_v[i] = carried[i]
        else:
            a = force[i] / body.mass[i] - body.material.drag * v[i] - np.array([0.0, 0.0, gravity])
            new_v[i] = slow_contact(body, x[i, 2], v[i] + dt * a, dt)
        new_x[i] = x[i] + dt * new_v[i]
    return new_x, new_v


def slow_contact(body, z, v, dt):
    """The velocity of one particle after contact with the table, by cases."""
    lands_at = z + dt * v[2]
    if lands_at >= body.radius:
        return v
    normal_impulse = (body.radius - lands_at) / dt  # per unit of mass
    v_tangent, speed = v[:2], np.hypot(*v[:2])
    if speed <= body.material.friction * normal_impulse:
        v_tangent = np.zeros(2)
    else:
        v_tangent = v_tangent - body.material.friction * normal_impulse * v_tangent / speed
    return np.array([*v_tangent, v[2] + normal_impulse])


def slow_rollout(body, x, v, dt, gravity, picks, displacements, steps):
    """Positions after each action. Within the limits and the stretch rule, above the table."""
    profile = np.array([(i + 0.5) * (steps - i - 0.5) for i in range(steps)])
    profile /= profile.sum()
    seen = []
    for pick, displacement in zip(picks, displacements, strict=True):
        for share in profile:
            held = {p: d * share / dt for p, d in zip(pick, displacement, strict=True) if p >= 0}
            x, v = slow_step(body, x, v, dt, gravity, held)
        seen.append(x)
    return np.array(seen), x, v


def lifted(body: Body, seed: int, height: float) -> np.ndarray:
    """The rest shape, roughened by a tenth of a spring and lifted above the table."""
    rough = np.random.default_rng(seed).uniform(-0.1, 0.1, body.rest.shape) * body.spacing
    position = body.rest + rough
    position[:, 2] += height - position[:, 2].min() + body.radius
    return position


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize(
    ("body", "time_step"),
    [(rope(11, 0.2), 2e-3), (cloth((5, 4), (0.1, 0.08)), 4e-3), (irregular(), 2e-3)],
    ids=["rope", "cloth", "irregular"],
)
def test_agrees_with_loops_over_springs(body, time_step):
    last, steps = body.num_particles - 1, 100
    picks = np.array([[0, last], [NONE, 2], [NONE, NONE]])
    displacements = np.random.default_rng(1).uniform(0.0, 0.05, (3, 2, 3))
    start = lifted(body, 2, 2e-3)
    speed = np.random.default_rng(3).uniform(-0.2, 0.2, start.shape)
    simulation = make_simulation(body, time_step)
    run = jax.jit(rollout)
    final, seen = run(
        simulation,
        make_pickers(max_stretch=100.0, steps=steps),
        state_of(start, speed),
        Actions(jnp.asarray(picks), jnp.asarray(displacements)),
    )
    slow_seen, x, v = slow_rollout(body, start, speed, time_step, G, picks, displacements, steps)
    # It moved: held, sliding and landing particles are among them.
    assert np.abs(slow_seen[0] - start).max() > 0.01
    assert (x[:, 2] < body.radius + 1e-9).any()
    # Rounding is 1e-16 a step; 300 steps of a motion that is not chaotic, but that buckles,
    # multiply it by some thousands at most.
    np.testing.assert_allclose(seen, slow_seen, rtol=1e-10, atol=1e-11)
    np.testing.assert_allclose(final.position, x, rtol=1e-10, atol=1e-11)
    np.testing.assert_allclose(final.velocity, v, rtol=1e-9, atol=1e-10)


# --- particles alone ---------------------------------------------------------------------------


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("drag", [0.0, 2.0])
def test_free_fall_in_closed_form(drag):
    dt, n = 1e-2, np.arange(1, 51)
    simulation = in_air(one_particle(drag=drag), gravity=G, time_step=dt)
    seen = trajectory(simulation, at_rest(np.array([[0.1, -0.2, 10.0]])), 50)
    fallen = 10.0 - np.asarray(seen.position)[:, 0, 2]
    if drag == 0.0:
        # v_n = n g dt, summed: half of g t^2, and the t dt / 2 that semi-implicit Euler adds.
        speed, wanted = G * dt * n, G * dt**2 * n * (n + 1) / 2
        np.testing.assert_allclose(wanted - G * (n * dt) ** 2 / 2, G * n * dt * dt / 2, rtol=1e-9)
    else:
        # v_{n+1} = q v_n + g dt with q = 1 - drag dt: a geometric series, summed twice.
        q = 1 - drag * dt
        speed = G / drag * (1 - q**n)
        wanted = G / drag * (n * dt - dt * q * (1 - q**n) / (1 - q))
    # 50 roundings of numbers of size 10.
    np.testing.assert_allclose(fallen, wanted, atol=1e-12)
    np.testing.assert_allclose(-np.asarray(seen.velocity)[:, 0, 2], speed, atol=1e-12)
    np.testing.assert_array_equal(seen.position[:, 0, :2], np.tile([0.1, -0.2], (50, 1)))


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("friction", [0.2, 0.7])
def test_a_particle_slides_as_far_as_coulomb_says(friction):
    dt, speed = 1e-3, 1.5
    body = one_particle(friction)
    along = np.array([0.6, 0.8, 0.0])
    start = state_of(np.array([[0.0, 0.0, body.radius]]), speed * along[None])
    final = jit_settle(in_air(body, gravity=G, time_step=dt), start, 2000)
    # Each step takes mu g dt from the speed, until less is left.
    steps = int(speed / (friction * G * dt))
    slid = np.linalg.norm(final.position[0, :2])
    np.testing.assert_allclose(slid, dt * sum(speed - friction * G * dt * np.arange(1, steps + 1)))
    # The continuum: off by half a step at the first speed, less one step of friction.
    np.testing.assert_allclose(slid, speed**2 / (2 * friction * G), atol=speed * dt)
    np.testing.assert_allclose(final.position[0], [*slid * along[:2], body.radius], atol=1e-12)
    np.testing.assert_array_equal(final.velocity, 0.0)


@pytest.mark.usefixtures("x64")
def test_a_flat_cloth_slides_as_one_particle_does():
    dt, speed = 2e-3, 1.0
    body = cloth((4, 4), (0.1, 0.1), drag=0.0)
    start = goals.flat(body)
    velocity = np.tile([0.0, speed, 0.0], (16, 1))
    final = jit_settle(make_simulation(body, dt), state_of(start, velocity), 500)
    moved = np.asarray(final.position) - start
    # Springs stay unstretched, so all slide alike; within a step of v^2 / 2 mu g.
    np.testing.assert_allclose(moved, np.tile(moved[0], (16, 1)), atol=1e-12)
    np.testing.assert_allclose(moved[0], [0, speed**2 / (2 * 0.5 * G), 0], atol=speed * dt)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize(("part_of_cone", "moves"), [(0.98, False), (1.02, True)])
def test_static_friction_holds_inside_the_cone(part_of_cone, moves):
    body = rope(2, 0.1, friction=0.4)
    weight = body.mass[0] * G
    stretch = part_of_cone * 0.4 * weight / body.stiffness[0]
    start = goals.straight(body, 0.1 + stretch)
    final = jit_settle(make_simulation(body, 1e-3), at_rest(start), 500)
    still = np.abs(np.asarray(final.position) - start).max()
    if moves:
        # It stops where the spring's force has fallen below the cone's: past 1.00.
        assert still > 0.01 * stretch
    else:
        np.testing.assert_array_equal(np.asarray(final.position), start)


@given(
    height=st.floats(0.0, 0.3),
    velocity=st.tuples(*[st.floats(-3.0, 3.0)] * 2, st.floats(-5.0, 0.0)),
    friction=st.floats(0.0, 2.0),
)
def test_landing_takes_what_coulomb_allows(height, velocity, friction):
    # Inelastic: it ends on the table and stays, and its sideways speed fell by mu times the
    # normal impulse, or to zero. One particle, so float32 rounding only: 1e-7 of 5 m/s.
    dt = 1e-2
    body = one_particle(friction)
    start = state_of(np.array([[0.0, 0.0, body.radius + height]]), np.array([velocity]))
    final = jit_settle(in_air(body, gravity=0.0, time_step=dt), start, 1)
    wanted = slow_contact(body, body.radius + height, np.array(velocity), dt)
    np.testing.assert_allclose(final.velocity[0], wanted, atol=1e-5)
    assert final.position[0, 2] >= body.radius - 1e-7


# --- springs -----------------------------------------------------------------------------------


@pytest.mark.usefixtures("x64")
def test_period_of_a_spring():
    body = replace(
        rope(2, 0.1, stretch_stiffness=20.0, damping=0.0, drag=0.0), mass=np.array([0.01, 0.03])
    )
    period = 2 * np.pi * np.sqrt((0.01 * 0.03 / 0.04) / 20.0)
    dt = period / 200
    start = at_rest(np.array([[0.0, 0.0, 1.0], [0.12, 0.0, 1.0]]))
    seen = trajectory(in_air(body, time_step=dt), start, 1100)
    stretch = np.asarray(seen.position[:, 1, 0] - seen.position[:, 0, 0]) - 0.1
    rising = np.flatnonzero((stretch[:-1] < 0) & (stretch[1:] >= 0))
    times = dt * (rising - stretch[rising] / (stretch[rising + 1] - stretch[rising]))
    assert len(times) == 5
    # Semi-implicit Euler runs fast by (omega dt)^2 / 24 = 4e-5; a linear interpolation of a
    # zero crossing errs by far less.
    np.testing.assert_allclose(np.diff(times), period, rtol=1e-4)


@pytest.mark.usefixtures("x64")
def test_momentum_and_angular_momentum_are_kept():
    body = irregular().scaled(drag=0.0)
    velocity = np.random.default_rng(5).normal(size=body.rest.shape)
    start = state_of(body.rest + np.array([0.0, 0.0, 20.0]), velocity)
    final = jit_settle(in_air(body), start, 2000)
    mass = body.mass[:, None]

    def momenta(state):
        x, v = np.asarray(state.position), np.asarray(state.velocity)
        return (mass * v).sum(0), (mass * np.cross(x, v)).sum(0)

    assert np.abs(np.asarray(final.velocity) - velocity).max() > 0.5
    # Forces act between pairs along their line, so semi-implicit Euler keeps both exactly:
    # what is left is the rounding of 2000 steps (1e-16 each, arms of 20 m).
    for before, after in zip(momenta(start), momenta(final), strict=True):
        np.testing.assert_allclose(after, before, atol=1e-11)


def energy(body: Body, states: State, gravity: float) -> np.ndarray:
    """Kinetic, elastic and potential energy of a stack of states, joules."""
    x, v = np.asarray(states.position), np.asarray(states.velocity)
    length = np.linalg.norm(np.diff(x[:, body.springs], axis=2)[:, :, 0], axis=-1)
    elastic = (body.stiffness * (length - body.rest_length) ** 2).sum(-1) / 2
    kinetic = (body.mass * (v**2).sum(-1)).sum(-1) / 2
    return kinetic + elastic + gravity * (body.mass * x[..., 2]).sum(-1)


@pytest.mark.usefixtures("x64")
def test_energy_stays_without_damping():
    body = irregular().scaled(drag=0.0, damping=0.0)
    velocity = np.random.default_rng(6).normal(size=body.rest.shape)
    dt = 0.05 * largest_time_step(body)
    start = state_of(body.rest + np.array([0.0, 0.0, 500.0]), velocity)
    found = energy(body, trajectory(in_air(body, time_step=dt), start, 1000, every=10), 0.0)
    first = energy(body, jax.tree.map(lambda leaf: leaf[None], start), 0.0)
    # A symplectic method errs by omega dt / 2 = 0.05 of an oscillator's energy, back and forth,
    # and does not drift in 10,000 steps, where explicit Euler multiplies by exp(40).
    np.testing.assert_allclose(found, first.item(), rtol=0.06)
    np.testing.assert_allclose(found[-200:].mean(), found[:200].mean(), rtol=0.01)


@pytest.mark.usefixtures("x64")
def test_energy_falls_with_damping():
    body = irregular()
    velocity = np.random.default_rng(7).normal(size=body.rest.shape)
    start = state_of(body.rest + np.array([0.0, 0.0, 500.0]), velocity)
    states = trajectory(in_air(body), start, 20, every=100)
    found = energy(body, states, 0.0)
    assert (np.diff(found) < 0).all()
    assert found[-1] < 0.2 * found[0]


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("seed", range(3))
def test_energy_falls_in_contact(seed):
    body = rope(11, 0.2)
    simulation = make_simulation(body, 1e-3)
    # Dropped, thrown and crumpled.
    rng = np.random.default_rng(seed)
    position = body.rest * [0.5, 1, 1] + rng.uniform(0.0, 0.02, body.rest.shape)
    position[:, 2] += 0.02
    start = state_of(position, rng.normal(size=position.shape))
    found = energy(body, trajectory(simulation, start, 40, every=50), G)
    # The energy of semi-implicit Euler sways about the true one by omega dt / 2; the springs
    # hold well under a hundredth of the energy that is lost.
    assert (np.diff(found) < 1e-3 * np.ptp(found)).all()
    assert found[-1] < 0.2 * found[0]


@pytest.mark.usefixtures("x64")
def test_first_order_in_the_time_step():
    body = irregular()
    velocity = np.random.default_rng(8).normal(size=body.rest.shape) * 0.3
    x, duration = body.rest + np.array([0.0, 0.0, 5.0]), 0.32

    first, second = body.springs.T

    def rate(_, y):
        x, v = y.reshape(2, -1, 3)
        between, apart = x[second] - x[first], v[second] - v[first]
        length = np.linalg.norm(between, axis=1)
        towards = between / length[:, None]
        pull = body.stiffness * (length - body.rest_length)
        pull += body.damping * (apart * towards).sum(axis=1)
        force = np.zeros_like(x)
        np.add.at(force, first, pull[:, None] * towards)
        np.add.at(force, second, -pull[:, None] * towards)
        a = force / body.mass[:, None] - body.material.drag * v - [0.0, 0.0, G]
        return np.concatenate([v, a]).ravel()

    exact = solve_ivp(
        rate, (0, duration), np.concatenate([x, velocity]).ravel(), rtol=1e-8, atol=1e-9
    ).y[:, -1]
    exact = exact.reshape(2, -1, 3)[0]
    errors = []
    for steps in (160, 320, 640):
        simulation = in_air(body, gravity=G, time_step=duration / steps)
        final = jit_settle(simulation, state_of(x, velocity), steps)
        errors.append(np.abs(np.asarray(final.position) - exact).max())
    assert errors[0] < 0.02
    # Halving the step halves the error; what is second order is a few per cent of it here.
    np.testing.assert_allclose(np.divide(errors[:-1], errors[1:]), 2.0, rtol=0.06)


# --- a hanging rope ----------------------------------------------------------------------------


def funicular(body: Body, span: float) -> np.ndarray:
    """Equilibrium of masses on springs between two supports at the same height, shape (N, 2).

    The horizontal tension is the same in all springs, the vertical one changes by a weight at
    each particle; a spring lies along its tension and is as much longer as Hooke says.
    """
    links = len(body.rest) - 1
    vertical = body.mass[0] * G * (np.arange(links) - (links - 1) / 2)
    length, k = body.rest_length[:links], body.stiffness[:links]

    def legs(horizontal: float) -> np.ndarray:
        tension = np.stack([np.full(links, horizontal), vertical], axis=1)
        size = np.linalg.norm(tension, axis=1)
        return tension * ((length + size / k) / size)[:, None]

    horizontal = brentq(lambda h: legs(h)[:, 0].sum() - span, 1e-6, 100.0, xtol=1e-15)
    return np.concatenate([np.zeros((1, 2)), np.cumsum(legs(horizontal), axis=0)])


@pytest.mark.usefixtures("x64")
def test_a_hanging_rope_is_a_catenary():
    length, span, n = 0.5, 0.4, 41
    body = rope(n, length, stretch_stiffness=2000.0, bend_stiffness=0.0, damping=0.05, drag=8.0)
    # Starts as a V with legs of the rest length.
    half = np.abs(np.linspace(-1, 1, n))
    sag = np.sqrt(length**2 - span**2) / 2
    start = np.stack([np.linspace(0, span, n), np.zeros(n), 1.0 - sag * (1 - half)], axis=1)
    simulation = make_simulation(body, 0.9 * largest_time_step(body))
    hold = Actions(jnp.tile(jnp.array([0, n - 1]), (20, 1)), jnp.zeros((20, 2, 3)))
    final, _ = jax.jit(rollout)(simulation, make_pickers(steps=600), at_rest(start), hold)
    found = np.asarray(final.position) - start[0]
    # It came to rest: swings of 8 rad/s and more, damped by exp(-4 t) for 4.5 s.
    assert np.abs(np.asarray(final.velocity)).max() < 1e-5
    np.testing.assert_allclose(found[:, [0, 2]], funicular(body, span), atol=1e-6)
    np.testing.assert_allclose(found[:, 1], 0.0, atol=1e-12)
    # The catenary y = a cosh(x / a) of that span, and of that length once it is stretched.
    stretched = np.linalg.norm(np.diff(found, axis=0), axis=1).sum()
    np.testing.assert_allclose(stretched, length, rtol=0.01)
    a = brentq(lambda a: 2 * a * np.sinh(span / (2 * a)) - stretched, 0.05, 10.0)
    y = a * np.cosh((found[:, 0] - span / 2) / a) - a * np.cosh(span / (2 * a))
    # Its links are chords: off by order 1 / 40^2 of the sag. A parabola would be off by 2 %.
    np.testing.assert_allclose(found[:, 2], y, atol=0.001 * -y.min())


# --- the table ---------------------------------------------------------------------------------


def test_nothing_sinks_through_the_table():
    body = rope(8, 0.1)
    simulation, pickers = make_simulation(body, 1e-3), make_pickers(steps=20)

    @jax.jit
    def lowest(state, actions):
        def height(state):
            return state.position[:, 2].min()

        return rollout(simulation, pickers, state, actions, height)[1]

    @given(seed=st.integers(0, 2**32 - 1), speed=st.floats(0.0, 5.0), height=st.floats(0.0, 0.2))
    def check(seed, speed, height):
        rng = np.random.default_rng(seed)
        position = rng.uniform(0.0, 0.1, (8, 3)) * [1, 1, height] + [0, 0, body.radius]
        state = state_of(position, rng.normal(size=(8, 3)) * speed)
        picks, moves = rng.integers(-1, 8, (6, 2)), rng.uniform(-0.1, 0.1, (6, 2, 3))
        found = lowest(state, Actions(jnp.asarray(picks), jnp.asarray(moves, dtype=float)))
        # Float32: what is added to a height of 0.1 m is rounded to 1e-8 m.
        assert float(found.min()) >= body.radius - 1e-7

    check()


# --- compilation -------------------------------------------------------------------------------


@pytest.mark.usefixtures("x64")
def test_jit_agrees_with_no_jit():
    body = rope(6, 0.1)
    simulation, pickers = make_simulation(body, 2e-3), make_pickers(steps=10)
    state = at_rest(lifted(body, 0, 0.001))
    actions = Actions(jnp.array([[0, 5]]), jnp.full((1, 2, 3), 0.03))
    slow, _ = rollout(simulation, pickers, state, actions)
    fast, _ = jax.jit(rollout)(simulation, pickers, state, actions)
    # The same operations in another order: rounding, 10 steps of it.
    np.testing.assert_allclose(fast.position, slow.position, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(fast.velocity, slow.velocity, rtol=1e-12, atol=1e-12)


def test_new_values_do_not_trace_again():
    traces = []

    @jax.jit
    def run(simulation, pickers, state, actions):
        traces.append(1)
        return rollout(simulation, pickers, state, actions)[0].position

    body = rope(6, 0.1)
    for i in range(3):
        other = rope(6, 0.1 + 0.01 * i, stretch_stiffness=100.0 + i, friction=0.1 * i)
        run(
            make_simulation(other, 1e-3 - 1e-4 * i, gravity=9.0 + i),
            make_pickers((0.1 + i, 0.1, 0.1), max_stretch=1.2 + i, steps=4),
            at_rest(goals.flat(body) + 0.1 * i),
            Actions(jnp.array([[i, -1]]), jnp.full((1, 2, 3), 0.01 * i)),
        )
    assert len(traces) == 1
    # Sizes are static: this one does trace.
    run(
        make_simulation(body, 1e-3),
        make_pickers(steps=5),
        at_rest(goals.flat(body)),
        Actions(jnp.array([[0, -1]]), jnp.zeros((1, 2, 3))),
    )
    assert len(traces) == 2


@pytest.mark.usefixtures("x64")
def test_settle_is_a_rollout_that_holds_nothing():
    body = irregular()
    simulation = make_simulation(body, 1e-3)
    start = state_of(lifted(body, 0, 0.01), np.ones(body.rest.shape))
    idle = Actions(jnp.full((2, 2), NONE), jnp.ones((2, 2, 3)))
    final, _ = jax.jit(rollout)(simulation, make_pickers(steps=25), start, idle)
    settled = jit_settle(simulation, start, 50)
    # The same steps; compiled apart, so equal to rounding.
    np.testing.assert_allclose(final.position, settled.position, rtol=1e-11, atol=1e-13)
    np.testing.assert_allclose(final.velocity, settled.velocity, rtol=1e-11, atol=1e-11)


def test_a_batch_of_rollouts_is_a_loop_over_them():
    body = rope(6, 0.1)
    simulation, pickers = make_simulation(body, 1e-3), make_pickers(steps=20)
    rng = np.random.default_rng(0)
    # Held masks that differ in each row, one of them all off.
    picks = jnp.array([[[0, 5]], [[-1, -1]], [[3, -1]], [[2, 2]]])
    moves = jnp.asarray(rng.uniform(-0.05, 0.05, (4, 1, 2, 3)), dtype=float)
    starts = jnp.asarray(np.stack([lifted(body, i, 0.001) for i in range(4)]), dtype=float)
    batch = jax.tree.map(lambda leaf: jnp.stack([leaf] * 4), simulation)
    softer = batch.springs.stiffness * (jnp.arange(1.0, 5.0) / 4)[:, None, None]
    batch = replace(batch, springs=replace(batch.springs, stiffness=softer))

    def run(simulation, position, pick, move):
        return rollout(simulation, pickers, at_rest(position), Actions(pick, move))[0]

    together = jax.jit(jax.vmap(run))(batch, starts, picks, moves)
    one = jax.jit(run)
    for i in range(4):
        alone = one(jax.tree.map(lambda leaf, i=i: leaf[i], batch), starts[i], picks[i], moves[i])
        # Float32, 20 steps: 1e-7 of a metre, and of the speeds of a metre a second.
        np.testing.assert_allclose(together.position[i], alone.position, atol=2e-7)
        np.testing.assert_allclose(together.velocity[i], alone.velocity, atol=1e-4)
    assert np.abs(together.position[0] - together.position[1]).max() > 1e-3
