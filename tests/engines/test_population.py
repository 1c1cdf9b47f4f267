"""Populations: every layout computes what a plain loop does."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsimp.bodies import cloth, rope
from jaxsimp.dynamics import make_simulation
from jaxsimp.engines import Layout, PopulationMap, default_layout, spring_chunk_size

LAYOUTS = [Layout(c, w) for c, w in [(1, 1), (1, 2), (3, 1), (3, 2), (8, 3), (1, 3), (50, 2)]]


def pendulum(shared, sample):
    """Something with a scan, two outputs and inputs of several shapes and types."""
    angle, kicks = sample["angle"], sample["kicks"]

    def step(state, kick):
        position, speed = state
        speed = speed - shared["gravity"] * jnp.sin(position) * 0.01 + kick
        return (position + 0.01 * speed, speed), position

    state, path = jax.lax.scan(step, (angle, jnp.zeros(())), kicks)
    return {"path": path, "last": state[0], "whole": sample["id"] * 2}


def batch_of(population: int, seed: int = 0):
    rng = np.random.default_rng(seed)
    return {
        "angle": rng.uniform(-1, 1, population).astype(np.float32),
        "kicks": rng.uniform(-0.1, 0.1, (population, 20)).astype(np.float32),
        "id": np.arange(population, dtype=np.int32),
    }


SHARED = {"gravity": np.float32(9.81)}


@pytest.mark.parametrize("layout", LAYOUTS, ids=str)
@pytest.mark.parametrize("population", [1, 7, 12])
def test_a_population_is_what_a_loop_computes(layout, population):
    batch = batch_of(population)
    mapped = PopulationMap(pendulum, SHARED, batch, layout)
    found = mapped(SHARED, batch)
    loop = [reference(jax.tree.map(lambda array, i=i: array[i], batch)) for i in range(population)]
    np.testing.assert_array_equal(found["whole"], 2 * np.arange(population))
    # float32: machine code differs by layout (vectors, fused multiply-add), so each of 20
    # steps rounds differently by 1e-7, on a motion that spreads errors no faster than they add.
    np.testing.assert_allclose(found["path"], [one["path"] for one in loop], atol=1e-5)
    np.testing.assert_allclose(found["last"], [one["last"] for one in loop], atol=1e-5)
    vmapped = reference_vmap(batch)
    np.testing.assert_allclose(found["path"], vmapped["path"], atol=1e-5)


@jax.jit
def reference(sample):
    return pendulum(SHARED, sample)


@jax.jit
def reference_vmap(batch):
    return jax.vmap(lambda sample: pendulum(SHARED, sample))(batch)


@pytest.mark.parametrize("chunk_size", [1, 3])
def test_results_do_not_depend_on_the_number_of_workers_where_shares_are_equal(chunk_size):
    # The same machine code runs a share of 6 of 12 and of 6 of 18: bit for bit the same.
    batch = batch_of(18)
    fewer = jax.tree.map(lambda array: array[:12], batch)
    two = PopulationMap(pendulum, SHARED, fewer, Layout(chunk_size, 2))(SHARED, fewer)
    three = PopulationMap(pendulum, SHARED, batch, Layout(chunk_size, 3))(SHARED, batch)
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a, b[:12]), two, three)


def test_a_sample_does_not_depend_on_its_place_or_its_neighbours():
    batch = batch_of(12)
    mapped = PopulationMap(pendulum, SHARED, batch, Layout(3, 2))
    order = np.random.default_rng(1).permutation(12)
    shuffled = mapped(SHARED, jax.tree.map(lambda array: array[order], batch))
    # An element of a vector goes through the same operations wherever it stands in it.
    np.testing.assert_array_equal(shuffled["path"], mapped(SHARED, batch)["path"][order])


def test_one_non_finite_sample_leaves_the_others_alone():
    batch = batch_of(7)
    mapped = PopulationMap(pendulum, SHARED, batch, Layout(3, 2))
    before = mapped(SHARED, batch)["path"]
    batch["angle"][4] = np.nan
    after = mapped(SHARED, batch)["path"]
    assert np.all(np.isnan(after[4]))
    others = np.arange(7) != 4
    np.testing.assert_array_equal(after[others], before[others])


def test_fewer_samples_than_were_compiled_for():
    batch = batch_of(12)
    mapped = PopulationMap(pendulum, SHARED, batch, Layout(3, 2))
    one = jax.tree.map(lambda array: array[5:6], batch)
    np.testing.assert_array_equal(mapped(SHARED, one)["path"], mapped(SHARED, batch)["path"][5:6])


def test_more_samples_than_were_compiled_for_are_refused():
    mapped = PopulationMap(pendulum, SHARED, batch_of(4), Layout(1, 2))
    with pytest.raises(ValueError, match=r"5 samples.* 4"):
        mapped(SHARED, batch_of(5))


def test_shared_arguments_may_change_without_compiling_again():
    traces = []

    def traced(shared, sample):
        traces.append(None)
        return pendulum(shared, sample)["last"]

    batch = batch_of(6)
    mapped = PopulationMap(traced, SHARED, batch, Layout(1, 2))
    compiled = len(traces)
    heavy = mapped({"gravity": np.float32(20.0)}, batch_of(6, seed=1))
    light = mapped({"gravity": np.float32(0.0)}, batch_of(6, seed=1))
    assert len(traces) == compiled
    assert np.all(heavy != light)


@pytest.mark.parametrize(("chunk_size", "num_workers"), [(0, 1), (1, 0), (-2, 3)])
def test_a_layout_needs_at_least_one_of_each(chunk_size, num_workers):
    name, value = ("chunk_size", chunk_size) if chunk_size < 1 else ("num_workers", num_workers)
    with pytest.raises(ValueError, match=f"^{name} is {value}; give a whole number "):
        Layout(chunk_size, num_workers)


@pytest.mark.parametrize("population", [1, 2, 128, 333])
@pytest.mark.parametrize("body", [rope(9), cloth((40, 40))], ids=["rope", "large cloth"])
def test_default_chunks_depend_on_the_body_alone(population, body):
    layout = default_layout(population, spring_chunk_size(make_simulation(body, 1e-4)))
    assert layout.chunk_size == (1 if body.num_particles > 1000 else min(8, population))
    assert layout.num_workers >= jax.local_device_count()
