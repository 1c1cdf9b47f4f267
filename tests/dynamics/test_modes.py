"""Derivatives in any mode and order: right, or refused with the remedy."""

import importlib.util
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsimp import goals
from jaxsimp.bodies import rope
from jaxsimp.dynamics import (
    Actions,
    adjoint,
    at_rest,
    make_pickers,
    make_simulation,
    rollout,
    settle,
)

BODY = rope(3, 0.1)
MOVE = jnp.full((1, 1, 3), 0.01)


def end_fn(self_contact: bool, adjoint: bool = True):
    """Squared distance of the particles from the origin, after one action, by its displacement."""
    simulation = make_simulation(BODY, 1e-3, self_contact=self_contact)
    pickers, start = make_pickers(steps=3), goals.straight(BODY)

    def end(displacement):
        actions = Actions(jnp.array([[0]]), displacement)
        final, _ = rollout(simulation, pickers, at_rest(start), actions, adjoint=adjoint)
        return jnp.sum(final.position**2)

    return end


def jvp(fn):
    return lambda move: jax.jvp(fn, (move,), (move,))


def batched(fn):
    return lambda move: jax.vmap(fn)(move[None]).sum()


def grad_of_grad(fn):
    return jax.grad(lambda move: jax.grad(fn)(move).sum())


FORWARD = {
    "jvp": jvp,
    "jit of jvp of jit": lambda fn: jax.jit(jvp(jax.jit(fn))),
    "jacfwd of jit": lambda fn: jax.jacfwd(jax.jit(fn)),
}


@pytest.mark.parametrize("name", FORWARD)
def test_forward_mode_is_told_what_to_pass(name):
    wanted = (
        r"^a rollout is differentiated in reverse mode .* needs rollout\(\.\.\., adjoint=False\)"
    )
    with pytest.raises(TypeError, match=wanted):
        FORWARD[name](end_fn(self_contact=False))(MOVE)


def test_forward_mode_of_settle_is_refused():
    simulation = make_simulation(BODY, 1e-3)
    with pytest.raises(TypeError, match="adjoint=False"):
        jvp(lambda start: settle(simulation, at_rest(start), 2).position)(
            at_rest(BODY.rest).position
        )


SECOND = {
    "jit of both": lambda fn: jax.jit(grad_of_grad(jax.jit(fn))),
    "of vmap": lambda fn: grad_of_grad(batched(fn)),
}


@pytest.mark.parametrize("name", SECOND)
def test_a_gradient_of_a_gradient_is_told_what_to_take(name):
    with pytest.raises(
        TypeError, match=r"by jax\.hessian .* need rollout\(\.\.\., adjoint=False\)"
    ):
        SECOND[name](end_fn(self_contact=False))(MOVE)


def test_second_derivatives_with_self_contact_are_refused():
    with pytest.raises(TypeError, match=r"second derivatives need rollout.*adjoint=False"):
        jax.hessian(end_fn(self_contact=True))(MOVE)


@pytest.mark.usefixtures("x64")
def test_a_hessian_is_that_of_differences_of_the_gradient():
    end, move = end_fn(self_contact=False), jnp.full((1, 1, 3), 0.01)
    found = np.asarray(jax.jit(jax.hessian(end))(move)).reshape(3, 3)
    gradient = jax.jit(jax.grad(end))
    steps = 1e-5 * np.eye(3).reshape(3, 1, 1, 3)
    wanted = [(gradient(move + step) - gradient(move - step)) / 2e-5 for step in steps]
    # Differences err by 1e-10 times a third derivative and by 1e-16 / 1e-5, of values near 1.
    np.testing.assert_allclose(found, np.reshape(wanted, (3, 3)), atol=1e-8)
    assert np.abs(found).max() > 0.1


def test_where_jax_is_made_otherwise_the_marks_are_left_out(monkeypatch):
    monkeypatch.setitem(sys.modules, "jaxsimp.dynamics.modes", None)  # an import of it fails
    spec = importlib.util.spec_from_file_location("adjoint_again", adjoint.__file__)
    again = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(again)
    for mark in (again.reverse_only, again.forward_only, again.constant):
        assert mark((1.0,)) == (1.0,)
