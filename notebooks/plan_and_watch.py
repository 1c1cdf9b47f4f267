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
# # Plan and watch
#
# From a goal to a plan, its execution, and a view that moves: what `jaxsimp plan` does, in
# Python.

# %%
import base64
import os
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from IPython.display import IFrame

import jaxsimp as js

SMALL = os.environ.get("JAXSIMP_NOTEBOOK_SIZE") == "small"  # the size that the tests run

# %% [markdown]
# ## A goal of one's own
#
# A towel, and a fold that no library has by name: along a line at 30 degrees, off the centre.
# `Fold` takes a point on the crease and a direction; what lies on its left is folded over.

# %%
spacing = 0.05 if SMALL else 0.0125
shape = tuple(1 + round(length / spacing) for length in (0.3, 0.2))
towel = js.cloth(shape, (0.3, 0.2))
angle = np.deg2rad(30)
fold = js.goals.Fold(np.array([0.03, 0.0]), np.array([np.cos(angle), np.sin(angle)]))
goal = js.goals.fold_sequence(towel, [fold])
key_points = js.simplify(towel, goal)
print(f"{len(key_points.particles)} key points of {towel.num_particles} particles")

# %% [markdown]
# ## The plan
#
# `js.plan` searches twice and keeps the better plan. It is scored by what the cloth looks like
# once it has settled, with layers that touch: 1 at the goal, 0 for what is as far away as the
# start.

# %%
plan = js.plan(towel, goal, seed=0, search="cem" if SMALL else "default")
print(f"score {plan.score:.3f}, {plan.search.num_rollouts} rollouts")
for number, (picks, moves) in enumerate(
    zip(plan.actions.pick, plan.actions.displacement, strict=True)
):
    for picker, (particle, move) in enumerate(zip(picks, moves, strict=True)):
        what = "nothing" if particle == js.NONE else f"particle {particle}"
        print(f"action {number}, picker {picker}: {what}, moved by {np.round(1e3 * move)} mm")

# %% [markdown]
# ## Watch it
#
# `plan.animate` writes one file that moves in any browser, without Python. Here it is, inside the
# notebook: drag to turn it, and use the slider.

# %%
page = Path(tempfile.mkdtemp()) / "plan.html"
plan.animate(page)
content = base64.b64encode(page.read_bytes()).decode()
IFrame(f"data:text/html;base64,{content}", width="100%", height=480)

# %% [markdown]
# ## For a paper
#
# Start, the end of each action, the settled state, and the goal.

# %%
executions = {"planned": (plan.execution.positions, plan.score)}
figure = js.viz.plot_executions(towel, goal, executions, "a towel, folded at 30 degrees")
plt.show()

# %% [markdown]
# ## In another physics
#
# MuJoCo is somebody else's simulator. A plan that works there as well does not live on a weakness
# of ours.

# %%
there = plan.verify()
print(f"in MuJoCo {there.score:.3f} ({there.status.name.lower()})")

# %% [markdown]
# ## Keep it
#
# A plan file has body, task, start, goal and provenance. `jaxsimp view` and `jaxsimp export` read
# it.

# %%
path = page.with_name("plan.npz")
plan.save(path)
saved = js.load_plan(path)
print(sorted(saved.about))
assert np.array_equal(saved.actions.pick, plan.actions.pick), "the file has another plan"
assert plan.score > (0.5 if SMALL else 0.9), "the towel was not folded"
