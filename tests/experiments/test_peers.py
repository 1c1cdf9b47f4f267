"""Every engine moves particles as jaxsimp does, whatever the body."""

import dataclasses

import jax
import numpy as np
import pytest

from experiments.benchmark.checks import TOLERANCE
from experiments.benchmark.peers import ENGINES, c_step, edge_list
from experiments.benchmark.peers.workload import (
    UnavailableError,
    Workload,
    by_offset,
    from_lanes,
    in_lanes,
    make_body,
    make_workload,
    sorted_springs,
)
from jaxsimp.machine import num_cores

BODIES = {"rope": 11, "cloth": 6, "unstructured": 5}
POPULATION = 19
"""More than the samples that Taichi and Warp have side by side, and no multiple."""


def workload(kind: str) -> Workload:
    return make_workload(
        make_body(kind, BODIES[kind]), POPULATION, num_actions=2, action_steps=30, seed=3
    )


@pytest.fixture(scope="module", params=BODIES)
def expected(request):
    """A workload, and where jaxsimp has it end."""
    made = workload(request.param)
    return made, ENGINES["jaxsimp"][2](made)()


# When Taichi is imported; it has no newer release.
@pytest.mark.filterwarnings("ignore:'locale.getdefaultlocale' is deprecated:DeprecationWarning")
@pytest.mark.parametrize("name", [name for name in ENGINES if name != "jaxsimp"])
def test_an_engine_agrees_with_jaxsimp(expected, name):
    made, positions = expected
    try:
        run = ENGINES[name][2](made)
    except UnavailableError as reason:
        pytest.skip(str(reason))
    found = run()
    assert found.shape == (POPULATION, made.body.num_particles, 3)
    # Both in float32, 60 steps: rounding is an order below.
    np.testing.assert_allclose(found, positions, rtol=0, atol=TOLERANCE)
    # A second run starts from the start again.
    np.testing.assert_array_equal(run(), found)


def test_particles_are_carried_and_the_others_follow(expected):
    made, positions = expected
    moved = np.linalg.norm(positions - made.start, axis=2)
    assert (moved.max(axis=1) > 100 * TOLERANCE).all()
    last = made.pick[:, -1]
    others = np.ones_like(moved, dtype=bool)
    np.put_along_axis(others, last, False, axis=1)
    assert (moved[others].reshape(POPULATION, -1).max(axis=1) > 10 * TOLERANCE).all()


def test_picked_particles_move_by_their_displacement():
    # One action: a closed form for the particles held.
    made = make_workload(make_body("cloth", 6), 5, num_actions=1, action_steps=30)
    with jax.enable_x64(True):
        found = edge_list.prepare(made)()
    sample = np.arange(5)[:, None]
    pick, move = made.pick[:, 0], made.displacement[:, 0]
    np.testing.assert_allclose(found[sample, pick], made.start[pick] + move, rtol=0, atol=1e-12)


def test_plans_bind_no_rule():
    made = make_workload(make_body("cloth", 6), 200, num_actions=3)
    assert (made.pick[..., 0] != made.pick[..., 1]).all()
    assert ((made.pick >= 0) & (made.pick < 36)).all()
    assert (made.displacement[..., 2] >= 0).all()
    np.testing.assert_array_equal(made.displacement[:, :, 0], made.displacement[:, :, 1])
    assert made.shares.sum() == pytest.approx(1)
    assert made.particle_steps == 200 * 3 * 150 * 36


@pytest.mark.parametrize("kind", BODIES)
def test_every_spring_is_stored_once(kind):
    body = make_body(kind, BODIES[kind])
    given = {
        (min(pair), max(pair)): numbers
        for pair, *numbers in zip(
            body.springs.tolist(), body.stiffness, body.damping, body.rest_length, strict=True
        )
    }
    offsets = by_offset(body)
    by_distance = {
        (int(i), int(i + offsets.offsets[d])): [
            table[d, i] for table in (offsets.stiffness, offsets.damping, offsets.rest_length)
        ]
        for d, i in np.argwhere(offsets.stiffness)
    }
    assert by_distance == given
    ends, numbers = sorted_springs(body)
    pairs = [(min(pair), max(pair)) for pair in ends.tolist()]
    assert pairs == sorted(given)
    expected = [(k, damping, k * length) for k, damping, length in map(given.get, pairs)]
    np.testing.assert_array_equal(numbers, expected)


@pytest.mark.parametrize("population", [1, 4, 5])
def test_lanes_hold_all_samples_in_order(population):
    plans = np.arange(population * 3 * 2).reshape(population, 3, 2)
    lanes = in_lanes(plans, 4)
    assert lanes.shape == (-(-population // 4), 3, 4, 2)
    for b in range(4 * len(lanes)):
        np.testing.assert_array_equal(lanes[b // 4, :, b % 4], plans[min(b, population - 1)])
    # As positions of three particles on two axes.
    back = from_lanes(lanes.transpose(0, 1, 3, 2).astype(float), population)
    np.testing.assert_array_equal(back, plans)


def test_without_a_compiler_the_c_step_says_so(monkeypatch):
    monkeypatch.setattr(c_step, "COMPILERS", ("no-such-compiler",))
    with pytest.raises(UnavailableError, match="no C compiler"):
        c_step.prepare(workload("cloth"), num_threads=1)


def test_a_compiler_that_fails_is_quoted(monkeypatch, tmp_path):
    if not any(map(c_step.shutil.which, c_step.COMPILERS)):
        pytest.skip("no C compiler is there")
    broken = tmp_path / "broken.c"
    broken.write_text("#error on purpose\n")
    monkeypatch.setattr(c_step, "SOURCE", broken)
    with pytest.raises(UnavailableError, match="on purpose"):
        c_step.prepare(workload("cloth"), num_threads=1)


def test_the_c_step_refuses_a_body_without_structure():
    body = make_body("unstructured", 10)
    with pytest.raises(UnavailableError, match="offsets"):
        c_step.prepare(make_workload(body, 1), num_threads=1)


def test_flags_that_are_refused_are_left_out(monkeypatch):
    made = workload("rope")
    try:
        found = c_step.prepare(made, num_cores())()
    except UnavailableError as reason:
        pytest.skip(str(reason))
    monkeypatch.setattr(c_step, "FLAGS", (("-fno-such-flag",), *c_step.FLAGS[-1:]))
    np.testing.assert_allclose(c_step.prepare(made, 1)(), found, rtol=0, atol=TOLERANCE)


def test_a_stiffness_that_is_wrong_by_two_per_cent_is_told_apart():
    made = workload("cloth")
    stiffer = dataclasses.replace(made.body, stiffness=1.02 * made.body.stiffness)
    wrong = ENGINES["numpy"][2](dataclasses.replace(made, body=stiffer))()
    assert np.abs(wrong - ENGINES["numpy"][2](made)()).max() > TOLERANCE
