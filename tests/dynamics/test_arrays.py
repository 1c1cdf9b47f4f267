"""The door for arrays: forms of the same numbers are one, and what is no number is refused."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsimp.bodies import rope
from jaxsimp.dynamics import (
    Actions,
    Capsule,
    State,
    at_rest,
    make_pickers,
    make_simulation,
    rollout,
    settle,
    table_with_edge,
)

BODY = rope(5)
START = BODY.rest + np.array([0.0, 0.0, BODY.radius])
PLAN = Actions(jnp.array([[0, -1]]), jnp.array([[[0.01, 0.0, 0.02], [0.0, 0.0, 0.0]]]))
SAME = {
    "a list": lambda array: np.asarray(array).tolist(),
    "other bytes": lambda array: np.asarray(array).astype(array.dtype.newbyteorder()),
    "nothing masked": lambda array: np.ma.masked_array(array, np.zeros(array.shape, bool)),
    "of JAX": jnp.asarray,
}
WRONG = {
    "a number": (1, r"position has shape \(\); give shape \(N, 3\)"),
    "rows of two": (START[:, :2], r"position has shape \(5, 2\); give shape \(N, 3\)"),
    "a batch": (START[None], r"position has shape \(1, 5, 3\); give shape \(N, 3\)"),
    "other lengths": ([[0.0, 0.0, 0.0], [1.0]], "position is .*; give .* with rows of one length"),
    "text": ("flat", "position is 'flat'; give an array of real numbers"),
    "complex": (START + 1j, "position is an array of complex128; give an array of real numbers"),
    "truths": (START > 0, "position is an array of bool; give an array of real numbers"),
    "some masked": (np.ma.masked_less(START, 0), r"position has 2 masked numbers; give numbers"),
}


@pytest.fixture(scope="module")
def moved():
    """The simulation and pickers of a rope, and where a plan carries it."""
    simulation, pickers = make_simulation(BODY), make_pickers(steps=3)
    return simulation, pickers, np.asarray(rollout(simulation, pickers, at_rest(START), PLAN)[1])


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize("form", SAME)
def test_numbers_in_another_form_move_a_body_alike(form, moved):
    simulation, pickers, wanted = moved
    actions = Actions(SAME[form](PLAN.pick), SAME[form](PLAN.displacement))
    state = State(SAME[form](START), SAME[form](0 * START))
    for start in (at_rest(SAME[form](START)), state):
        np.testing.assert_array_equal(rollout(simulation, pickers, start, actions)[1], wanted)


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize("name", WRONG)
def test_what_is_no_position_is_refused(name):
    given, message = WRONG[name]
    with pytest.raises(ValueError, match=message):
        at_rest(given)


@pytest.mark.usefixtures("unchecked_shapes")
def test_what_is_no_state_is_refused_and_a_traced_one_that_fails_fails_alone(moved):
    simulation, pickers, wanted = moved
    fine = at_rest(START)
    lost = dataclasses.replace(fine, position=fine.position.at[1, 2].set(jnp.nan))
    fast = dataclasses.replace(fine, velocity=fine.velocity + jnp.inf)
    for state, message in (
        (START, r"the state is a ndarray; give at_rest\(position\)"),
        (lost, r"state.position\[1, 2\] is nan; give numbers from -1e\+06 to 1e\+06 m"),
        (fast, r"state.velocity\[0, 0\] is inf; give numbers .* m/s"),
        (State(fine.position, fine.velocity[:4]), r"velocity of the state has shape \(4, 3\)"),
    ):
        with pytest.raises(ValueError, match=message):
            settle(simulation, state, 1)
        with pytest.raises(ValueError, match=message):
            rollout(simulation, pickers, state, PLAN)
    both = jax.tree.map(lambda *leaves: jnp.stack(leaves), fine, lost)
    frames = jax.vmap(lambda state: rollout(simulation, pickers, state, PLAN)[1])(both)
    np.testing.assert_array_equal(frames[0], wanted)
    assert np.isnan(frames[1]).any()


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"self_contact": 1}, "self_contact is 1; give True or False"),
        ({"top_speed": -0.5}, "top_speed is -0.5; give a number from 1e-12 to 1e.09 m/s"),
        ({"time_step": 1e-300}, "time_step is 1e-300 s; .* stable from 1e-12 to"),
    ],
)
def test_a_simulation_names_what_it_does_not_take(wrong, message):
    with pytest.raises(ValueError, match=message):
        make_simulation(BODY, **wrong)


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize(
    ("end", "message"),
    [
        ((1.0, (2.0, 3.0), 0.0), "Capsule: end is .*; give three finite numbers"),
        ((0, 0, 0), r"both \(0, 0, 0\); give two points at least 1e-06 m apart, or a Sphere"),
    ],
)
def test_a_capsule_has_two_ends(end, message):
    with pytest.raises(ValueError, match=message):
        make_simulation(BODY, obstacles=[Capsule((0, 0, 0), end, 0.3)])


@pytest.mark.usefixtures("unchecked_shapes")
def test_a_table_with_an_edge_takes_metres_and_traced_ones():
    for wrong in ({"edge": {1, 2}}, {"height": -1.0}, {"rounding": np.datetime64("2020-01-01")}):
        (name,) = wrong
        with pytest.raises(ValueError, match=f"{name} is .*; give a number from"):
            table_with_edge(**wrong)
    edges = jax.vmap(lambda edge: table_with_edge(edge).center[0])(jnp.array([0.5, 2.0]))
    np.testing.assert_array_equal(edges, [-0.5, 1.0])
