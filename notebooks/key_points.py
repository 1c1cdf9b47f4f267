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
# # Key points of a goal
#
# A goal is a position for every particle. The smallest model that fits it, a line of few pieces
# or a mesh of few triangles, tells which particles matter: its corners, the *key points*. A
# planner then grasps these alone.

# %%
import os

import matplotlib.pyplot as plt
import numpy as np

import jaxsimp as js

SMALL = os.environ.get("JAXSIMP_NOTEBOOK_SIZE") == "small"  # the size that the tests run

# %% [markdown]
# ## Ropes
#
# A rope laid as an M has five corners, ends included. `js.simplify` finds them, and proves that
# no line with fewer pieces is near enough (`certified`).

# %%
rope = js.rope(41)
goal = js.goals.letter(rope, "M")
model = js.simplify(rope, goal)
print("key points", model.particles, "largest error", f"{1e3 * model.max_error:.1f} mm")
print(f"allowed {1e3 * model.tolerance:.1f} mm; proven to be the smallest: {model.certified}")

# %% [markdown]
# A camera sees no clean goal. With 2 mm of noise the particles at the corners stay, give or take
# one, since the error that a model may have is larger than the noise.

# %%
rng = np.random.default_rng(0)
noisy = goal + rng.normal(scale=2e-3, size=goal.shape)
noisy[:, 2] = np.maximum(noisy[:, 2], 0.0)  # nothing lies below the table
of_noisy = js.simplify(rope, noisy)
print("key points with noise", of_noisy.particles)
figure = js.viz.plot_models(
    {"a letter": (rope, goal, model), "with noise": (rope, noisy, of_noisy)}
)
plt.show()

# %% [markdown]
# ## How small is small enough?
#
# The model's error falls as key points are added, and the first number below the tolerance is
# taken. `errors` keeps the whole curve.

# %%
figure = js.viz.plot_model_errors({"letter M": model, "with noise": of_noisy})
plt.show()

# %% [markdown]
# ## Cloths
#
# A surface's model is a mesh of few triangles, and its corners are found with *rest* coordinates
# in view, so that the layers of a fold are told apart though they lie at the same place.

# %%
side = 11 if SMALL else 25
cloth = js.cloth((side, side))
names = ("side", "diagonal", "letter")
folded = {
    name: js.goals.fold_sequence(cloth, js.goals.rectangle_folds(cloth, name)) for name in names
}
models = {name: js.simplify(cloth, goal) for name, goal in folded.items()}
for name, found in models.items():
    print(f"{name:9s} {len(found.particles)} of {cloth.num_particles} particles")
figure = js.viz.plot_models({name: (cloth, folded[name], models[name]) for name in names})
plt.show()

# %% [markdown]
# ## Many goals at once
#
# Goals of one body are a batch: noise drawn 16 times, and how often the right key points are
# found. A goal without a model has a status; it is not an exception.

# %%
goals = np.stack([goal for _ in range(4 if SMALL else 16)])
goals[:, :, :2] += rng.normal(scale=1e-3, size=(*goals.shape[:2], 2))
found = js.simplify_batch(rope, goals)
right = [np.array_equal(each.particles, model.particles) for each in found]
near = [
    len(each.particles) == len(model.particles)
    and np.abs(each.particles - model.particles).max() <= 1
    for each in found
]
print(f"the same particles {sum(right)} of {len(right)}, or their neighbours {sum(near)}")

# %% [markdown]
# ## What they are for
#
# Candidates of a plan. With two pickers a cloth of 625 particles has 390,625 pairs to grasp, its
# side fold's key points have 36.

# %%
num_pairs = {
    name: (cloth.num_particles**2, len(found.particles) ** 2) for name, found in models.items()
}
for name, (all_pairs, few) in num_pairs.items():
    print(f"{name:9s} {all_pairs} pairs of particles, {few} of key points")

assert len(model.particles) == 5, "an M has five corners"
assert len(models["diagonal"].particles) == 4, "a diagonal fold has four"
assert all(near), "noise moved a corner by more than a particle"
