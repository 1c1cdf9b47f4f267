"""A body as a MuJoCo model: point masses on slide joints, joined by spatial tendons."""

from typing import Any

from jaxsimp.bodies import Body
from jaxsimp.checks import require_number
from jaxsimp.dynamics.simulation import MOST_GRAVITY

AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def tendon_spec(body: Body, time_step: float = 2e-3, gravity: float = 9.81) -> Any:
    """The equations of `jaxsimp.dynamics` as a `mujoco.MjSpec`, without obstacles and pickers.

    - A particle is a body on three slide joints along x, y and z, whose coordinates are its
      position in the world: `qpos` is the (N, 3) positions, row by row, and `qvel` velocities.
    - A spring is a spatial tendon from particle to particle with its stiffness, damping and rest
      length. Its force is ours, except where its ends are closer than a thousandth of the shortest
      spring.
    - Drag is joint damping of `drag * mass`. MuJoCo's Euler method takes joint damping
      implicitly, ours explicitly, so its flag `eulerdamp` is off; damping of tendons it takes
      explicitly, as we do. Both then take the same semi-implicit Euler step.
    - There is no contact: the model has no geoms, and contacts are off.

    `compile()` makes a model of it, `to_xml()` the text (of 6 digits) that MuJoCo's viewer opens.

    Args:
        body: body to simulate.
        time_step: time step, seconds.
        gravity: downward acceleration, metres per second squared.

    Raises:
        ValueError: if a number is out of its range.
    """
    import mujoco

    require_number("time_step", time_step, 1e-9, 1e3, "s")
    require_number("gravity", gravity, -MOST_GRAVITY, MOST_GRAVITY, "m/s^2, downward")

    spec = mujoco.MjSpec()
    spec.modelname = body.name
    spec.option.timestep = time_step
    spec.option.gravity = [0.0, 0.0, -gravity]
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    off = mujoco.mjtDisableBit.mjDSBL_EULERDAMP | mujoco.mjtDisableBit.mjDSBL_CONTACT
    spec.option.disableflags = int(off)
    for particle in range(body.num_particles):
        _add_particle(spec, body, particle)
    for spring in range(len(body.springs)):
        _add_spring(spec, body, spring)
    return spec


def _add_particle(spec: Any, body: Body, particle: int) -> None:
    import mujoco

    mass = float(body.mass[particle])
    size = max(body.radius, 1e-3)
    position = body.rest[particle]
    added = spec.worldbody.add_body(
        name=_particle(particle),
        pos=position,
        mass=mass,
        ipos=[0.0, 0.0, 0.0],
        # The inertia of a ball. MuJoCo needs one, although nothing turns.
        inertia=[0.4 * mass * size**2] * 3,
        explicitinertial=True,  # in XML, too
    )
    for name, axis, coordinate in zip("xyz", AXES, position, strict=True):
        added.add_joint(
            name=f"{_particle(particle)}_{name}",
            type=mujoco.mjtJoint.mjJNT_SLIDE,
            axis=axis,
            ref=coordinate,
            damping=body.material.drag * mass,
        )
    added.add_site(name=_particle(particle), size=[size] * 3)


def _add_spring(spec: Any, body: Body, spring: int) -> None:
    tendon = spec.add_tendon(
        name=f"spring_{spring}",
        stiffness=body.stiffness[spring],
        damping=body.damping[spring],
        springlength=[body.rest_length[spring]] * 2,
    )
    for end in body.springs[spring]:
        tendon.wrap_site(_particle(int(end)))


def _particle(particle: int) -> str:
    return f"particle_{particle}"
