"""Bodies as flexible bodies of MuJoCo: the same sheet or rope in a reference engine.

A particle becomes a body on three slide joints, so `qpos = position - rest` loads any of our
states. The correspondence:

- **mass, air drag, friction, radius**: the same numbers. Drag is that of the air on small cubes.
- **obstacles**: the same surfaces, as geoms; see geoms.py.
- **stretch**: a sheet of springs is, averaged over directions, an elastic membrane; a rope of
  springs is one spring along each segment (see `stretch_stiffness`). The same holds for damping.
- **bending**: the energy of our bend springs grows with the fourth power of the angle, that of a
  rod or a plate with its square. The energies are equal at a turn of one radian (see
  `bending_rigidity`).

The "full" variant has all of these, and self-collision. The "fast" variant hardly stretches (its
edges are soft constraints), has no bending stiffness, and passes through itself. MuJoCo is
imported when called.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxsimp.bodies import Body
from jaxsimp.bodies.meshes import face_areas
from jaxsimp.bodies.topology import are_among, chain, half_edges
from jaxsimp.checks import require_choice, require_flag, require_ids, require_number, require_path
from jaxsimp.dynamics import Obstacle, Table, largest_time_step
from jaxsimp.dynamics.arrays import require_known, require_positions
from jaxsimp.dynamics.contact.obstacles import make_obstacles
from jaxsimp.engines.mujoco.geoms import obstacle_geoms

POISSON = 1 / 3
"""Poisson's ratio of every isotropic sheet of springs, as their forces are central."""
GRAVITY = 9.81
SIDE = 0.01
"""Side of the cube that represents a particle of mean mass in the air, metres."""


@dataclass(frozen=True)
class Variant:
    """Modelled properties of a body.

    Attributes:
        time_step: time step, seconds; an elastic rope, whose springs are integrated explicitly,
            takes at most a quarter of the largest stable one.
        elastic: whether the body stretches and resists bending as our springs do; it does neither
            otherwise.
        self_collision: whether layers and strands touch, with friction.
    """

    time_step: float
    elastic: bool
    self_collision: bool

    def __post_init__(self) -> None:
        require_number("time_step", self.time_step, 1e-6, 1.0, "s")
        require_flag("elastic", self.elastic)
        require_flag("self_collision", self.self_collision)


VARIANTS = {
    "fast": Variant(time_step=4e-3, elastic=False, self_collision=False),
    "full": Variant(time_step=2e-3, elastic=True, self_collision=True),
}


def as_variant(variant: str | Variant) -> Variant:
    """A variant from its name; a `Variant` is returned unchanged.

    Raises:
        ValueError: if the name is unknown.
    """
    if isinstance(variant, Variant):
        return variant
    require_choice("variant", variant, VARIANTS)
    return VARIANTS[variant]


def stretch_stiffness(body: Body, weight: Float[np.ndarray, " S"]) -> float:
    """Stretch stiffness of the equivalent rope, N (force over strain), or sheet, N/m (per width).

    A spring of stiffness `k` and length `L` along `n` adds `k L^2 n n n n` over the area to the
    stiffness tensor of a sheet of springs. Averaged over directions, the sheet is isotropic with
    Poisson's ratio 1/3, and its Young's modulus times thickness is a third of the trace,
    `sum k L^2 / (3 area)`. For a rope the stiffness is `sum k L^2 / length`.

    Args:
        body: body of particles along a line, or with triangles.
        weight: stiffness of the springs, or their damping, for the damping of stretch.
    """
    total = float(np.sum(weight * body.rest_length**2))
    return total / (3 * _area(body) if len(body.faces) else _length(body))


def bending_rigidity(body: Body) -> float:
    """Bending rigidity of the rod, N m^2, or plate, N m, equivalent to the bend springs.

    A turn `a` in the middle of a spring of length `L` shortens it by `L a^2 / 8`, with the energy
    `k L^2 a^4 / 128`; at the curvature `2 a / L`, a rod of rigidity `D` has the energy
    `2 D a^2 / L^2` per length. The two are equal at `a = 1` for `D = sum k L^4 / (256 length)`.
    In a sheet, the energy of a spring at an angle to the curvature has the factor `cos^8` of the
    angle, 35/128 on average.
    """
    # Springs that are edges of the flex do not resist bending.
    edges = half_edges(body.faces)[0] if len(body.faces) else chain(body.num_particles)
    across = ~are_among(body.springs, edges)
    total = float(np.sum((body.stiffness * body.rest_length**4)[across])) / 256
    return 35 / 128 * total / _area(body) if len(body.faces) else total / _length(body)


def make_model(
    body: Body,
    variant: str | Variant = "full",
    graspable: Iterable[int] = (),
    *,
    obstacles: Sequence[Obstacle] = (Table(),),
) -> Any:
    """A body as a compiled `mujoco.MjModel`.

    Args:
        body: body of particles along a line, or with triangles.
        variant: name of a variant, or a `Variant`.
        graspable: ids of particles that pickers can grasp: each has a mocap body
            `picker_<particle>` and an inactive `connect` constraint of that name.
        obstacles: rigid bodies at rest; a rounded box becomes boxes and capsules.

    Raises:
        ValueError: if the variant or a particle does not exist; if an obstacle is refused, see
            `jaxsimp.dynamics.make_simulation`; or if the body has no segment, no thickness, or is
            to be elastic and has no stiffness.
    """
    return _spec(body, as_variant(variant), graspable, obstacles).compile()


def save_mjcf(
    path: str | Path,
    body: Body,
    variant: str | Variant = "full",
    graspable: Iterable[int] = (),
    position: Float[np.ndarray, "N 3"] | None = None,
    *,
    obstacles: Sequence[Obstacle] = (Table(),),
    keyframes: Mapping[str, Float[np.ndarray, "N 3"]] = MappingProxyType({}),
) -> None:
    """Write a body as MJCF: `python -m mujoco.viewer --mjcf=PATH` opens it.

    Args:
        path: path of the file.
        body: as for `make_model`.
        variant: as for `make_model`.
        graspable: as for `make_model`.
        position: positions in a keyframe named "start", shape (N, 3), metres.
        obstacles: as for `make_model`.
        keyframes: positions in further keyframes, by name.

    Raises:
        ValueError: as for `make_model`, or if positions are not those of the body.
        OSError: if the file cannot be written.
    """
    require_path(Path(path), "give the path of a file that can be written")
    spec = _spec(body, as_variant(variant), graspable, obstacles)
    if position is not None:
        _add_keyframe(spec, "start", "position", position, body)
    for name, given in keyframes.items():
        _add_keyframe(spec, name, f"keyframes[{name!r}]", given, body)
    spec.compile()
    try:
        Path(path).write_text(spec.to_xml())
    except OSError as error:
        raise OSError(
            error.errno, f"{error.strerror}; give the path of a file that can be written", str(path)
        ) from error


def _add_keyframe(spec: Any, name: str, told: str, position: Any, body: Body) -> None:
    places = require_positions(told, position, body.num_particles)
    require_known(told, places)
    spec.add_key(name=name, qpos=(np.asarray(places) - body.rest).ravel().tolist())


def _spec(
    body: Body, variant: Variant, graspable: Iterable[int], obstacles: Sequence[Obstacle]
) -> Any:
    """The uncompiled model of a body."""
    import mujoco

    _check_body(body, variant)
    spec = mujoco.MjSpec()
    spec.modelname = body.name
    _set_options(spec, body, variant)
    names = [f"particle_{i}" for i in range(body.num_particles)]
    for name, place, mass in zip(names, body.rest, body.mass, strict=True):
        _add_particle(spec, name, place, float(mass), SIDE * float(mass / body.mass.mean()))
    radius = _contact_radius(body, variant)
    contact = {
        "friction": [body.material.friction, 0.0, 0.0],
        "condim": 3,
        "solref": _stiffest(spec.option.timestep),
    }
    flex = spec.add_flex(
        name="body", vertbody=names, radius=radius, rgba=[0.0, 0.45, 0.7, 1.0], **contact
    )
    _set_elements(flex, body, variant)
    if variant.elastic:
        (_set_sheet if len(body.faces) else _set_rope)(flex, body)
    else:
        # MuJoCo's default impedance: a stiffer one does not converge with many edges.
        solref = _stiffest(spec.option.timestep)
        spec.add_equality(type=mujoco.mjtEq.mjEQ_FLEX, name1="body", solref=solref)
    # Particles of a thinner body in MuJoCo rest where ours do: obstacles are grown instead.
    geoms = obstacle_geoms(make_obstacles(obstacles, body), body.radius - radius)
    for name, geom in geoms.items():
        spec.worldbody.add_geom(name=name, rgba=[0.9, 0.9, 0.88, 1.0], **geom, **contact)
    spec.worldbody.add_light(pos=[0.0, 0.0, 2.0])
    for particle in _ids(graspable, body):
        _add_picker(spec, body, particle)
    return spec


def _check_body(body: Body, variant: Variant) -> None:
    """Raise a `ValueError` if MuJoCo has no flexible body like this."""
    if body.num_particles < 2 or not len(body.springs):
        raise ValueError(
            f"this {body.name} has {body.num_particles} particles and {len(body.springs)} springs; "
            f"give at least 2 particles, joined by a spring, as a flexible body of MuJoCo takes"
        )
    if not body.radius > 0:
        raise ValueError(
            f"the thickness of this {body.name} is 0; give metres above zero, as MuJoCo's contact "
            f"takes"
        )
    if variant.elastic and not body.stiffness.any():
        raise ValueError(
            f"all springs of this {body.name} have stiffness 0; an elastic model of MuJoCo takes "
            f"newtons per metre above zero. Give some, or the variant fast, which hardly stretches"
        )


def _set_options(spec: Any, body: Body, variant: Variant) -> None:
    """Time step, integrator and solver."""
    import mujoco

    option = spec.option
    # The drag force on a cube of side s in air of this viscosity is 3 pi s viscosity v.
    option.viscosity = body.material.drag * float(body.mass.mean()) / (3 * np.pi * SIDE)
    option.gravity = [0.0, 0.0, -GRAVITY]
    option.timestep = variant.time_step
    # Friction is the same in all directions, as ours is.
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    if len(body.faces):
        # Newton's method, the default, is exact, and ten times slower with the thousands of
        # contacts of layers. With these iterations the side and the diagonal fold end 0.1 and
        # 0.7 mm RMS from those with up to a thousand iterations, solved to 1e-9.
        option.solver = mujoco.mjtSolver.mjSOL_CG
        option.tolerance = 1e-6
        option.iterations = 100
    # Do not reset an unstable simulation to a state that looks normal.
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    if variant.elastic and len(body.faces):
        option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    elif variant.elastic:
        option.timestep = min(variant.time_step, 0.25 * largest_time_step(body))


def _add_particle(
    spec: Any, name: str, place: Float[np.ndarray, "3"], mass: float, side: float
) -> None:
    """Add a point mass on three slide joints, with the air drag of a cube."""
    import mujoco

    inertia = [mass * side**2 / 6] * 3
    particle = spec.worldbody.add_body(
        name=name, pos=place, mass=mass, inertia=inertia, ipos=[0.0] * 3, explicitinertial=True
    )
    for axis in np.eye(3):
        particle.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)


def _set_elements(flex: Any, body: Body, variant: Variant) -> None:
    """Set the triangles of a sheet or segments of a rope, and their contacts."""
    import mujoco

    kind = mujoco.mjtFlexSelf
    flex.dim = 2 if len(body.faces) else 1
    flex.elem = (body.faces if len(body.faces) else chain(body.num_particles)).ravel().tolist()
    flex.selfcollide = kind.mjFLEXSELF_AUTO if variant.self_collision else kind.mjFLEXSELF_NONE


def _set_sheet(flex: Any, body: Body) -> None:
    """Set the elasticity of a sheet: one thickness gives both stretch and bending stiffness.

    A sheet that does not resist bending has that of the body, and no bending of MuJoCo's.
    """
    stretch, bending = stretch_stiffness(body, body.stiffness), bending_rigidity(body)
    thickness = np.sqrt(12 * (1 - POISSON**2) * bending / stretch)
    if not bending:
        thickness = body.material.thickness
    flex.young, flex.poisson, flex.thickness = stretch / thickness, POISSON, thickness
    flex.damping = stretch_stiffness(body, body.damping) / stretch
    flex.elastic2d = 3 if bending else 2  # both stretching and bending, or stretching alone


def _set_rope(flex: Any, body: Body) -> None:
    """Set the elasticity of a rope: springs along its segments, and bending of a round rod."""
    segment = _length(body) / (body.num_particles - 1)
    flex.edgestiffness = stretch_stiffness(body, body.stiffness) / segment
    flex.edgedamping = stretch_stiffness(body, body.damping) / segment
    flex.young = bending_rigidity(body) / (np.pi * flex.radius**4 / 4)


def _ids(graspable: Iterable[int], body: Body) -> list[int]:
    """Ids of particles that can be grasped, each once, in order.

    Raises:
        ValueError: if one is no particle of the body.
    """
    given = list(graspable) if np.iterable(graspable) else graspable
    if isinstance(given, list) and not given:
        return []
    ids = require_ids("graspable", given, body.num_particles)
    if ids.ndim != 1:
        raise ValueError(f"graspable is {graspable!r}; give a list of particle ids")
    return np.unique(ids).tolist()


def _add_picker(spec: Any, body: Body, particle: int) -> None:
    """Add a picker of one particle: a mocap body, joined to it by a switchable constraint."""
    import mujoco

    name = f"picker_{particle}"
    spec.worldbody.add_body(name=name, mocap=True, pos=body.rest[particle])
    spec.add_equality(
        name=name,
        type=mujoco.mjtEq.mjEQ_CONNECT,
        objtype=mujoco.mjtObj.mjOBJ_BODY,
        name1=f"particle_{particle}",
        name2=name,
        active=False,
        data=[0.0] * mujoco.mjNEQDATA,  # no offset: both start where the particle rests
        # As stiff as the time step allows: a held particle follows its picker within 0.1 mm.
        solref=_stiffest(spec.option.timestep),
        solimp=[0.999, 0.9999, 1e-4, 0.5, 2.0],
    )


def _stiffest(time_step: float) -> list[float]:
    """Time constant, s, and damping ratio of a constraint as stiff as the time step allows.

    Our contacts are rigid. A critically damped contact of time constant `c` yields by `v c / e` to
    an impact at speed `v`: by 7 mm at 1 m/s and MuJoCo's default of 20 ms. With that default, a
    layer laid on another, 4 mm thick, tunnelled through it at 0.3 m/s; with 4 ms it did not at
    1.4 m/s. The creep of particles that friction holds under a load is in proportion to `c`, too.
    """
    return [2 * time_step, 1.0]


def _contact_radius(body: Body, variant: Variant) -> float:
    """The body's radius, or less if parts that are not neighbours would always touch."""
    return min(body.radius, 0.45 * body.spacing) if variant.self_collision else body.radius


def _area(body: Body) -> float:
    return float(face_areas(body.rest, body.faces).sum())


def _length(body: Body) -> float:
    """Length of a rope along its segments, metres."""
    return float(np.linalg.norm(np.diff(body.rest, axis=0), axis=1).sum())
