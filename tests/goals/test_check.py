"""The doors for goals: what a body can be is let in, noise and all; what it cannot is named."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxsimp import goals
from jaxsimp.bodies import Body, cloth, from_mesh, rope
from jaxsimp.bodies.garments import t_shirt
from jaxsimp.goals.check import NOISE, SQUEEZED

CLOTH = cloth((6, 5), (0.3, 0.2))
SHIRT = t_shirt(num_particles=200).body
seeds = st.integers(0, 10**6)


def test_check_goal_gives_the_goal_as_floats():
    goal = goals.flat(CLOTH)
    np.testing.assert_array_equal(goals.check_goal(CLOTH, goal), goal)
    assert goals.check_goal(CLOTH, goal.astype(np.float32)).dtype == np.float64


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize(
    ("goal", "message"),
    [
        (np.zeros((30, 2)), r"goal has shape \(30, 2\); give shape \(30, 3\), .*of the cloth"),
        (np.zeros((29, 3)), r"goal has shape \(29, 3\)"),
        (np.zeros(3), r"goal has shape \(3,\)"),
    ],
)
def test_check_goal_refuses_a_wrong_shape(goal, message):
    with pytest.raises(ValueError, match=message):
        goals.check_goal(CLOTH, goal)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_check_goal_names_the_first_particle_that_is_not_finite(bad):
    goal = goals.flat(CLOTH)
    goal[[4, 9], 1] = bad
    with pytest.raises(ValueError, match=r"goal of particle 4 is .*\(2 such particles\)"):
        goals.check_goal(CLOTH, goal)


@pytest.mark.usefixtures("unchecked_shapes")
def test_as_goal_refuses_the_same_shapes_and_lets_a_stretched_body_in():
    with pytest.raises(ValueError, match=r"goal has shape \(30, 2\)"):
        goals.as_goal(CLOTH, np.zeros((30, 2)))
    far = 10 * goals.flat(CLOTH) - 1.0  # the cloth stretched tenfold, a metre under the table
    np.testing.assert_array_equal(goals.as_goal(CLOTH, far), far)


# --- what is let in ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("body", "noise"),
    [
        (rope(41, 0.5), 4e-3),
        (cloth((25, 25), (0.3, 0.3)), 2e-3),
        (cloth((64, 64), (0.3, 0.3)), 2e-3),
        (SHIRT, 2e-3),
    ],
    ids=["rope", "cloth 25", "cloth 64", "shirt"],
)
@pytest.mark.parametrize("seed", range(5))
def test_noise_is_no_stretch(body, noise, seed):
    rng = np.random.default_rng(seed)
    folded = goals.fold(body, goals.flat(body), np.zeros(2), np.array([0.3, 1.0]))
    for goal in (goals.flat(body), folded):
        goals.check_goal(body, goal + rng.normal(scale=noise, size=goal.shape))


@given(seed=seeds, share=st.floats(0.0, 1.0))
def test_a_body_that_is_crumpled_or_squeezed_is_let_in(seed, share):
    rng = np.random.default_rng(seed)
    for body in (CLOTH, SHIRT, rope()):
        # A map that brings no two points farther apart: a rotation and shares of the axes.
        turn, _ = np.linalg.qr(rng.standard_normal((3, 3)))
        goal = body.rest @ turn * np.array([1.0, share, share])
        goal[:, 2] -= goal[:, 2].min()
        edges = body.springs[body.families == 0]
        lengths = np.linalg.norm(goal[edges[:, 1]] - goal[edges[:, 0]], axis=1)
        if lengths.sum() > 1.01 * SQUEEZED * body.rest_length[body.families == 0].sum():
            goals.check_goal(body, goal)
        else:
            with pytest.raises(ValueError, match=r"have .* of their length at rest; 0.1 is the"):
                goals.check_goal(body, 0.98 * goal)


def test_a_stretch_that_pickers_may_make_is_let_in():
    for body in (CLOTH, SHIRT, rope()):
        goals.check_goal(body, goals.flat(body) * [1.19, 1.19, 1.0])


# --- what is not ---------------------------------------------------------------------------------


@pytest.mark.parametrize("body", [CLOTH, SHIRT, rope()], ids=["cloth", "shirt", "rope"])
@given(ratio=st.floats(1.4, 9.0))
def test_a_stretched_body_is_refused_with_the_pair(body, ratio):
    with pytest.raises(ValueError, match=r"in the goal particles \d+ and \d+ are") as refused:
        goals.check_goal(body, goals.flat(body) * [ratio, ratio, 1.0])
    words = str(refused.value).split()
    first, second = int(words[4]), int(words[6])
    apart, long = float(words[8]), float(words[words.index("long") - 2])
    straight = np.linalg.norm(body.rest[first] - body.rest[second])
    np.testing.assert_allclose(apart, ratio * straight, rtol=1e-3)
    # Along the springs it is farther than straight, on these sheets by no more than a third.
    assert straight * 0.999 <= long <= 1.34 * straight


@given(particle=st.integers(0, 29), seed=seeds)
def test_one_particle_far_away_is_refused(particle, seed):
    rng = np.random.default_rng(seed)
    goal = goals.flat(CLOTH)
    angle = rng.uniform(0, 2 * np.pi)
    goal[particle, :2] += 0.35 * np.array([np.cos(angle), np.sin(angle)])
    with pytest.raises(ValueError, match=r"the cloth is only .* m long between them"):
        goals.check_goal(CLOTH, goal)


def test_particles_in_another_order_are_refused():
    body = cloth((10, 10))
    order = np.random.default_rng(0).permutation(100)
    with pytest.raises(ValueError, match="with the particles in the body's order"):
        goals.check_goal(body, goals.flat(body)[order])


@given(depth=st.floats(1.01 * NOISE * 0.3, 0.8), particle=st.integers(0, 29))
def test_a_particle_under_the_table_is_named(depth, particle):
    goal = goals.flat(CLOTH)
    goal[particle, 2] = -depth
    with pytest.raises(ValueError, match=f"goal of particle {particle} is .* m under the table"):
        goals.check_goal(CLOTH, goal)


def test_without_a_table_a_goal_may_be_anywhere_below():
    goal = goals.flat(CLOTH) - np.array([0.0, 0.0, 1.0])
    np.testing.assert_array_equal(goals.check_goal(CLOTH, goal, has_table=False), goal)
    with pytest.raises(ValueError, match="under the table"):
        goals.check_goal(CLOTH, goal)


def test_a_goal_that_dips_into_the_table_with_its_noise_is_let_in():
    goal = goals.flat(CLOTH)
    goal[3, 2] = -0.99 * NOISE * 0.3
    goals.check_goal(CLOTH, goal)


def test_pieces_that_no_spring_joins_may_be_anywhere():
    one = rope(3, 0.1)
    pair = Body(
        name="two ropes",
        rest=np.concatenate([one.rest, one.rest + np.array([0, 0.1, 0])]),
        mass=np.ones(6),
        springs=np.concatenate([one.springs, one.springs + 3]),
        families=np.tile(one.families, 2),
        rest_length=np.tile(one.rest_length, 2),
        stiffness=np.ones(6),
        damping=np.zeros(6),
        faces=np.zeros((0, 3), dtype=int),
        material=one.material,
        shape=(6,),
    )
    goals.check_goal(pair, pair.rest + np.repeat([0.0, 3.0], 3)[:, None])


def test_a_bent_sheet_is_measured_along_itself():
    flat = cloth((25, 9), (0.3, 0.1))
    radius = 0.3 / np.pi
    angle = flat.rest[:, 0] / radius
    arch = np.stack([radius * np.sin(angle), flat.rest[:, 1], radius * np.cos(angle)], axis=1)
    body = from_mesh(arch, flat.faces)
    # Unrolled, its ends are pi / 2 times as far apart as they were straight through the air.
    goals.check_goal(body, goals.flat(flat))
    with pytest.raises(ValueError, match="the mesh is only"):
        goals.check_goal(body, goals.flat(flat) * [1.4, 1.0, 1.0])
