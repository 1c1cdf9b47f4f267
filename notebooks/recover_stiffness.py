# ---
# jupyter:
#   jupytext:
#     formats: py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Recover a stiffness, and an action, through the dynamics
#
# `jaxsimp.dynamics` is differentiable: the gradient of anything that a rollout leads to, with
# respect to anything that went into it, is one `jax.grad` away. Here it is used twice, with
# gradient descent by [optax](https://optax.readthedocs.io):
#
# 1. **System identification.** A rope is seen hanging from one end and bouncing. How stiff is it?
# 2. **Planning.** A picker lifts the end of a rope on a table. Where must it go for the rope to
#    end in a given shape?
#
# Both answers are known, so both are checked at the end: this notebook is run by the tests.

# %%
import dataclasses
import os
from functools import partial

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax

from jaxsimp import goals
from jaxsimp.bodies import rope
from jaxsimp.dynamics import (
    NONE,
    Actions,
    at_rest,
    largest_time_step,
    make_pickers,
    make_simulation,
    rollout,
)

SMALL = os.environ.get("JAXSIMP_NOTEBOOK_SIZE") == "small"  # the size that the tests run
# Optimised less, gradients compile three times as fast, and here there is little to run.
jit = partial(jax.jit, compiler_options={"xla_backend_optimization_level": 1})
num_particles, observations = (8, 6) if SMALL else (21, 12)

# %% [markdown]
# ## 1. How stiff is this rope?
#
# The rope lies along x, a picker grasps one end and holds it still, and the rest swings down under
# gravity and stretches. We see all particles at a few moments. A moment is an "action" that holds
# an end for a short time.

# %%
body = rope(num_particles, 0.5)
start = goals.flat(body) + np.array([0.0, 0.0, 1.0])  # a metre above the table
time_step = min(1e-3, 0.25 * largest_time_step(body))  # stable up to 16 times the stiffness
simulation = make_simulation(body, time_step)
pickers = make_pickers(steps=round(0.02 / time_step))
hold = Actions(pick=jnp.full((observations, 1), 0), displacement=jnp.zeros((observations, 1, 3)))


def trajectory(log_factor):
    """Positions at each moment, if all springs were exp(log_factor) times as stiff."""
    springs = dataclasses.replace(
        simulation.springs, stiffness=simulation.springs.stiffness * jnp.exp(log_factor)
    )
    softer = dataclasses.replace(simulation, springs=springs)
    return rollout(softer, pickers, at_rest(start), hold)[1]


true_factor = 0.4
observed = jit(trajectory)(jnp.log(true_factor))

# %% [markdown]
# The unknown is the logarithm of a factor on the stiffness: steps are then relative, and the
# stiffness stays positive. The loss is the mean squared distance between what is seen and what the
# guess predicts. Its gradient goes backwards through every time step.


# %%
def descend(loss_fn, guess, learning_rate, steps):
    """Adam with a learning rate that falls to zero; all guesses and losses on the way."""
    optimizer = optax.adam(optax.cosine_decay_schedule(learning_rate, steps))

    @jit
    def run(guess):
        def step(carry, _):
            guess, state = carry
            loss, gradient = jax.value_and_grad(loss_fn)(guess)
            updates, state = optimizer.update(gradient, state)
            return (optax.apply_updates(guess, updates), state), (guess, loss)

        (guess, _), history = jax.lax.scan(step, (guess, optimizer.init(guess)), length=steps)
        return guess, *history

    return run(guess)


def misfit(log_factor):
    return jnp.mean(jnp.sum((trajectory(log_factor) - observed) ** 2, axis=-1))


steps = 150
found, log_factors, misfits = descend(misfit, jnp.zeros(()), learning_rate=0.15, steps=steps)
stretch = body.stiffness.max()
print(f"true stiffness  {stretch * true_factor:.2f} N/m")
print(f"first guess     {stretch:.2f} N/m")
print(f"recovered       {stretch * float(jnp.exp(found)):.2f} N/m")

# %% [markdown]
# ## 2. Which displacement makes this shape?
#
# Now the rope lies on the table. A picker grasps its last particle, carries it 8 cm up and
# somewhere to the side, and lets go; the rope follows, and friction holds what has landed. The
# shape that we want was made by a displacement that we pretend not to know. We start from a much
# smaller one.

# %%
carry = make_pickers((0.3, 0.3, 0.3), steps=round(0.2 / time_step))
on_table = at_rest(goals.flat(body))


def final_shape(displacement):
    """The rope after the picker has moved and then let go."""
    up = jnp.append(displacement, 0.08)
    actions = Actions(
        pick=jnp.array([[num_particles - 1], [NONE]]),
        displacement=jnp.stack([up, jnp.zeros(3)])[:, None],
    )
    return rollout(simulation, carry, on_table, actions)[0].position


true_displacement = jnp.array([-0.15, 0.12])
wanted = jit(final_shape)(true_displacement)


def distance_to_goal(displacement):
    return jnp.mean(jnp.sum((final_shape(displacement) - wanted) ** 2, axis=-1))


guess = jnp.array([-0.05, 0.03])
plan, _, distances = descend(distance_to_goal, guess, learning_rate=0.02, steps=steps)
print("true displacement (cm) ", np.round(100 * np.asarray(true_displacement), 2))
print("recovered              ", np.round(100 * np.asarray(plan), 2))

# %% [markdown]
# ## What was recovered

# %%
figure, (left, middle, right) = plt.subplots(1, 3, figsize=(12, 3.4), layout="constrained")
left.plot(stretch * np.exp(log_factors), label="guess")
left.axhline(stretch * true_factor, color="black", ls="--", label="true")
left.set(xlabel="step of gradient descent", ylabel="stiffness (N/m)", title="Stiffness")
left.legend(frameon=False)

middle.semilogy(1e3 * np.sqrt(misfits), label="trajectory seen")
middle.semilogy(1e3 * np.sqrt(distances), label="shape wanted")
middle.set(xlabel="step of gradient descent", ylabel="RMS distance (mm)", title="Losses")
middle.legend(frameon=False)

reached = jit(final_shape)(plan)
for shape, style, label in [
    (on_table.position, "C7-", "start"),
    (jit(final_shape)(guess), "C1-", "first guess"),
    (wanted, "k--", "wanted"),
    (reached, "C0.", "reached"),
]:
    right.plot(*np.asarray(shape)[:, :2].T, style, label=label)
right.set(xlabel="x (m)", ylabel="y (m)", title="Shape, from above", aspect="equal")
right.legend(frameon=False, fontsize="small")
plt.show()

# %% [markdown]
# The checks, with room for another machine's rounding: the stiffness to 1 %, the displacement and
# the shape to half a millimetre.

# %%
missed = float(jnp.sqrt(jnp.mean(jnp.sum((reached - wanted) ** 2, axis=-1))))
print(f"shape missed by {1e3 * missed:.3f} mm, at first by {1e3 * distances[0] ** 0.5:.0f} mm")
assert abs(float(jnp.exp(found)) / true_factor - 1) < 0.01, "the stiffness was not recovered"
assert float(jnp.max(jnp.abs(plan - true_displacement))) < 5e-4, "the action was not recovered"
assert missed < 5e-4, "the shape was not reached"
