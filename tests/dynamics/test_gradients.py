"""Gradients of rollouts: finite differences, forward and reverse mode agree; finite anywhere.

Reverse mode of a rollout takes seconds to compile, so each test compiles it once.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from jaxsimp import goals
from jaxsimp.bodies import Body, cloth, rope
from jaxsimp.dynamics import NONE, Actions, State, make_pickers, make_simulation, rollout, springs
from jaxsimp.dynamics.springs import make_springs, pull, spring_tensions

# Most of the time is compilation; what is compared are derivatives and sums, not speed.

ROPE = rope(8, 0.2)
CLOTH = cloth((3, 2), (0.06, 0.03))


def chain(num_particles: int) -> Body:
    """A rope without bending: one offset, which compiles in half the time."""
    body, links = rope(num_particles, 0.1), num_particles - 1
    names = ("springs", "families", "rest_length", "stiffness", "damping")
    return replace(body, **{name: getattr(body, name)[:links] for name in names})


CHAIN = chain(5)


def problem(body: Body, time_step: float, picks: list[int], steps: int = 20, **options):
    """A weighed sum of a rollout's motion, and its end, as a function of some inputs."""
    simulation, pickers = make_simulation(body, time_step), make_pickers(steps=steps)
    weights = jnp.asarray(np.random.default_rng(0).normal(size=(2, *body.rest.shape)), dtype=float)
    pick = jnp.array([picks, picks[::-1]])

    def loss(inputs):
        springs = replace(
            simulation.springs, stiffness=simulation.springs.stiffness * inputs["stiffness"]
        )
        changed = replace(simulation, springs=springs, friction=inputs["friction"])
        state = State(inputs["start"], inputs["velocity"])
        final, seen = rollout(
            changed, pickers, state, Actions(pick, inputs["displacement"]), **options
        )
        return jnp.sum(weights * seen) + 0.01 * jnp.sum(weights[0] * final.velocity), final

    rng = np.random.default_rng(1)
    start = goals.flat(body) + rng.uniform(0.0, 1e-3, body.rest.shape)
    inputs = {
        "displacement": rng.uniform(-0.01, 0.01, (2, 2, 3)) + np.array([0.0, 0.0, 0.01]),
        "start": start,
        "velocity": rng.uniform(-0.3, 0.3, start.shape) * [1.0, 1.0, 0.1],
        "stiffness": np.array(1.1),
        "friction": np.array(0.3),
    }
    return loss, jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype=float), inputs)


def direction(inputs, name: str, seed: int):
    """A random direction in which only the input of that name changes."""
    rng = np.random.default_rng(seed)
    return {
        other: jnp.asarray(rng.normal(size=leaf.shape) * (other == name), dtype=float)
        for other, leaf in inputs.items()
    }


@pytest.mark.slow
@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize(
    ("body", "time_step", "picks"),
    [(ROPE, 2e-3, [0, NONE]), (CLOTH, 4e-3, [0, 5])],
    ids=["rope", "cloth"],
)
def test_reverse_forward_and_differences_agree(body, time_step, picks):
    loss, inputs = problem(body, time_step, picks)
    value = jax.jit(loss)
    reverse, final = jax.jit(jax.grad(loss, has_aux=True))(inputs)
    plain, _ = problem(body, time_step, picks, adjoint=False)
    forward = jax.jit(lambda along: jax.jvp(plain, (inputs,), (along,), has_aux=True)[1])
    # Some of it slides on the table, and some is above it.
    height = np.asarray(final.position[:, 2]) - body.radius
    sliding = np.linalg.norm(final.velocity[:, :2], axis=1) > 1e-3
    assert (sliding & (height < 1e-9)).any()
    assert (height > 1e-3).any()
    for seed, name in enumerate(inputs):
        along = direction(inputs, name, seed)
        by_reverse = float(sum(jnp.vdot(reverse[n], along[n]) for n in inputs))
        by_forward = float(forward(along))
        assert abs(by_reverse) > 1e-5, name  # it matters
        # The same derivative in another order of operations: rounding of 40 steps.
        np.testing.assert_allclose(by_forward, by_reverse, rtol=1e-9, err_msg=name)
        # Differences err by h^2 times a third derivative (stiff: 1 / (spacing / 10)^2), and by
        # 1e-16 / h: both near 1e-8 of the value at this h, off the kinks of contact.
        h = 1e-7
        ends = [
            float(value({n: inputs[n] + s * h * along[n] for n in inputs})[0]) for s in (1.0, -1.0)
        ]
        difference = (ends[0] - ends[1]) / (2 * h)
        np.testing.assert_allclose(difference, by_reverse, rtol=1e-5, err_msg=name)


@pytest.mark.slow
@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("by_neighbour", [False, True], ids=["by offset", "by neighbour"])
@pytest.mark.parametrize("names", [("displacement", "start"), ("displacement", "stiffness")])
def test_vmap_of_the_gradient_is_a_loop_over_it(names, by_neighbour, monkeypatch):
    # Cotangents of motions alone have the batch last, those of a simulation have it first.
    monkeypatch.setattr(springs, "MOST_OFFSETS", 0 if by_neighbour else springs.MOST_OFFSETS)
    loss, inputs = problem(CHAIN, 1e-3, [0, 4], steps=1)
    factors = jnp.array([1.0, 1.3, -0.7])
    moves = {name: jnp.stack([factor * inputs[name] for factor in factors]) for name in names}

    def one(changed):
        return loss(inputs | changed)[0]

    together = jax.jit(jax.vmap(jax.grad(one)))(moves)
    alone = jax.jit(jax.grad(one))
    for name in names:
        for index in range(len(factors)):
            wanted = alone({other: moves[other][index] for other in names})[name]
            # Rounding of 2 steps, relative to the largest derivative.
            atol = 1e-11 * float(jnp.abs(wanted).max())
            np.testing.assert_allclose(together[name][index], wanted, atol=atol)
        apart = np.abs(together[name][0] - together[name][1]).max()
        assert apart > 1e-3 * np.abs(together[name]).max()


@pytest.mark.slow
def test_memory_grows_with_the_square_root_of_the_steps():
    def memory(steps: int) -> int:
        loss, inputs = problem(cloth((7, 7), (0.1, 0.1)), 1e-3, [0, NONE], steps=steps)
        # What is set aside is decided after optimisation, of which there may be little.
        options = {"xla_backend_optimization_level": 0}
        gradient = jax.jit(jax.grad(lambda inputs: loss(inputs)[0]), compiler_options=options)
        return gradient.lower(inputs).compile().memory_analysis().temp_size_in_bytes

    # Sixteen times the steps: four times the states, and something that does not grow.
    assert memory(1024) <= 4.2 * memory(64)


def awkward_starts(body: Body) -> dict[str, np.ndarray]:
    flat = goals.flat(body)
    pair, line = flat.copy(), flat.copy()
    pair[1] = pair[0]
    line[:, 1:] = [0.0, body.radius]
    return {
        "flat": flat,
        "in the air": flat + np.array([0.0, 0.0, 0.1]),
        "in one point": np.tile(flat[:1], (len(flat), 1)),
        "two in one point": pair,
        "in a line": line,
        "below the table": flat - np.array([0.0, 0.0, 0.01]),
        "nearly in one point": flat[:1] + 1e-9 * flat,
    }


@pytest.mark.slow
@pytest.mark.parametrize("precise", [False, True], ids=["float32", "float64"])
def test_gradients_are_finite_everywhere(precise):
    with jax.enable_x64(precise):
        loss, _ = problem(CHAIN, 1e-3, [0, 4], steps=4)
        gradient = jax.jit(jax.value_and_grad(loss, has_aux=True))
        starts = awkward_starts(CHAIN)
        shape = CHAIN.rest.shape

        @given(
            kind=st.sampled_from(sorted(starts)),
            noise=st.sampled_from([0.0, 1e-12, 1e-6, 1e-2]),
            speed=st.sampled_from([0.0, 1e-20, 1e-6, 1.0]),
            move=st.sampled_from([0.0, 1e-9, 0.05, 10.0]),
            friction=st.sampled_from([0.0, 0.5, 100.0]),
            seed=st.integers(0, 2**32 - 1),
        )
        @example("flat", 0.0, 0.0, 0.0, 0.5, 0)
        @example("in one point", 0.0, 0.0, 0.0, 0.5, 0)
        @example("in one point", 0.0, 0.0, 0.05, 0.0, 0)
        @example("two in one point", 0.0, 0.0, 0.0, 0.5, 0)
        @example("nearly in one point", 0.0, 0.0, 0.0, 0.5, 0)
        @example("below the table", 0.0, 0.0, 10.0, 0.5, 0)
        def check(kind, noise, speed, move, friction, seed):
            rng = np.random.default_rng(seed)
            values = {
                "displacement": move * rng.uniform(-1, 1, (2, 2, 3)),
                "start": starts[kind] + noise * rng.uniform(-1, 1, shape),
                "velocity": speed * rng.normal(size=shape),
                "stiffness": np.array(1.0),
                "friction": np.array(friction),
            }
            found = gradient(jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype=float), values))
            assert all(jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(found))
            assert found[0][0].dtype == (jnp.float64 if precise else jnp.float32)

        check()


# --- springs whose ends meet -------------------------------------------------------------------


def force_at(distance: float, along: tuple[float, float, float]) -> np.ndarray:
    """Force of a spring on its first end, when the second is that far along a unit vector."""
    body = rope(2, 0.1, stretch_stiffness=20.0)
    springs = make_springs(body)
    position = np.zeros((3, 4))
    position[:, 2] = distance * np.array(along)
    at = jnp.asarray(position, dtype=float)
    return np.asarray(pull(springs, spring_tensions(springs, at, jnp.zeros((3, 4))), at))


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("part", [0.0, 0.25, 0.5, 1.0, 2.0, 100.0, 1500.0])
def test_force_of_a_short_spring(part):
    shortest, along = 1e-3 * 0.1, np.array([0.6, 0.0, 0.8])
    found = force_at(part * shortest, tuple(along))
    # Hooke down to the shortest length, and in proportion to the distance below it.
    hooke = 20.0 * (max(part, 1.0) * shortest - 0.1)
    np.testing.assert_allclose(found[:, 0], min(part, 1.0) * hooke * along, atol=1e-12)
    np.testing.assert_allclose(found[:, 1], -found[:, 0], atol=0)
