"""Pickers: what they hold, how they move it and when they refuse, against the rules in loops."""

from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxsimp import goals
from jaxsimp.bodies import cloth, rope, t_shirt
from jaxsimp.dynamics import (
    NONE,
    Actions,
    Pinch,
    Table,
    at_rest,
    make_pickers,
    make_simulation,
    rollout,
    settle,
)
from jaxsimp.dynamics.pickers import grasp, speed_profile

jit_grasp = jax.jit(grasp)
WIDE = (10.0, 10.0, 10.0)


def loop_grasp(limits, stretch, rest, floor, position, picks, displacements):
    """The rules of `grasp`, one picker and one pair after another."""
    num = len(picks)
    holds = [p != NONE and p not in picks[:g] for g, p in enumerate(picks)]
    moves = []
    for pick, displacement in zip(picks, displacements, strict=True):
        target = position[pick] + np.clip(displacement, -np.array(limits), limits)
        target[2] = max(target[2], floor)
        moves.append(target - position[pick])
    refused = True
    while refused:  # until no pair with a picker that moves breaks the rule
        refused = set()
        for g, h in combinations(range(num), 2):
            p, q = picks[g], picks[h]
            if holds[g] and holds[h] and (moves[g].any() or moves[h].any()):
                apart = np.linalg.norm(position[p] + moves[g] - position[q] - moves[h])
                if apart >= stretch * np.linalg.norm(rest[p] - rest[q]):
                    refused |= {g, h}
        for g in refused:
            moves[g] = np.zeros(3)
    held, displacement = np.zeros(len(rest), dtype=bool), np.zeros(rest.shape)
    for g in range(num):
        if holds[g]:
            held[picks[g]] = True
            displacement[picks[g]] = moves[g]
    return held, displacement


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("num_pickers", [1, 2, 3, 4])
def test_grasp_agrees_with_the_rules_in_loops(num_pickers):
    rest = rope(6, 0.5).rest
    outcomes = set()

    @given(seed=st.integers(0, 2**32 - 1))
    def check(seed):
        rng = np.random.default_rng(seed)
        # Moderate motions from near the rest shape: each rule is met often.
        position = rest + rng.uniform(-0.05, 0.05, rest.shape) + np.array([0.0, 0.0, 0.06])
        picks = rng.integers(-1, 6, num_pickers)
        displacements = rng.uniform(-0.12, 0.12, (num_pickers, 3))
        limits, floor = (0.1, 0.08, 0.09), 0.01
        found = jit_grasp(
            make_pickers(limits),
            jnp.asarray(rest),
            (Table(),),
            jnp.asarray(floor),
            jnp.asarray(position),
            Actions(jnp.asarray(picks), jnp.asarray(displacements)),
        )
        held, displacement = loop_grasp(
            limits, 1.2, rest, floor, position, picks.tolist(), displacements
        )
        np.testing.assert_array_equal(found[0], held)
        # The same few operations: rounding of 1 m.
        np.testing.assert_allclose(found[1], displacement, atol=1e-14)
        outcomes.add((int(held.sum()), int(displacement.any(axis=1).sum())))

    check()
    # All held at once and none refused is among the examples, and (for pairs) a refusal.
    assert any(moved == held > 0 for held, moved in outcomes)
    assert num_pickers == 1 or any(moved < held for held, moved in outcomes)


BODY = rope(5, 0.4)


def carry(picks, displacements, *, start=None, body=BODY, steps=20, **options):
    """The state after some actions, and the start."""
    start = goals.flat(body) + np.array([0.0, 0.0, 0.1]) if start is None else start
    run = jax.jit(rollout)
    pickers = make_pickers(**{"limits": WIDE, "steps": steps} | options)
    actions = Actions(jnp.asarray(picks), jnp.asarray(displacements, dtype=float))
    return run(make_simulation(body, 1e-3), pickers, at_rest(start), actions)[0], start


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("steps", [1, 2, 20])
def test_displacements_are_followed(steps):
    moves = np.array([[[0.01, 0.02, 0.03], [-0.01, 0.03, 0.02]], [[0.0, -0.05, -0.06]] * 2])
    final, start = carry([[1, 4]] * 2, moves, steps=steps)
    # The shares of a displacement add up to 1, to rounding.
    np.testing.assert_allclose(
        final.position[np.array([1, 4])], start[[1, 4]] + moves.sum(axis=0), atol=1e-14
    )


def test_displacements_are_followed_in_single_precision():
    moves = np.array([[[0.01, 0.02, 0.03], [-0.01, 0.03, 0.02]]])
    final, start = carry([[1, 4]], moves, steps=150)
    # 150 additions to 0.2 m, each rounded by 1.5e-8 m at most.
    np.testing.assert_allclose(
        final.position[np.array([1, 4])], start[[1, 4]] + moves[0], atol=150 * 1.5e-8
    )


@pytest.mark.usefixtures("x64")
def test_a_picker_that_moves_nowhere_holds_on():
    final, start = carry([[0, 2]], np.zeros((1, 2, 3)), steps=100)
    np.testing.assert_array_equal(final.position[np.array([0, 2])], start[[0, 2]])
    np.testing.assert_array_equal(final.velocity[np.array([0, 2])], 0.0)
    assert final.position[1, 2] < start[1, 2] - 1e-3  # what is not held falls


@pytest.mark.usefixtures("x64")
def test_none_holds_nothing():
    # NONE is -1, which NumPy and JAX would read as the last particle.
    idle, start = carry([[NONE, NONE]], np.full((1, 2, 3), 0.1), steps=30)
    np.testing.assert_allclose(idle.position[:, 2], start[0, 2] - idle_fall(30), atol=1e-12)
    np.testing.assert_allclose(idle.position[:, :2], start[:, :2], atol=1e-12)


def idle_fall(steps: int, dt: float = 1e-3, drag: float = BODY.material.drag) -> float:
    speed = fallen = 0.0
    for _ in range(steps):
        speed += dt * (9.81 - drag * speed)
        fallen += dt * speed
    return fallen


@pytest.mark.usefixtures("x64")
def test_one_picker_beside_none_moves_as_alone():
    alone, _ = carry([[3]], np.full((1, 1, 3), 0.02))
    for picks, moves in ([3, NONE], [0.02, 0.5]), ([NONE, 3], [0.5, 0.02]):
        beside, _ = carry([picks], np.array(moves)[None, :, None] * np.ones(3))
        # What NONE asks for cannot matter, not even for the stretch rule.
        np.testing.assert_allclose(beside.position, alone.position, atol=1e-14)


@pytest.mark.usefixtures("x64")
def test_the_first_picker_gets_a_particle_that_two_name():
    both, start = carry([[2, 2]], [[[0.03, 0.0, 0.0], [0.0, 0.5, 0.0]]])
    np.testing.assert_allclose(both.position[2], start[2] + [0.03, 0.0, 0.0], atol=1e-14)


@pytest.mark.usefixtures("x64")
def test_limits_and_table_clip_what_is_asked():
    limits = (0.02, 0.03, 0.2)
    asked = [[[0.05, -0.05, 0.1], [-0.05, 0.01, -0.15]]]
    final, start = carry([[1, 3]], asked, limits=limits, max_stretch=10.0)
    got = np.asarray(final.position)[[1, 3]] - start[[1, 3]]
    np.testing.assert_allclose(got, [[0.02, -0.03, 0.1], [-0.02, 0.01, -0.1]], atol=1e-14)
    np.testing.assert_allclose(final.position[3, 2], BODY.radius, atol=1e-14)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize(("ratio", "moves"), [(1.2 - 1e-9, True), (1.2 + 1e-9, False)])
def test_stretch_rule_stops_both_at_its_limit(ratio, moves):
    # Particles 1 and 3 rest 0.2 m apart.
    extra = (ratio - 1) * 0.2 / 2
    final, start = carry([[1, 3]], [[[-extra, 0, 0], [extra, 0, 0]]])
    moved = np.asarray(final.position)[[1, 3]] - start[[1, 3]]
    wanted = [[-extra, 0, 0], [extra, 0, 0]] if moves else np.zeros((2, 3))
    np.testing.assert_allclose(moved, wanted, atol=1e-14)


def test_stretch_rule_refuses_equality():
    # In numbers that floats hold exactly: 1.5 times 0.5 m.
    _, displacement = jit_grasp(
        make_pickers(WIDE, max_stretch=1.5),
        jnp.array([[0.0, 0, 0], [0.5, 0, 0]]),
        (),
        jnp.asarray(0.0),
        jnp.array([[0.0, 0, 0], [0.5, 0, 0]]),
        Actions(jnp.array([0, 1]), jnp.array([[0.0, 0, 0], [0.25, 0, 0]])),
    )
    np.testing.assert_array_equal(displacement, 0.0)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize(("apart", "moves"), [(0.45, True), (0.5, False)])
def test_stretch_rule_measures_by_the_rest_distance(apart, moves):
    # A crumpled start, its ends 0.1 m apart where they rest 0.4 m apart: it may be unfolded to
    # any distance under 0.48 m, which is 4.8 times the distance it starts from.
    zigzag = goals.polyline(BODY, np.array([[0, 0], [0.2, 0.1], [0.1, 0.0]]))
    zigzag[:, 2] += 0.1
    pull = apart - np.linalg.norm(zigzag[4] - zigzag[0])
    final, start = carry([[0, 4]], [[[0, 0, 0], [pull, 0, 0]]], start=zigzag)
    moved = np.asarray(final.position)[[0, 4]] - start[[0, 4]]
    wanted = [[0, 0, 0], [pull if moves else 0.0, 0, 0]]
    np.testing.assert_allclose(moved, wanted, atol=1e-14)


@pytest.mark.usefixtures("x64")
def test_a_third_picker_is_refused_when_it_would_leave_one_that_is():
    # Rest: 0, 0.1, 0.2 m. Pickers 0 and 1 part too far, and stay; picker 2 would have kept its
    # distance from where 1 was going, and is too far from where 1 remains.
    rest = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]])
    moves = np.array([[-0.005, 0, 0], [0.05, 0, 0], [0.03, 0, 0]])
    args = jnp.asarray(rest), (), jnp.asarray(0.0), jnp.asarray(rest)
    pick = jnp.arange(3)
    held, displacement = jit_grasp(make_pickers(WIDE), *args, Actions(pick, jnp.asarray(moves)))
    assert held.all()
    np.testing.assert_array_equal(displacement, 0.0)
    moves[2, 0] = 0.01  # near enough to where 1 remains
    _, displacement = jit_grasp(make_pickers(WIDE), *args, Actions(pick, jnp.asarray(moves)))
    np.testing.assert_allclose(displacement[:, 0], [0.0, 0.0, 0.01], atol=1e-14)


@pytest.mark.usefixtures("x64")
def test_rows_of_a_batch_hold_what_each_of_them_names():
    body = cloth((3, 3), (0.1, 0.1))
    simulation, pickers = make_simulation(body, 1e-3), make_pickers(WIDE, steps=10)
    start = goals.flat(body) + np.array([0.0, 0.0, 0.1])
    picks = np.array([[NONE, NONE], [0, 8], [4, NONE], [NONE, 4], [7, 7]])
    moves = np.tile([[0.0, 0.01, 0.02], [0.01, 0.0, 0.03]], (5, 1, 1))

    def run(pick, move):
        return rollout(simulation, pickers, at_rest(start), Actions(pick[None], move[None]))[0]

    found = jax.jit(jax.vmap(run))(jnp.asarray(picks), jnp.asarray(moves)).position
    wanted = [{}, {0: 0, 8: 1}, {4: 0}, {4: 1}, {7: 0}]
    for row, carried in enumerate(wanted):
        for particle in range(9):
            moved = np.asarray(found[row, particle]) - start[particle]
            if particle in carried:
                np.testing.assert_allclose(moved, moves[row, carried[particle]], atol=1e-14)
            else:
                assert np.abs(moved - moves[row]).max(axis=1).min() > 1e-3


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("steps", [1, 2, 7, 150])
def test_speed_profile_in_closed_form(steps):
    # Squares summed: sum of (i + 1/2)(n - i - 1/2) over i < n is n (2 n^2 + 1) / 12.
    i = np.arange(steps)
    wanted = (i + 0.5) * (steps - i - 0.5) * 12 / (steps * (2 * steps**2 + 1))
    found = np.asarray(speed_profile(steps))
    np.testing.assert_allclose(found, wanted, rtol=1e-13)
    np.testing.assert_allclose(found.sum(), 1.0, rtol=1e-14)


def test_speed_profile_sums_to_one_in_single_precision():
    # A sum of 150 roundings.
    np.testing.assert_allclose(np.asarray(speed_profile(150), dtype=float).sum(), 1.0, atol=1e-6)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("steps", [50, 100])
def test_a_picker_ends_at_rest(steps):
    final, _ = carry([[2]], [[[0.0, 0.05, 0.0]]], steps=steps)
    # The parabola's value half a step before its end is 3 / steps of the mean speed, to a
    # relative 1 / steps.
    mean = 0.05 / (steps * 1e-3)
    np.testing.assert_allclose(final.velocity[2, 1], 3 / steps * mean, rtol=1.0 / steps)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"limits": (0.1, 0.0, 0.1)}, r"limits\[1\] is 0; give numbers from 1e-06 to 1000 m"),
        ({"limits": (0.1, -0.1, 0.1)}, r"limits\[1\] is -0.1"),
        ({"limits": (0.1, float("nan"), 0.1)}, r"limits\[1\] is nan"),
        ({"limits": (0.1, float("inf"), 0.1)}, r"limits\[1\] is inf"),
        ({"max_stretch": 1.0}, r"max_stretch is 1.0; give a number from 1.0001"),
        ({"max_stretch": float("nan")}, "max_stretch is nan"),
        ({"steps": 0}, "steps is 0; give a whole number from 1"),
    ],
)
def test_pickers_refuse(arguments, message):
    with pytest.raises(ValueError, match=message):
        make_pickers(**arguments)


@pytest.mark.usefixtures("unchecked_shapes")
def test_pickers_refuse_limits_that_are_not_three():
    with pytest.raises(ValueError, match=r"limits is \(0.1, 0.1\); give three displacements"):
        make_pickers((0.1, 0.1))


# --- the door ------------------------------------------------------------------------------------


MOVE = np.full((1, 2, 3), 0.01)
BOTH = np.array([[0, 4]])
WRONG = {
    "too large": (
        np.array([[0, 5]]),
        MOVE,
        r"pick\[0, 1\] is 5; a body of 5 .* ids 0 to 4",
    ),
    "beyond 32 bits": (np.array([[2**40, 0]]), MOVE, rf"pick\[0, 0\] is {2**40}; a body of 5"),
    "negative": (np.array([[NONE, -7]]), MOVE, r"pick\[0, 1\] is -7; a body of 5"),
    "floats": (np.array([[0.0, 1.0]]), MOVE, "pick is an array of float64; give ids of particles"),
    "a mask": (np.array([[True, False]]), MOVE, "pick is an array of bool; give ids"),
    "nan": (BOTH, MOVE * np.nan, r"displacement\[0, 0, 0\] is nan; give numbers from"),
    "infinite": (BOTH, MOVE * np.inf, r"displacement\[0, 0, 0\] is inf; give numbers from"),
    "far away": (BOTH, MOVE * 1e9, r"is 1e\+07; give numbers from -1e\+06 to 1e\+06 m"),
    "one for two": (BOTH, MOVE[:, :1], r"\(1, 2\) and displacement of shape \(1, 1, 3\); give"),
    "one action": (BOTH[0], MOVE[0], r"give shapes \(T, G\) and \(T, G, 3\)"),
    "no picker": (BOTH[:, :0], MOVE[:, :0], r"pick of shape \(1, 0\).*give shapes"),
}


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize("name", WRONG)
def test_a_plan_that_names_nothing_of_the_body_is_refused(name):
    *arrays, message = WRONG[name]
    body = rope(5, 0.1)
    simulation, start = make_simulation(body, 1e-3), at_rest(goals.straight(body))
    with pytest.raises(ValueError, match=message):
        rollout(simulation, make_pickers(steps=2), start, Actions(*arrays))


@pytest.mark.usefixtures("unchecked_shapes")
def test_what_is_no_plan_and_a_state_of_another_body_are_refused():
    simulation, pickers = make_simulation(rope(5, 0.1), 1e-3), make_pickers(steps=2)
    with pytest.raises(ValueError, match=r"the plan is a dict; give Actions\(pick, displacement\)"):
        rollout(simulation, pickers, at_rest(np.zeros((5, 3))), {"pick": 0})
    other = at_rest(np.zeros((4, 3)))
    idle = Actions(jnp.full((1, 2), NONE), jnp.zeros((1, 2, 3)))
    message = r"position of the state has shape \(4, 3\); give shape \(5, 3\), one row of x, y, z"
    with pytest.raises(ValueError, match=message):
        rollout(simulation, pickers, other, idle)
    with pytest.raises(ValueError, match=message):
        settle(simulation, other, 1)
    with pytest.raises(ValueError, match="num_steps is -1; give a whole number of at least 0"):
        settle(simulation, at_rest(np.zeros((5, 3))), -1)


@pytest.mark.usefixtures("unchecked_shapes")
def test_a_plan_of_no_actions_and_of_lists_is_one():
    body = rope(5, 0.1)
    simulation, pickers = make_simulation(body, 1e-3), make_pickers(steps=2)
    start = at_rest(goals.straight(body))
    none = Actions(np.zeros((0, 1), int), np.zeros((0, 1, 3)))
    final, seen = rollout(simulation, pickers, start, none)
    np.testing.assert_array_equal(final.position, start.position)
    assert seen.shape == (0, 5, 3)
    by_lists, _ = rollout(simulation, pickers, start, Actions([[0]], [[[0.01, 0.0, 0.0]]]))
    by_arrays = Actions(jnp.array([[0]]), jnp.array([[[0.01, 0.0, 0.0]]]))
    wanted, _ = rollout(simulation, pickers, start, by_arrays)
    np.testing.assert_array_equal(by_lists.position, wanted.position)


def test_under_jit_an_id_out_of_range_grasps_nothing_and_a_displacement_of_nan_fails_alone():
    body = rope(5, 0.1)
    simulation, pickers = make_simulation(body, 1e-3), make_pickers(steps=2)
    start = at_rest(goals.straight(body))

    @jax.jit
    @jax.vmap
    def run(pick, move):
        return rollout(simulation, pickers, start, Actions(pick, move))[0].position

    picks = jnp.array([[[NONE, NONE]], [[99, NONE]], [[-7, 2**31 - 1]], [[0, 99]], [[0, 4]]])
    moves = jnp.broadcast_to(jnp.asarray(MOVE, float), (5, 1, 2, 3)).at[4].set(jnp.nan)
    idle, above, below, one, failed = np.asarray(run(picks, moves))
    np.testing.assert_array_equal(above, idle)
    np.testing.assert_array_equal(below, idle)
    # The other picker carries on.
    np.testing.assert_allclose(one[0], idle[0] + 0.01, atol=1e-6)
    assert np.isnan(failed).any()


# --- fingers that pinch ---------------------------------------------------------------------------


def pinched(pinch: Pinch | None, position: np.ndarray, pick: list[int], moves: list[list[float]]):
    """Held particles and their displacements, of a body whose particles are 4 mm thick."""
    pickers = make_pickers((0.3, 0.3, 0.3), max_stretch=1e6, pinch=pinch)
    place = jnp.asarray(position, float)
    action = Actions(jnp.asarray(pick), jnp.asarray(moves, float))
    held, moved = grasp(pickers, place, (Table(),), jnp.asarray(0.002), place, action)
    return np.flatnonzero(held).tolist(), np.asarray(moved)


STACK = np.array(
    # Four layers, 4 mm apart, and beside them a particle 12 mm away.
    [
        [0.0, 0.0, 0.002],
        [0.0, 0.0, 0.006],
        [0.001, 0.0, 0.010],
        [0.0, 0.0, 0.014],
        [0.012, 0, 0.002],
    ]
)
UP = [0.1, 0.0, 0.05]


@pytest.mark.parametrize(
    ("pinch", "pick", "expected"),
    [
        (None, [1], [1]),
        (Pinch(0.005, 0), [1], [1]),
        (Pinch(0.005, 1), [1], [0, 1, 2]),
        (Pinch(0.005, 1), [3], [2, 3]),
        (Pinch(0.005, 3), [0], [0, 1, 2, 3]),
        (Pinch(0.0005, 3), [0], [0, 1, 3]),
        (Pinch(0.02, 1), [0], [0, 1, 4]),
        (Pinch(0.02, 3), [NONE], []),
    ],
)
def test_a_pinch_holds_what_is_between_the_fingers(pinch, pick, expected):
    held, moves = pinched(pinch, STACK, pick, [UP])
    assert held == expected
    for particle, move in enumerate(moves):
        # The difference of two positions in float32, of up to 0.1 m.
        np.testing.assert_allclose(move, UP if particle in expected else 0.0, atol=1e-8)


def test_the_lowest_layer_of_a_pinch_stays_above_the_table():
    down = [0.0, 0.0, -0.1]
    raised = STACK + np.array([0.0, 0.0, 0.03])
    held, moves = pinched(Pinch(0.005, 3), raised, [3], [down])
    assert held == [0, 1, 2, 3]
    np.testing.assert_allclose(raised[0, 2] + moves[0, 2], 0.002, atol=1e-7)
    np.testing.assert_allclose(moves[:4], np.tile(moves[0], (4, 1)), atol=1e-8)


def test_who_names_a_particle_holds_it_and_nobody_else():
    held, moves = pinched(Pinch(0.02, 3), STACK, [0, 4], [UP, [0.0, 0.1, 0.05]])
    assert held == [0, 1, 2, 3, 4]
    np.testing.assert_allclose(moves[:4], np.tile(UP, (4, 1)), atol=1e-8)
    np.testing.assert_allclose(moves[4], [0.0, 0.1, 0.05], atol=1e-8)


def test_both_sheets_follow_a_pinch_in_a_rollout():
    shirt = t_shirt(num_particles=120, sheets=2).body
    start = goals.flat(shirt)
    corner = int(np.lexsort((start[:, 1], start[:, 0]))[0])
    near = np.linalg.norm(start[:, :2] - start[corner, :2], axis=1) <= 0.1
    simulation = make_simulation(shirt, 1e-3, self_contact=True)
    actions = Actions(jnp.array([[corner]]), jnp.array([[[0.05, 0.0, 0.05]]]))
    pickers = make_pickers((0.2, 0.2, 0.2), steps=200, pinch=Pinch(0.1, 1))
    _, (end,) = jax.jit(rollout)(simulation, pickers, at_rest(jnp.asarray(start, float)), actions)
    assert near.sum() >= 2
    assert np.ptp(start[near, 2]) > 0.9 * shirt.material.thickness  # both sheets
    # Held particles follow exactly, up to the sum of 200 steps in float32.
    np.testing.assert_allclose(end[near], start[near] + [0.05, 0.0, 0.05], atol=1e-5)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Pinch(-0.1, 1), "radius is -0.1"),
        (lambda: Pinch(0.1, -1), "layers is -1"),
        (lambda: make_pickers(pinch=0.1), "pinch is 0.1; give Pinch"),
    ],
)
@pytest.mark.usefixtures("unchecked_shapes")
def test_wrong_pinches_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
