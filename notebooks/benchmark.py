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
# # Benchmark on this machine
#
# How fast are rollouts, gradients, layers that touch, and a whole plan, on the machine that runs
# this notebook? `python -m experiments.benchmark` measures more, and beside other
# implementations; here is how it is done, in a few lines each.

# %%
import os
import time

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxsimp as js

SMALL = os.environ.get("JAXSIMP_NOTEBOOK_SIZE") == "small"  # the size that the tests run
print(jax.devices()[0].device_kind, os.cpu_count(), "cores, jax", jax.__version__)


# %% [markdown]
# ## How to time a function of JAX
#
# The first call compiles, and is told apart. Calls return before their results are there, so a
# clock waits for them. A machine is never quiet: the median of several calls, beside their range.


# %%
def measure(function, *arguments, repeats=3 if SMALL else 7):
    """Compilation time, and the times of calls in ascending order, seconds."""
    began = time.perf_counter()
    compiled = jax.jit(function).lower(*arguments).compile()
    compile_seconds = time.perf_counter() - began
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        jax.block_until_ready(compiled(*arguments))
        times.append(time.perf_counter() - began)
    return compile_seconds, np.sort(times)


# %% [markdown]
# ## One rollout, and its price with layers that touch
#
# A cloth's corner is carried over to the opposite corner and let go.

# %%
side = 9 if SMALL else 25
task = js.make_task("cloth_diagonal_folding", side)
start, pickers = js.at_rest(js.goals.flat(task.body)), task.pickers()
plan = js.Actions(
    pick=jnp.array([[side * side - 1, js.NONE], [js.NONE, js.NONE]]),
    displacement=jnp.array([[[-0.18, -0.18, 0.08], [0.0] * 3], [[0.0] * 3] * 2]),
)
physics = {
    name: task.simulation(self_contact=on) for name, on in [("without", False), ("with", True)]
}
steps = 2 * pickers.steps
seconds = {}
for name, simulation in physics.items():
    compiling, times = measure(lambda s, sim=simulation: js.rollout(sim, pickers, s, plan), start)
    seconds[name] = np.median(times)
    low, high = 1e6 * times[[0, -1]] / steps
    print(
        f"{name:8s} self-contact: {low:.0f} to {high:.0f} us a step; compiled in {compiling:.1f} s"
    )
print(f"self-contact costs {seconds['with'] / seconds['without']:.1f} times as much")

# %% [markdown]
# ## Many rollouts
#
# A search evaluates a population. Under one `vmap` the batch is the last axis of every array and
# fills the vector units of a core, as long as the states fit in its cache. That is why `js.Planner`
# evaluates a population in chunks of 8 cloths, on all cores, as `js.Layout` says.

# %%
simulation = physics["without"]
populations = (1, 2, 4) if SMALL else (1, 4, 16, 64)


def final_position(state):
    return js.rollout(simulation, pickers, state, plan)[0].position


def copies(count):
    """The start as a batch."""
    return jax.tree.map(lambda leaf: jnp.stack([leaf] * count), start)


rates = []
for population in populations:
    _, times = measure(jax.vmap(final_position), copies(population))
    rates.append(population * steps * side**2 / np.median(times) / 1e6)
    print(f"{population:3d} rollouts at a time: {rates[-1]:.0f} million particle steps a second")

# %% [markdown]
# ## Gradients
#
# Backwards through every time step, with checkpoints, so that memory grows as the square root of
# the number of steps.


# %%
def cost(displacement):
    moved = js.Actions(plan.pick, displacement)
    return jnp.sum(js.rollout(simulation, pickers, start, moved)[0].position ** 2)


compiling, forward = measure(cost, plan.displacement)
compiling_gradient, backward = measure(jax.grad(cost), plan.displacement)
ratio = np.median(backward) / np.median(forward)
print(f"a gradient costs {ratio:.1f} rollouts; compiled in {compiling_gradient:.1f} s")

# %% [markdown]
# ## A plan
#
# CEM over four key points. `plan.seconds` is without compilation.

# %%
key_points = js.simplify(task.body, task.goal)
planner, episode = js.Planner(task), task.episode_fn(0)
search = js.CEM(num_iterations=2, population=16) if SMALL else None
found = planner.plan(episode, key_points, search, seed=0)
score = planner.execute(episode, found.actions).score
print(f"{found.num_rollouts} plans in {found.seconds:.1f} s, the best of score {score:.3f}")
print(f"compiled in {found.compile_seconds:.1f} s")

# %% [markdown]
# ## In one figure

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
left.semilogx(populations, rates, "o-", base=2)
left.set_xticks(populations, populations)
left.set(xlabel="population", ylabel="million particle steps / s", title="Rollouts under one vmap")
left.set_ylim(bottom=0)
names = ["a rollout", "with self-contact", "a gradient"]
right.barh(names, [1, seconds["with"] / seconds["without"], ratio], color=["C0", "C1", "C2"])
right.set(xlabel="times a rollout without self-contact", title="What a rollout costs")
right.invert_yaxis()
plt.show()

# %% [markdown]
# What is checked here does not depend on the machine: that a batch is what single rollouts are,
# and that the gradient is that of the cost.

# %%
alone, two = final_position(start), jax.vmap(final_position)(copies(2))
assert np.abs(two - alone).max() < 1e-5, "a batch computes something else"  # float32, metres
assert np.all(np.isfinite(jax.grad(cost)(plan.displacement))), "the gradient is not finite"
