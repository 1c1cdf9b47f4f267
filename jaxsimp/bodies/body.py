"""Bodies: what is simulated, simplified and planned for.

A body is a mass-spring system: particles with masses, springs between pairs of
particles, and (for surfaces) triangles. A rope and a cloth differ only in how these
arrays are filled, so everything downstream knows one kind of body.

All arrays are NumPy on the host and read-only; `jaxsimp.dynamics` turns a body into the
arrays of a simulation.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from jaxsimp.bodies.meshes import clean_mesh, face_areas, spring_weights
from jaxsimp.bodies.topology import chain, distinct_edges


@dataclass(frozen=True, eq=False)
class Body:
    """A mass-spring system of `N` particles, `S` springs and `F` triangles.

    Attributes:
        name: the kind of body, for messages and reports.
        rest: rest coordinates, shape (N, 3), metres: the unstretched body, its lowest point at
            z = 0, centred along x and y. Flat, but for a mesh that is not.
        mass: particle masses, shape (N,), kilograms.
        springs: particle ids of the spring ends, shape (S, 2), no pair twice.
        rest_length: spring lengths at zero force, shape (S,), metres.
        stiffness: spring stiffness, shape (S,), newtons per metre.
        damping: force per rate of elongation of the spring, shape (S,), newton-seconds
            per metre.
        faces: particle ids of the triangles, shape (F, 3); F = 0 for a rope.
        radius: half the thickness, metres: a particle rests on the table at this height.
        drag: rate at which the air slows every particle, per second: dv/dt = -drag v.
        friction: Coulomb coefficient between the body and the table.
        shape: number of particles along each axis of a grid, `(rows, columns)` for a cloth;
            `(N,)` for a body that is none, as a rope or a mesh.

    Raises:
        ValueError: if an array has the wrong shape or a value that no body can have, if there
            are no particles, or if a spring joins a particle to itself or a pair joined before.
    """

    name: str
    rest: Float[np.ndarray, "N 3"]
    mass: Float[np.ndarray, " N"]
    springs: Int[np.ndarray, "S 2"]
    rest_length: Float[np.ndarray, " S"]
    stiffness: Float[np.ndarray, " S"]
    damping: Float[np.ndarray, " S"]
    faces: Int[np.ndarray, "F 3"]
    radius: float
    drag: float
    friction: float
    shape: tuple[int, ...]

    def __post_init__(self) -> None:
        _check_arrays(self)
        for name in ("rest", "mass", "springs", "rest_length", "stiffness", "damping", "faces"):
            getattr(self, name).flags.writeable = False
        for name in ("stiffness", "damping", "radius", "drag", "friction"):
            _require_at_least_zero(name, getattr(self, name))
        _require_positive("mass", self.mass)
        _require_positive("rest_length", self.rest_length)

    @property
    def num_particles(self) -> int:
        """Number of particles, `N`."""
        return len(self.rest)

    @property
    def size(self) -> float:
        """Largest extent of the rest coordinates along an axis, metres."""
        return float(np.ptp(self.rest, axis=0).max())

    @property
    def spacing(self) -> float:
        """Length of the shortest spring, metres."""
        return float(self.rest_length.min())


def rope(
    num_particles: int = 41,
    length: float = 0.5,
    *,
    mass: float = 0.02,
    stretch_stiffness: float = 150.0,
    bend_stiffness: float = 3.0,
    damping: float = 0.02,
    drag: float = 1.0,
    friction: float = 0.5,
    radius: float = 0.004,
) -> Body:
    """A rope: particles in a line along x, as in SoftGym.

    Args:
        num_particles: number of particles, at least 2.
        length: rest length, metres.
        mass: of the whole rope, kilograms.
        stretch_stiffness: of a spring between neighbours, newtons per metre.
        bend_stiffness: of a spring between particles two apart, newtons per metre.
        damping: of every spring, newton-seconds per metre.
        drag: air drag, per second.
        friction: Coulomb coefficient with the table.
        radius: of the rope, metres.

    Raises:
        ValueError: if a number is out of its range.
    """
    _require_count("num_particles", num_particles, 2)
    _require_positive("length", length)
    rest = np.zeros((num_particles, 3))
    rest[:, 0] = np.linspace(-length / 2, length / 2, num_particles)
    return rope_along(
        rest,
        mass=mass,
        stretch_stiffness=stretch_stiffness,
        bend_stiffness=bend_stiffness,
        damping=damping,
        drag=drag,
        friction=friction,
        radius=radius,
    )


def rope_along(
    points: Float[np.ndarray, "N 3"],
    *,
    mass: float = 0.02,
    stretch_stiffness: float = 150.0,
    bend_stiffness: float = 3.0,
    damping: float = 0.02,
    drag: float = 1.0,
    friction: float = 0.5,
    radius: float = 0.004,
) -> Body:
    """A rope that is at rest along given points, which need not be evenly spread.

    Args:
        points: of the particles in order, shape (N, 3), metres; N is at least 2.
        mass: of the whole rope, kilograms.
        stretch_stiffness: of a spring between neighbours, newtons per metre.
        bend_stiffness: of a spring between particles two apart, newtons per metre.
        damping: of every spring, newton-seconds per metre.
        drag: air drag, per second.
        friction: Coulomb coefficient with the table.
        radius: of the rope, metres.

    Raises:
        ValueError: if a number is out of its range, or particles joined by a spring coincide.
    """
    _require_count("num_particles", len(points), 2)
    stretch, bend = chain(len(points)), chain(len(points), 2)
    return _mass_spring(
        "rope",
        _on_the_table(points),
        [(stretch, stretch_stiffness), (bend, bend_stiffness)],
        np.zeros((0, 3), dtype=np.int64),
        mass=mass,
        damping=damping,
        radius=radius,
        drag=drag,
        friction=friction,
        shape=(len(points),),
    )


def cloth(
    shape: tuple[int, int] = (25, 25),
    size: tuple[float, float] = (0.3, 0.3),
    *,
    mass: float = 0.02,
    stretch_stiffness: float = 1.5,
    shear_stiffness: float = 0.5,
    bend_stiffness: float = 0.1,
    damping: float = 1e-3,
    drag: float = 3.0,
    friction: float = 0.5,
    radius: float = 0.002,
) -> Body:
    """A rectangular cloth: a grid of particles, row by row, with the springs of SoftGym.

    Stretch springs join the four neighbours, shear springs the diagonals, bend springs the
    particles two apart. Particle `i * shape[1] + j` is at row `i` (along x), column `j`
    (along y).

    Args:
        shape: number of rows and of columns, each at least 2.
        size: extent along x and along y, metres.
        mass: of the whole cloth, kilograms.
        stretch_stiffness: newtons per metre, of each stretch spring.
        shear_stiffness: newtons per metre, of each shear spring.
        bend_stiffness: newtons per metre, of each bend spring.
        damping: of every spring, newton-seconds per metre.
        drag: air drag, per second.
        friction: Coulomb coefficient with the table.
        radius: half the thickness, metres.

    Raises:
        ValueError: if a number is out of its range.
    """
    for count, extent in zip(shape, size, strict=True):
        _require_count("shape", count, 2)
        _require_positive("size", extent)
    rows, columns = shape
    grid = np.arange(rows * columns).reshape(shape)
    x = np.linspace(-size[0] / 2, size[0] / 2, rows)
    y = np.linspace(-size[1] / 2, size[1] / 2, columns)
    rest = np.stack([*np.meshgrid(x, y, indexing="ij"), np.zeros(shape)], axis=-1).reshape(-1, 3)
    stretch = np.concatenate([_pairs(grid[:-1], grid[1:]), _pairs(grid[:, :-1], grid[:, 1:])])
    shear = np.concatenate(
        [_pairs(grid[:-1, :-1], grid[1:, 1:]), _pairs(grid[:-1, 1:], grid[1:, :-1])]
    )
    bend = np.concatenate([_pairs(grid[:-2], grid[2:]), _pairs(grid[:, :-2], grid[:, 2:])])
    return _mass_spring(
        "cloth",
        rest,
        [(stretch, stretch_stiffness), (shear, shear_stiffness), (bend, bend_stiffness)],
        _grid_faces(grid),
        mass=mass,
        damping=damping,
        radius=radius,
        drag=drag,
        friction=friction,
        shape=(rows, columns),
    )


def from_mesh(
    points: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    *,
    name: str = "mesh",
    scale: float = 1.0,
    density: float = 0.25,
    stretch_stiffness: float = 4.0,
    bend_stiffness: float = 0.5,
    damping: float = 1e-3,
    drag: float = 3.0,
    friction: float = 0.5,
    radius: float = 0.002,
) -> Body:
    """A sheet of any shape: particles at the points of a triangle mesh.

    The mesh is cleaned first (see `jaxsimp.bodies.meshes.clean_mesh`): particles are its points in
    their order, without copies and points of no triangle. It is at rest as it is given, its
    lowest point put at z = 0, centred along x and y. A particle has a third of the mass of
    each of its triangles.

    Stretch springs lie along the edges, bend springs across each edge of two triangles, from
    corner to corner. Stiffness and damping are the sheet's, shared out by the weights of
    `jaxsimp.bodies.meshes.spring_weights`, so that in its plane the sheet does not depend to first
    order on how finely it is meshed. On equilateral triangles its Young's modulus times
    thickness is the sum of both stiffnesses. Out of the plane only bend springs that shorten
    resist: that is of higher order, and weaker in a finer mesh, as in `cloth`.

    Very unequal or slender triangles ask for a small time step; `jaxsimp.bodies.outlines.remesh`
    replaces those of a flat mesh.

    Args:
        points: shape (V, 3), metres over `scale`, z up.
        faces: point ids of the triangles, shape (F, 3).
        name: of the kind of body.
        scale: metres in one unit of `points`: 0.001 for millimetres.
        density: kilograms per square metre.
        stretch_stiffness: of the sheet, newtons per metre.
        bend_stiffness: of the sheet, newtons per metre.
        damping: of the sheet, newton-seconds per metre.
        drag: air drag, per second.
        friction: Coulomb coefficient with the table.
        radius: half the thickness, metres.

    Raises:
        ValueError: if the mesh is refused (see `clean_mesh`), or a number is out of its range.
    """
    _require_positive("density", density)
    points, faces = clean_mesh(points, faces, scale=scale)
    (edges, along), (pairs, across) = spring_weights(points, faces)
    springs, weight = np.concatenate([edges, pairs]), np.concatenate([along, across])
    third = np.repeat(face_areas(points, faces) / 3, 3)
    return Body(
        name=name,
        rest=_on_the_table(points),
        mass=density * np.bincount(faces.ravel(), weights=third),
        springs=springs,
        rest_length=np.linalg.norm(points[springs[:, 1]] - points[springs[:, 0]], axis=1),
        stiffness=np.concatenate([stretch_stiffness * along, bend_stiffness * across]),
        damping=damping * weight,
        faces=faces,
        radius=radius,
        drag=drag,
        friction=friction,
        shape=(len(points),),
    )


def _mass_spring(
    name: str,
    rest: np.ndarray,
    families: list[tuple[np.ndarray, float]],
    faces: np.ndarray,
    *,
    mass: float,
    damping: float,
    radius: float,
    drag: float,
    friction: float,
    shape: tuple[int, ...],
) -> Body:
    """A body of equal particles whose springs come in families of one stiffness each."""
    _require_positive("mass", mass)
    springs = np.concatenate([pairs for pairs, _ in families])
    stiffness = np.concatenate([np.full(len(pairs), value) for pairs, value in families])
    return Body(
        name=name,
        rest=rest,
        mass=np.full(len(rest), mass / len(rest)),
        springs=springs,
        rest_length=np.linalg.norm(rest[springs[:, 1]] - rest[springs[:, 0]], axis=1),
        stiffness=stiffness,
        damping=np.full(len(springs), damping),
        faces=faces,
        radius=radius,
        drag=drag,
        friction=friction,
        shape=shape,
    )


def _on_the_table(points: np.ndarray) -> np.ndarray:
    """Points moved so that the lowest is at z = 0, and the middle of their extent above it."""
    low, high = points.min(axis=0), points.max(axis=0)
    return points - np.array([*(low + high)[:2] / 2, low[2]])


def _pairs(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.stack([first.ravel(), second.ravel()], axis=1)


def _grid_faces(grid: np.ndarray) -> np.ndarray:
    """Two triangles a cell, counter-clockwise seen from above, shape (F, 3)."""
    corner, right = grid[:-1, :-1].ravel(), grid[1:, :-1].ravel()
    up, across = grid[:-1, 1:].ravel(), grid[1:, 1:].ravel()
    return np.concatenate(
        [np.stack([corner, right, up], axis=1), np.stack([right, across, up], axis=1)]
    )


def _check_arrays(body: Body) -> None:
    count, num_springs = len(body.rest), len(body.springs)
    _require_count("num_particles", count, 1)
    expected = {
        "rest": (count, 3),
        "mass": (count,),
        "springs": (num_springs, 2),
        "rest_length": (num_springs,),
        "stiffness": (num_springs,),
        "damping": (num_springs,),
        "faces": (len(body.faces), 3),
    }
    for name, shape in expected.items():
        array = getattr(body, name)
        if array.shape != shape:
            raise ValueError(f"{name} has shape {array.shape}; {shape} is needed")
        if not np.all(np.isfinite(array)):
            raise ValueError(f"{name} has a value that is not finite; give finite numbers")
    for name in ("springs", "faces"):
        ids = getattr(body, name)
        if ids.size and (ids.min() < 0 or ids.max() >= count):
            raise ValueError(
                f"{name} names particle {ids.max() if ids.max() >= count else ids.min()}; "
                f"a body of {count} particles has ids 0 to {count - 1}"
            )
    pairs, _, times = distinct_edges(body.springs)
    for fault, bad in (
        ("joins a particle to itself", pairs[:, 0] == pairs[:, 1]),
        ("is there twice", times > 1),
    ):
        if bad.any():
            raise ValueError(f"the spring {pairs[bad][0].tolist()} {fault}; leave it out")


def _require_count(name: str, value: int, least: int) -> None:
    if value < least:
        raise ValueError(f"{name} is {value}; at least {least} is needed")


def _require_positive(name: str, value: float | np.ndarray) -> None:
    if not np.all((np.asarray(value) > 0) & np.isfinite(value)):
        raise ValueError(f"{name} is {np.min(value):g}; give a finite number above zero")


def _require_at_least_zero(name: str, value: float | np.ndarray) -> None:
    if not np.all((np.asarray(value) >= 0) & np.isfinite(value)):
        raise ValueError(f"{name} is {np.min(value):g}; give a finite number, zero or more")
