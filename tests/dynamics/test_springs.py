"""Springs by offset and by neighbour are the same physics, and a batch changes nothing."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsimp import goals
from jaxsimp.bodies import Body, cloth, rope
from jaxsimp.dynamics import Actions, Simulation, State, make_pickers, make_simulation, rollout
from jaxsimp.dynamics import springs as springs_module
from jaxsimp.dynamics.springs import pull, spring_tensions

BODIES = {"rope": rope(9, 0.2), "cloth": cloth((5, 4))}
bodies = pytest.mark.parametrize("body", BODIES.values(), ids=BODIES)


@pytest.fixture
def by_neighbour(monkeypatch):
    """A simulation whose springs are stored by neighbour."""

    def make(body: Body, time_step: float = 1e-3) -> Simulation:
        with monkeypatch.context() as patch:
            patch.setattr(springs_module, "MOST_OFFSETS", 0)
            return make_simulation(body, time_step)

    return make


def random_state(body: Body, seed: int = 0) -> State:
    rng = np.random.default_rng(seed)
    shape = body.rest.shape
    start = goals.flat(body) + rng.uniform(0.0, 0.2 * body.spacing, shape)
    return State(jnp.asarray(start, dtype=float), jnp.asarray(rng.normal(size=shape), dtype=float))


def random_actions(body: Body, *batch: int) -> Actions:
    rng = np.random.default_rng(1)
    pick = rng.permuted(np.tile(np.arange(body.num_particles), (*batch, 3, 1)), axis=-1)[..., :2]
    move = rng.uniform(-0.02, 0.02, (*batch, 3, 2, 3))
    return Actions(jnp.asarray(pick), jnp.asarray(move, dtype=float))


def slow_forces(body: Body, state: State) -> np.ndarray:
    """Spring by spring, in float64 NumPy, straight from Hooke's law."""
    position, velocity = np.asarray(state.position, float), np.asarray(state.velocity, float)
    force = np.zeros_like(position)
    for (i, j), k, c, length in zip(
        body.springs, body.stiffness, body.damping, body.rest_length, strict=True
    ):
        along = position[j] - position[i]
        distance = np.linalg.norm(along)
        rate = along @ (velocity[j] - velocity[i]) / distance
        pulled = (k * (distance - length) + c * rate) * along / distance
        force[i] += pulled
        force[j] -= pulled
    return force


@bodies
@pytest.mark.parametrize("stored", ["by offset", "by neighbour"])
def test_forces_equal_hookes_law_spring_by_spring(body, stored, by_neighbour):
    simulation = (make_simulation if stored == "by offset" else by_neighbour)(body, 1e-3)
    springs, state = simulation.springs, random_state(body)
    assert (len(springs.neighbours) > 0) == (stored == "by neighbour")
    halo = ((0, 0), (springs.halo, springs.halo))
    packed = jnp.pad(state.position.T, halo), jnp.pad(state.velocity.T, halo)
    found = jnp.stack(pull(springs, spring_tensions(springs, *packed), packed[0])).T
    expected = slow_forces(body, state)
    # float32 sums of a dozen forces of this size
    np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())


@pytest.mark.parametrize("seed", range(3))
def test_a_body_with_its_particles_renamed_moves_the_same(seed):
    body = cloth((12, 12))
    new = np.random.default_rng(seed).permutation(body.num_particles)  # old id of each particle
    old = np.argsort(new)
    renamed = replace(body, rest=body.rest[new], mass=body.mass[new], springs=old[body.springs])
    state, actions = random_state(body), random_actions(body)
    simulation, pickers = make_simulation(renamed, 1e-3), make_pickers(steps=20)
    assert len(simulation.springs.neighbours) > 0  # far too many offsets
    final, _ = rollout(make_simulation(body, 1e-3), pickers, state, actions)
    found, _ = rollout(
        simulation,
        pickers,
        State(state.position[new], state.velocity[new]),
        Actions(jnp.asarray(old)[actions.pick], actions.displacement),
    )
    # Other orders of summation: float32 rounding of 0.3 m, grown over 60 steps.
    np.testing.assert_allclose(found.position[old], final.position, atol=2e-6)


@bodies
@pytest.mark.slow
@pytest.mark.usefixtures("x64")
def test_gradients_do_not_depend_on_the_storage(body, by_neighbour):
    state, actions, pickers = random_state(body), random_actions(body), make_pickers(steps=10)
    weights = np.random.default_rng(2).normal(size=body.rest.shape)

    def gradient(simulation: Simulation):
        def loss(inputs):
            scale, start, move = inputs
            springs = simulation.springs
            tables = {
                name: getattr(springs, name) * scale[name] for name in scale if name != "shortest"
            }
            changed = replace(
                simulation,
                springs=replace(springs, shortest=springs.shortest * scale["shortest"], **tables),
            )
            final, _ = rollout(changed, pickers, start, Actions(actions.pick, move))
            return jnp.sum(weights * final.position) + 0.1 * jnp.sum(weights * final.velocity)

        names = ("stiffness", "damping", "rest_length", "shortest")
        ones = {name: jnp.array(1.0) for name in names}
        return jax.jit(jax.grad(loss))((ones, state, actions.displacement))

    near = state.position.at[1].set(state.position[0] + 1e-7)  # a spring under `shortest`
    state = State(near, state.velocity)
    found, expected = gradient(by_neighbour(body)), gradient(make_simulation(body, 1e-3))
    assert abs(expected[0]["shortest"]) > 0
    # The same derivative in another order of operations: float64 rounding of 30 steps.
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-7, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("stored", ["by offset", "by neighbour"])
def test_a_batch_is_a_loop_over_its_samples(stored, by_neighbour):
    body = BODIES["cloth"]
    simulation = (make_simulation if stored == "by offset" else by_neighbour)(body, 1e-3)
    pickers, state, actions = make_pickers(steps=15), random_state(body), random_actions(body, 4)
    frictions = jnp.array([0.0, 0.3, 0.6, 2.0])

    def one(actions: Actions, friction: jax.Array) -> State:
        return rollout(replace(simulation, friction=friction), pickers, state, actions)[0]

    loop = [
        jax.jit(one)(jax.tree.map(lambda leaf, i=i: leaf[i], actions), frictions[i])
        for i in range(4)
    ]
    alone = [jax.jit(one)(jax.tree.map(lambda leaf, i=i: leaf[i], actions), 0.3) for i in range(4)]
    both = jax.jit(jax.vmap(one))(actions, frictions)  # batched physics
    moves = jax.jit(jax.vmap(one, (0, None)))(actions, 0.3)  # one physics
    twice = jax.jit(jax.vmap(jax.vmap(one, (0, None)), (0, None)))(
        jax.tree.map(lambda leaf: leaf.reshape(2, 2, *leaf.shape[1:]), actions), 0.3
    )
    # The same operations, fused in other ways: float32 rounding of 0.3 m over 45 steps.
    for i in range(4):
        np.testing.assert_allclose(both.position[i], loop[i].position, atol=2e-6)
        np.testing.assert_allclose(moves.position[i], alone[i].position, atol=2e-6)
        np.testing.assert_allclose(twice.position[i // 2, i % 2], alone[i].position, atol=2e-6)


@pytest.mark.usefixtures("x64")
def test_gradients_of_a_body_without_springs():
    body = rope(2, 0.1)
    none = np.zeros(0)
    body = replace(
        body,
        springs=np.zeros((0, 2), dtype=body.springs.dtype),
        families=np.zeros(0, dtype=int),
        rest_length=none,
        stiffness=none,
        damping=none,
    )
    simulation, pickers = make_simulation(body, 1e-3), make_pickers(steps=10)
    idle = Actions(jnp.full((1, 2), -1), jnp.zeros((1, 2, 3)))
    start = State(jnp.asarray(body.rest + 1.0), jnp.zeros((2, 3)))

    def height(gravity: jax.Array) -> jax.Array:
        final, _ = rollout(
            replace(simulation, gravity=gravity, drag=0.0 * gravity), pickers, start, idle
        )
        return final.position[0, 2]

    # Semi-implicit Euler: n steps of dt fall g dt^2 n (n + 1) / 2.
    found = jax.grad(height)(jnp.array(9.81))
    np.testing.assert_allclose(found, -1e-6 * 55, rtol=1e-9)
