"""Calibration: known physics is found again, and unseen motions are predicted by what is found.

A calibration takes seconds to compile, so tests share what they calibrate.
"""

from dataclasses import replace
from functools import lru_cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsimp import goals
from jaxsimp.bodies import Body, cloth, from_mesh, rope
from jaxsimp.calibration import (
    Calibration,
    CalibrationConfig,
    Recording,
    _check_kinds,
    _kind_table,
    _misfit,
    _scaled,
    _scaled_body,
    calibrate,
    recording_error,
    simulate_recordings,
)
from jaxsimp.dynamics import NONE, Actions, State, at_rest, make_pickers, make_simulation, rollout

# Most of the time is compilation, of which `calibrate` itself asks for little.

SECONDS = 0.08
"""Of an action."""


def record(body: Body, picks: np.ndarray, moves: np.ndarray, lift: float) -> Recording:
    """A body's own motion from flat, at a time step of 0.2 ms."""
    simulation = make_simulation(body, SECONDS / 400)
    start = at_rest(goals.flat(body) + np.array([0.0, 0.0, lift]))
    actions = Actions(jnp.asarray(picks), jnp.asarray(moves, dtype=float))
    pickers = make_pickers((1.0, 1.0, 1.0), max_stretch=100.0, steps=400)
    return Recording(start, actions, jax.jit(rollout)(simulation, pickers, start, actions)[1])


def motions(body: Body, seed: int, lift: float) -> Recording:
    """One particle carried about for six actions, let go for two."""
    rng = np.random.default_rng(seed)
    last = body.num_particles - 1
    picks = np.full((8, 1), [last, 0][seed % 2])
    picks[6:] = NONE
    moves = rng.uniform(-1.0, 1.0, (8, 1, 3)) * 0.2 * body.size
    moves[:, :, 2] = np.abs(moves[:, :, 2]) * 0.5 * (-1.0) ** np.arange(8)[:, None]
    return record(body, picks, moves, lift)


ROPE = rope(6, 0.2, stretch_stiffness=20.0, bend_stiffness=2.0, damping=0.02, mass=0.02)
TRUE_ROPE = rope(
    6,
    0.2,
    stretch_stiffness=36.0,
    bend_stiffness=1.0,
    damping=0.035,
    drag=1.6,
    friction=0.3,
    mass=0.02,
)
CLOTH = cloth((3, 3), (0.1, 0.1))
TRUE_CLOTH = cloth(
    (3, 3),
    (0.1, 0.1),
    stretch_stiffness=0.8,
    shear_stiffness=0.9,
    bend_stiffness=0.25,
    damping=2e-3,
    drag=1.5,
)
IN_AIR = ("stiffness", "damping", "drag")


@lru_cache(None)
def calibrated(kind: str) -> Calibration:
    if kind == "rope":  # dragged over the table, and in the air
        seen = [motions(TRUE_ROPE, 0, 0.0), motions(TRUE_ROPE, 1, 0.05)]
        return calibrate(ROPE, seen, SECONDS, CalibrationConfig(steps=150, longest_time_step=5e-4))
    seen = [motions(TRUE_CLOTH, 0, 0.5)]
    return calibrate(CLOTH, seen, SECONDS, CalibrationConfig(IN_AIR, steps=150))


# --- what is found -------------------------------------------------------------------------------


@pytest.mark.slow
def test_known_physics_is_recovered():
    found = calibrated("rope").body
    # Replays err by order dt / 2 of a motion whose fastest modes take 20 dt: some per cent.
    for name in ("stiffness", "damping"):
        np.testing.assert_allclose(getattr(found, name), getattr(TRUE_ROPE, name), rtol=0.05)
    assert found.material.drag == pytest.approx(TRUE_ROPE.material.drag, rel=0.05)
    assert found.material.friction == pytest.approx(TRUE_ROPE.material.friction, rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "guess", "true"), [("rope", ROPE, TRUE_ROPE), ("cloth", CLOTH, TRUE_CLOTH)]
)
def test_unseen_motions_are_predicted_five_times_better(kind, guess, true):
    unseen = [motions(true, seed, 0.0 if kind == "rope" else 0.5) for seed in (2, 3)]
    before = recording_error(guess, unseen, SECONDS, longest_time_step=5e-4)
    after = recording_error(calibrated(kind).body, unseen, SECONDS, longest_time_step=5e-4)
    assert before > 5e-3  # metres: there is something to be gained
    assert after < before / 5


@pytest.mark.slow
def test_the_history_and_the_best_physics():
    found = calibrated("rope")
    assert found.errors.shape == (151,)
    assert np.isfinite(found.errors).all()
    assert found.errors.min() < 0.1 * found.errors[0]
    assert set(found.factors) == {"stiffness", "damping", "drag", "friction"}
    assert found.factors["stiffness"].shape == (2,)  # stretch and bend springs


@pytest.mark.slow
def test_the_best_is_kept_where_the_descent_goes_astray():
    seen = [motions(TRUE_ROPE, 0, 0.0)]
    wild = CalibrationConfig(steps=2, learning_rate=1.5, largest_factor=1.3, smallest_factor=0.7)
    found = calibrate(ROPE, seen, SECONDS, wild)
    # Better after the first step, all of whose factors end at a bound, and worse after the second.
    assert found.errors.argmin() == 1
    for factor in jax.tree.leaves(found.factors):
        np.testing.assert_allclose(np.where(factor > 1, 1.3, 0.7), factor, rtol=1e-6)
    # Another time step than the descent's: a few per cent of the error.
    assert recording_error(found.body, seen, SECONDS) == pytest.approx(found.errors.min(), rel=0.1)


def test_a_replay_is_a_rollout():
    recording = motions(TRUE_ROPE, 0, 0.0)
    # Semi-implicit Euler at two time steps, 0.2 and 1.5 ms, of a motion over 0.48 s.
    found = simulate_recordings(TRUE_ROPE, [recording], SECONDS)
    assert found.shape == (1, 8, 6, 3)
    np.testing.assert_allclose(found[0], recording.positions, atol=0.01)
    error = recording_error(TRUE_ROPE, [recording, recording], SECONDS)
    wanted = np.linalg.norm(found[0] - np.asarray(recording.positions), axis=-1)
    assert error == pytest.approx(np.sqrt((wanted**2).mean()), rel=1e-5)


@pytest.mark.slow
@pytest.mark.usefixtures("x64")
def test_the_gradient_is_that_of_finite_differences():
    # Short, so that it compiles and is smooth: the end of a chain lifted, dragged and let go.
    actions = Actions(
        jnp.array([[3], [NONE]]), jnp.array([[[0.02, 0.01, 0.02]], [[0.0, 0.0, 0.0]]])
    )
    body = rope(4, 0.1, stretch_stiffness=20.0, bend_stiffness=2.0)
    stacked = jax.tree.map(
        lambda leaf: leaf[None],
        Recording(at_rest(goals.flat(body)), actions, jnp.asarray(body.rest + np.ones((2, 1, 1)))),
    )
    kinds = _check_kinds(body, None)
    loss = partial(_misfit, 30, make_simulation(body, 1e-3), _kind_table(body, kinds), stacked)
    both = jax.jit(jax.value_and_grad(lambda logs: loss(logs, jnp.asarray(1.6))[0]))
    at = {"stiffness": jnp.array([0.1, -0.2])}
    at |= {name: jnp.asarray(0.1) for name in ("damping", "drag", "friction")}
    _, gradient = both(at)
    h = 1e-6
    for name in at:
        for index in range(at[name].size):
            step = jnp.zeros(at[name].size).at[index].set(h).reshape(at[name].shape)
            ends = [float(both(at | {name: at[name] + sign * step})[0]) for sign in (1, -1)]
            found = float(jnp.ravel(gradient[name])[index])
            assert abs(found) > 1e-7, name  # it matters
            # Differences err by h^2, and by 1e-16 / h of a loss near 1.
            assert (ends[0] - ends[1]) / (2 * h) == pytest.approx(found, rel=1e-4, abs=1e-9), name


# --- factors on springs --------------------------------------------------------------------------


def square_mesh() -> Body:
    points = np.array([[x, y, 0.0] for x in range(4) for y in range(4)]) * 0.03
    cells = [4 * i + j for i in range(3) for j in range(3)]
    faces = np.array([[c, c + 4, c + 1] for c in cells] + [[c + 4, c + 5, c + 1] for c in cells])
    return from_mesh(points, faces)


@pytest.mark.parametrize("body", [ROPE, CLOTH, square_mesh()], ids=["rope", "cloth", "mesh"])
@pytest.mark.parametrize("by_neighbour", [False, True])
def test_a_scaled_simulation_is_that_of_the_scaled_body(body, by_neighbour, monkeypatch):
    if by_neighbour:
        monkeypatch.setattr("jaxsimp.dynamics.springs.MOST_OFFSETS", 0)
    rng = np.random.default_rng(0)
    kinds = rng.integers(0, 3, len(body.springs))
    factors = {
        "stiffness": rng.uniform(0.5, 2.0, 3),
        "damping": np.array(0.7),
        "drag": np.array(1.3),
        "friction": np.array(0.4),
    }
    as_arrays = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype=float), factors)
    found = _scaled(make_simulation(body, 1e-4), _kind_table(body, kinds), as_arrays)
    wanted = make_simulation(_scaled_body(body, factors, kinds), 1e-4)
    # Two roundings to float32 in the other order.
    for leaf, other in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(leaf, other, rtol=3e-7)


def test_kinds_of_springs_by_default():
    assert set(_check_kinds(ROPE, None)) == {0, 1}
    assert set(_check_kinds(CLOTH, None)) == {0, 1, 2}
    stiffness = np.arange(1.0, 1.0 + len(CLOTH.springs))
    assert set(_check_kinds(replace(CLOTH, stiffness=stiffness), None)) == {0}


# --- refusals ------------------------------------------------------------------------------------


def good() -> Recording:
    actions = Actions(jnp.full((2, 1), 0), jnp.full((2, 1, 3), 0.01))
    start = at_rest(goals.flat(ROPE))
    return Recording(start, actions, jnp.ones((2, 6, 3)))


def bad_recordings() -> dict[str, tuple[Recording, str]]:
    ok = good()
    one_more = Actions(jnp.full((3, 1), 0), jnp.full((3, 1, 3), 0.01))
    return {
        "particles": (
            replace(ok, positions=jnp.ones((2, 5, 3))),
            r"\(2, 5, 3\); give shape \(2, 6, 3\)",
        ),
        "frames": (replace(ok, positions=jnp.ones((3, 6, 3))), r"positions .* \(2, 6, 3\)"),
        "actions": (replace(ok, actions=one_more), r"actions.pick of recording 1 .* \(2, 1\)"),
        "displacements": (
            replace(ok, actions=Actions(ok.actions.pick, jnp.zeros((2, 2, 3)))),
            r"displacement .* \(2, 1, 3\)",
        ),
        "start": (
            replace(ok, start=State(jnp.ones((5, 3)), jnp.ones((5, 3)))),
            r"start.position .* \(6, 3\)",
        ),
        "far": (
            replace(ok, start=State(jnp.full((6, 3), 1e29), jnp.zeros((6, 3)))),
            r"start.position of recording 1\[0, 0\] is 1e\+29; give numbers from -1e\+06",
        ),
        "none": (None, r"recording 1 is None; give Recording\(State"),
        "not finite": (
            replace(ok, positions=ok.positions.at[1, 2, 0].set(jnp.nan)),
            "recording 1 has a value that is not finite",
        ),
    }


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize(
    "name",
    ["particles", "frames", "actions", "displacements", "start", "far", "none", "not finite"],
)
def test_recordings_that_do_not_fit_are_refused(name):
    recording, message = bad_recordings()[name]
    with pytest.raises(ValueError, match=message):
        calibrate(ROPE, [good(), recording], SECONDS)
    with pytest.raises(ValueError, match=message):
        simulate_recordings(ROPE, [good(), recording], SECONDS)


def test_recordings_that_say_nothing_are_refused():
    with pytest.raises(ValueError, match=r"recordings is \[\]; give a list of at least one"):
        calibrate(ROPE, [], SECONDS)
    start = at_rest(goals.flat(ROPE))
    still = replace(good(), positions=jnp.stack([start.position] * 2))
    with pytest.raises(ValueError, match="no particle moves"):
        calibrate(ROPE, [still], SECONDS)


@pytest.mark.parametrize("seconds", [0.0, -1.0, np.nan, np.inf])
def test_durations_that_are_none_are_refused(seconds):
    with pytest.raises(ValueError, match=f"action_seconds is {seconds}"):
        calibrate(ROPE, [good()], seconds)
    with pytest.raises(ValueError, match=f"action_seconds is {seconds}"):
        simulate_recordings(ROPE, [good()], seconds)


def test_the_material_of_a_calibrated_body_makes_that_body():
    factors = {"stiffness": np.array([2.0, 3.0]), "drag": np.array(0.5), "damping": np.array(4.0)}
    found = _scaled_body(ROPE, factors, _check_kinds(ROPE, None))
    again = rope(6, 0.2, material=found.material)
    for name in ("stiffness", "damping", "mass"):
        # A few products and quotients in float64.
        np.testing.assert_allclose(getattr(again, name), getattr(found, name), rtol=1e-14)
    assert again.material.drag == 0.5 * ROPE.material.drag
    assert again.material.friction == ROPE.material.friction


@pytest.mark.usefixtures("unchecked_shapes")
def test_what_cannot_be_fitted_is_refused():
    with pytest.raises(ValueError, match="drag of the body is 0"):
        calibrate(ROPE.scaled(drag=0.0), [good()], SECONDS)
    for kinds, message in (
        (np.zeros(3, dtype=int), r"kinds has shape \(3,\); give shape \(9,\)"),
        (np.full(9, -1), "kinds names -1; the ids of 9 springs are 0 to 8"),
    ):
        with pytest.raises(ValueError, match=message):
            calibrate(ROPE, [good()], SECONDS, kinds=kinds)


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"parameters": ("mass",)}, r"choose from stiffness, damping, drag, friction"),
        ({"parameters": ()}, r"parameters is \(\); give a tuple of names, of stiffness"),
        ({"parameters": np.array(5)}, r"parameters is array\(5\); give a tuple of names"),
        ({"parameters": ("drag", [])}, r"a name in parameters is \[\]; choose from stiffness"),
        ({"steps": 0}, "steps is 0"),
        ({"learning_rate": 0.0}, "learning_rate is 0"),
        ({"learning_rate": float("nan")}, "learning_rate is nan"),
        ({"largest_factor": 1.0}, "largest_factor is 1"),
        ({"smallest_factor": 0.0}, "smallest_factor is 0"),
        ({"longest_time_step": 0.0}, "longest_time_step is 0"),
    ],
)
def test_settings_out_of_range_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        CalibrationConfig(**settings)
