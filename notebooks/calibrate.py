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
# # Calibrate a rope and a cloth to MuJoCo
#
# A plan is only as good as the physics that it was found in. Here the physics is another engine's:
# a rope and a cloth are simulated by [MuJoCo](https://mujoco.org) as *flexes*, with stiffness and
# damping that we pretend not to know. `jaxsimp.calibration` sees how they swing while a
# picker carries one particle about, and scales our stiffness, damping and drag, by gradient descent
# through our dynamics, until our rope and our cloth swing alike. Other motions, not seen by it,
# then show whether it has learnt the physics or just the recording.
#
# MuJoCo's flexes are not mass-spring systems: a cloth there is a sheet of finite elements. The
# numbers that are found are those of our model that come closest.

# %%
import os
import time
from dataclasses import dataclass, replace

import jax.numpy as jnp
import matplotlib.pyplot as plt
import mujoco
import numpy as np

from jaxsimp import goals
from jaxsimp.bodies import Body, cloth, rope
from jaxsimp.bodies.topology import are_among, chain, half_edges
from jaxsimp.calibration import (
    CalibrationConfig,
    Recording,
    calibrate,
    recording_error,
    simulate_recordings,
)
from jaxsimp.dynamics import Actions, at_rest

SMALL = os.environ.get("JAXSIMP_NOTEBOOK_SIZE") == "small"  # the size that the tests run
num_actions, steps = (6, 80) if SMALL else (8, 150)
action_seconds, mujoco_step = 0.05, 5e-4
longest = 1e-3  # time step of replays, seconds

# %% [markdown]
# ## The other engine
#
# A flex is made of the particles and triangles (or links) of our body, a metre above the table. Its
# vertices have three slide joints each, whose damping is the air's. The picker's particle is put
# where the picker is after every time step.


# %%
@dataclass(frozen=True)
class Flex:
    """What the other engine knows of a flex, and we do not.

    Attributes:
        settings: XML of its edges or its elasticity.
        drag: of the air, per second.
    """

    settings: str
    drag: float


def flex_model(body: Body, flex: Flex) -> mujoco.MjModel:
    """A body as a flex of MuJoCo."""
    dim, elements = 2, body.faces
    if not len(elements):
        dim, elements = 1, chain(body.num_particles)
    points = " ".join(f"{value:.9g}" for value in body.rest.ravel())
    model = mujoco.MjModel.from_xml_string(f"""
        <mujoco>
          <option timestep="{mujoco_step}" integrator="Euler"/>
          <worldbody>
            <flexcomp name="body" type="direct" dim="{dim}" mass="{body.mass.sum()}"
                radius="{body.radius}" point="{points}"
                element="{" ".join(map(str, elements.ravel()))}">
              {flex.settings}
              <contact selfcollide="none" contype="0" conaffinity="0"/>
            </flexcomp>
          </worldbody>
        </mujoco>""")
    model.dof_damping[:] = flex.drag * model.body_mass[model.dof_bodyid]
    return model


def record(body: Body, flex: Flex, picked: list[int], moves: np.ndarray) -> Recording:
    """The flex swings while pickers carry particles along displacements, shape (T, G, 3)."""
    model = flex_model(body, flex)
    data = mujoco.MjData(model)
    start = goals.flat(body) + np.array([0.0, 0.0, 1.0])
    position, velocity = data.qpos.reshape(-1, 3), data.qvel.reshape(-1, 3)  # views
    position[:] = start - body.rest
    steps = round(action_seconds / mujoco_step)
    seen = []
    for move in moves:
        origin = position[picked]
        for step in range(steps):
            mujoco.mj_step(model, data)
            # The speed of a picker is a parabola, that starts and ends at rest.
            part = (step + 1) / steps
            position[picked] = origin + move * part**2 * (3 - 2 * part)
            velocity[picked] = move * 6 * part * (1 - part) / action_seconds
        seen.append(position + body.rest)
    assert np.isfinite(position).all()
    assert not any(warning.number for warning in data.warning), "MuJoCo's simulation failed"
    actions = Actions(jnp.tile(jnp.array(picked), (len(moves), 1)), jnp.asarray(moves))
    return Recording(at_rest(start), actions, np.array(seen))


def motions(body, flex, picked, seed, num_actions=num_actions) -> list[Recording]:
    """Recordings of random moves, one for each choice of picked particles."""
    rng = np.random.default_rng(seed)
    reach = 0.12 * body.size
    return [
        record(body, flex, each, rng.uniform(-reach, reach, (num_actions, len(each), 3)))
        for each in picked
    ]


# %% [markdown]
# ## What we guess
#
# The mass is that of the flexes, for a balance would tell it. All else is a first guess: our
# default rope and cloth. The calibration sees the rope swing from one end, and the cloth from two
# opposite edges, one after the other. The errors that count are those of motions that it does not
# see: the rope from its other end and from its middle, the cloth from the two other edges.
#
# Springs of one kind share a factor. MuJoCo's triangles cut all cells along one diagonal, so the
# springs along it are of another kind than those along the other.


# %%
def kinds_of_springs(body):
    """Springs by stiffness, counted from the softest, and last those on diagonals of triangles."""
    values, kinds = np.unique(body.stiffness, return_inverse=True)
    is_edge = are_among(body.springs, half_edges(body.faces)[0])
    is_longest = np.isclose(body.rest_length, np.sqrt(2) * body.rest_length.min())
    return np.where(is_edge & is_longest, len(values), kinds)


rope_body = rope(9 if SMALL else 15, 0.4)
side = 7 if SMALL else 9
cloth_body = cloth((side, side), (0.2, 0.2), mass=0.008)
a, b, c, d = 0, side - 1, side * (side - 1), side**2 - 1  # the corners
last = rope_body.num_particles - 1
cases = {
    "rope": (
        rope_body,
        Flex('<edge stiffness="40" damping="0.02"/>', drag=2.0),
        [[0]],
        [[last], [last // 2]],
    ),
    "cloth": (
        cloth_body,
        Flex(
            '<elasticity young="3000" poisson="0.3" thickness="0.002" damping="0.001" '
            'elastic2d="both"/>',
            drag=3.0,
        ),
        [[a, b], [c, d]],
        [[a, c], [b, d]],
    ),
}
config = CalibrationConfig(
    ("stiffness", "damping", "drag"),
    steps=steps,
    learning_rate=0.2,
    largest_factor=8.0,
    longest_time_step=longest,
)
found, unseen, errors = {}, {}, {}


def replay_errors(name, recordings):
    """RMS errors (m) of the first guess and of what was found."""
    bodies = cases[name][0], found[name].body
    return [
        recording_error(body, recordings, action_seconds, longest_time_step=longest)
        for body in bodies
    ]


for name, (body, flex, picked, others) in cases.items():
    unseen[name] = motions(body, flex, others, seed=1)
    began = time.perf_counter()
    seen = motions(body, flex, picked, seed=0)
    found[name] = calibrate(body, seen, action_seconds, config, kinds=kinds_of_springs(body))
    seconds = time.perf_counter() - began
    errors[name] = replay_errors(name, unseen[name])
    factors = {key: np.round(value, 2).tolist() for key, value in found[name].factors.items()}
    print(f"{name}: factors {factors}, {seconds:.0f} s")
    before, after = (1e3 * error for error in errors[name])
    print(f"  held-out error before {before:.1f} mm, after {after:.1f} mm: 1/{before / after:.1f}")

# %% [markdown]
# The rope's springs come out near MuJoCo's 40 N/m (a factor of 0.27 on our 150), without the
# bending that MuJoCo's rope has not, and the air's drag near its 2 and 3 per second. (Factors of
# stiffness go from the softest kind of spring to the stiffest: bend, then stretch; bend, shear,
# stretch, and shear along the triangles' diagonals.)

# %% [markdown]
# ## How far it carries
#
# Harder motions of the cloth: half as long again, and from two *opposite* corners. All of them
# once more with other random moves, for one seed says little.

# %%
body, flex, _, others = cases["cloth"]


def positions(recordings):
    """Where particles were seen, shape (R, T, N, 3), metres."""
    return np.stack([recording.positions for recording in recordings])


def rms(missed):
    """Root-mean-square distance, mm, of each pair of recordings, shape (R / 2,)."""
    return 1e3 * np.sqrt((missed**2).sum(axis=-1).reshape(len(missed) // 2, -1).mean(axis=1))


def kinds_of_motion(body, flex):
    """By kind, recordings that were not seen: two of each seed."""
    corners = [[a, d], [b, c]]
    kinds = {
        "other edges": (others, [1, 3, 4, 5], num_actions),
        "half as long again": (others, [1, 3, 4, 5], num_actions * 3 // 2),
        "opposite corners": (corners, [2, 4, 5, 6], num_actions),
    }
    return {
        name: [
            recording
            for seed in seeds[: 1 if SMALL else None]
            for recording in motions(body, flex, picked, seed, count)
        ]
        for name, (picked, seeds, count) in kinds.items()
    }


harder, reduced = kinds_of_motion(body, flex), {}
for name, recordings in harder.items():
    before, after = (
        rms(
            simulate_recordings(each, recordings, action_seconds, longest_time_step=longest)
            - positions(recordings)
        )
        for each in (body, found["cloth"].body)
    )
    reduced[name] = before / after
    print(f"{name}, by seed: before {before.round(1)} mm, after {after.round(1)} mm")
    print(f"  1/{reduced[name].round(1)}")

# %% [markdown]
# From the other edges the error falls 5- to 7-fold, over longer motions 4- to 5-fold, and from
# opposite corners 2- to 3-fold only. It is the model that sets that limit, not the descent: fitted
# to *the very motions* from opposite corners (of the first seed), our cloth misses them by nearly
# as much as when it had not seen them.
#
# What the model lacks shows where MuJoCo's sheet is compared with itself. It cuts each cell into
# two triangles, all of them along the same diagonal. Cut along the other, with all else the same,
# it swings from opposite corners farther from itself than our fitted cloth does: at this
# resolution such a motion is one of the mesh, and our cells, with a spring along either diagonal,
# are neither mesh. Bending matters less there. Longer motions are sensitive to everything: 2 % of
# stiffness are then several millimetres.

# %%
if not SMALL:
    kinds = kinds_of_springs(body)
    itself = calibrate(body, harder["opposite corners"][:2], action_seconds, config, kinds=kinds)
    print(f"fitted to opposite corners themselves: {1e3 * itself.errors.min():.1f} mm")

flip = np.arange(side**2).reshape(side, side)[:, ::-1].ravel()
changes = {
    "cut along the other diagonal": (replace(body, faces=flip[body.faces][:, ::-1]), flex),
    "without bending": (body, Flex(flex.settings.replace("both", "stretch"), 3.0)),
    "2 % stiffer": (body, Flex(flex.settings.replace("3000", "3060"), 3.0)),
}
for label, (changed, other) in changes.items():
    print(f"MuJoCo's sheet {label}, from itself:")
    for name, recordings in kinds_of_motion(changed, other).items():
        apart = rms(positions(recordings) - positions(harder[name]))
        print(f"  {name}, by seed: {apart.round(1)} mm")

# %% [markdown]
# ## Before and after, on motions that were not seen

# %%
figure, rows = plt.subplots(2, 3, figsize=(12, 6.4), layout="constrained")
for (left, middle_axes, right), (name, (body, *_)) in zip(rows, cases.items(), strict=True):
    left.semilogy(1e3 * found[name].errors)
    left.set(xlabel="step of gradient descent", ylabel="RMS error (mm)", title=f"{name}: seen")

    wanted = np.stack([recording.positions for recording in unseen[name]])
    moments = action_seconds * np.arange(1, num_actions + 1)
    # The rope, or the middle row of the cloth, at the last moment.
    axis, shown = 0, slice(None)
    if name == "cloth":
        axis, shown = 1, slice(side * (side // 2), side * (side // 2 + 1))
    points = wanted[0, -1, shown]
    right.plot(*1e3 * points[:, [axis, 2]].T, "k--", label="MuJoCo")
    for label, each, style in [("before", body, "C1"), ("after", found[name].body, "C0")]:
        replayed = simulate_recordings(
            each, unseen[name], action_seconds, longest_time_step=longest
        )
        missed = replayed - wanted
        by_moment = np.sqrt((missed**2).sum(axis=-1).mean(axis=(0, 2)))
        middle_axes.plot(moments, 1e3 * by_moment, style, label=label)
        right.plot(*1e3 * replayed[0, -1, shown][:, [axis, 2]].T, style, label=label)
    middle_axes.set(xlabel="time (s)", ylabel="RMS error (mm)", title=f"{name}: not seen")
    middle_axes.legend(frameon=False)
    right.set(xlabel=f"{'xy'[axis]} (mm)", ylabel="z (mm)", title=f"{name}: last moment, cut")
    right.legend(frameon=False)
plt.show()

# %% [markdown]
# The check: on motions that the calibration has not seen (the rope's, and the cloth's from its
# other edges, with each seed), the error falls at least 5-fold.

# %%
for name, (before, after) in errors.items():
    assert before > 5 * after, f"the {name} was not calibrated"
assert np.all(reduced["other edges"] > 5), "the cloth was not calibrated"
