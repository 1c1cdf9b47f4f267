"""Constructors of bodies: ropes, rectangular cloths, and sheets from triangle meshes.

Each takes a material, by default that of its kind in `MATERIALS`, and changes of single parameters.
"""

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxsimp.bodies.body import Body
from jaxsimp.bodies.material import FAMILIES, MATERIALS, Material
from jaxsimp.bodies.meshes import clean_mesh, face_areas, spring_weights
from jaxsimp.bodies.size import MOST_PARTICLES, require_size
from jaxsimp.bodies.topology import chain
from jaxsimp.checks import require_count, require_number, require_rows

MASS = 0.02
"""Default mass of a rope and of a cloth of any size, kilograms."""


def rope(
    num_particles: int = 41,
    length: float = 0.5,
    *,
    mass: float | None = None,
    material: Material | None = None,
    **changes: float,
) -> Body:
    """A rope: particles in a line along x, as in SoftGym.

    Args:
        num_particles: number of particles, at least 2.
        length: rest length, metres.
        mass: mass of the whole rope, kilograms; replaces the material's density. By default
            `MASS`, or the density times the length where a material or a density is given.
        material: material of the rope, `MATERIALS["rope"]` by default.
        changes: parameters in which the rope differs from the material, as `drag=2.0`.

    Raises:
        ValueError: if a number is out of its range, or both a mass and a density are given.
        TypeError: if `Material` has no parameter of a name in `changes`.
    """
    num_particles = require_count("num_particles", num_particles, 2, MOST_PARTICLES)
    length = require_size("length", length)
    rest = np.zeros((num_particles, 3))
    rest[:, 0] = np.linspace(-length / 2, length / 2, num_particles)
    return rope_along(rest, mass=mass, material=material, **changes)


def rope_along(
    points: Float[np.ndarray, "N 3"],
    *,
    mass: float | None = None,
    material: Material | None = None,
    **changes: float,
) -> Body:
    """A rope at rest along given points, which may be unevenly spaced.

    Args:
        points: positions of the particles in order, shape (N, 3), metres; N is at least 2.
        mass: as for `rope`.
        material: as for `rope`.
        changes: as for `rope`.

    Raises:
        ValueError: if a number is out of its range, or particles joined by a spring coincide.
        TypeError: if `Material` has no parameter of a name in `changes`.
    """
    points = require_rows("points", points, 3)
    count = require_count("num_particles", len(points), 2, MOST_PARTICLES)
    segments = np.linalg.norm(np.diff(points, axis=0), axis=1)
    same = np.flatnonzero(segments < 1e-9)
    if same.size:
        raise ValueError(
            f"particles {same[0]} and {same[0] + 1} of the rope are at the same place "
            f"({same.size} such pairs); leave one out, or move it"
        )
    require_size("the largest extent of points", float(np.ptp(points, axis=0).max()))
    made, mass = _weigh("rope", material, changes, mass, float(segments.sum()))
    _refuse_shear("rope", made)
    no_springs, no_faces = np.zeros((0, 2), dtype=np.int64), np.zeros((0, 3), dtype=np.int64)
    springs = (chain(count), no_springs, chain(count, 2))
    return _mass_spring("rope", _on_the_table(points), springs, no_faces, made, mass, (count,))


def cloth(
    shape: tuple[int, int] = (25, 25),
    size: tuple[float, float] = (0.3, 0.3),
    *,
    mass: float | None = None,
    material: Material | None = None,
    **changes: float,
) -> Body:
    """A rectangular cloth: a grid of particles, row by row, with the springs of SoftGym.

    Stretch springs join the four neighbours, shear springs the diagonals, bend springs the
    particles two apart. Particle `i * shape[1] + j` is at row `i` (along x), column `j`
    (along y).

    Args:
        shape: number of rows and of columns, each at least 2.
        size: extent along x and along y, metres.
        mass: mass of the whole cloth, kilograms; replaces the material's density. By default
            `MASS`, or the density times the area where a material or a density is given.
        material: material of the cloth, `MATERIALS["cloth"]` by default.
        changes: parameters in which the cloth differs from the material, as `drag=2.0`.

    Raises:
        ValueError: if a number is out of its range, or both a mass and a density are given.
        TypeError: if `Material` has no parameter of a name in `changes`.
    """
    rows, columns = (require_count("shape", each, 2) for each in _two("shape", shape))
    require_count("the number of particles, rows times columns,", rows * columns, 4, MOST_PARTICLES)
    shape = (rows, columns)
    long, wide = (require_size("size", each, smallest=1e-6) for each in _two("size", size))
    made, mass = _weigh("cloth", material, changes, mass, long * wide)
    grid = np.arange(rows * columns).reshape(shape)
    x = np.linspace(-long / 2, long / 2, rows)
    y = np.linspace(-wide / 2, wide / 2, columns)
    rest = np.stack([*np.meshgrid(x, y, indexing="ij"), np.zeros(shape)], axis=-1).reshape(-1, 3)
    return _mass_spring("cloth", rest, _grid_springs(grid), _grid_faces(grid), made, mass, shape)


def from_mesh(
    points: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    *,
    name: str = "mesh",
    scale: float = 1.0,
    material: Material = MATERIALS["mesh"],
    **changes: float,
) -> Body:
    """A sheet of any shape: particles at the points of a triangle mesh.

    The mesh is cleaned first (see `jaxsimp.bodies.meshes.clean_mesh`): particles are its points in
    their order, without copies and points of no triangle. The given shape is the rest shape, with
    its lowest point moved to z = 0, and centred along x and y. A particle has a third of the mass
    of each of its triangles.

    Stretch springs lie along the edges, bend springs across each edge of two triangles, from
    corner to corner. Stiffness and damping are the sheet's, distributed by the weights of
    `jaxsimp.bodies.meshes.spring_weights`, so that to first order the sheet's behaviour in its
    plane does not depend on the resolution of the mesh. On equilateral triangles its Young's
    modulus times thickness is the sum of both stiffnesses. Out of the plane only bend springs that
    shorten resist: that is of higher order, and weaker in a finer mesh, as in `cloth`.

    Very unequal or slender triangles need a small time step; `jaxsimp.bodies.remesh` replaces them.

    Args:
        points: shape (V, 3), metres over `scale`, z up.
        faces: point ids of the triangles, shape (F, 3).
        name: the kind of body.
        scale: metres in one unit of `points`: 0.001 for millimetres.
        material: material of the sheet.
        changes: parameters in which the sheet differs from the material, as `density=0.3`.

    Raises:
        ValueError: if `clean_mesh` refuses the mesh, or a number is out of its range.
        TypeError: if `Material` has no parameter of a name in `changes`.
    """
    material = _material(material, "mesh").changed(**changes)
    _refuse_shear(name, material)
    points, faces = clean_mesh(points, faces, scale=scale)
    (edges, along), (pairs, across) = spring_weights(points, faces)
    springs, weight = np.concatenate([edges, pairs]), np.concatenate([along, across])
    third = np.repeat(face_areas(points, faces) / 3, 3)
    stretch, bend = material.stretch_stiffness * along, material.bend_stiffness * across
    return Body(
        name=name,
        rest=_on_the_table(points),
        mass=material.density * np.bincount(faces.ravel(), weights=third),
        springs=springs,
        families=_family_ids([len(edges), 0, len(pairs)]),
        rest_length=np.linalg.norm(points[springs[:, 1]] - points[springs[:, 0]], axis=1),
        stiffness=np.concatenate([stretch, bend]),
        damping=material.damping * weight,
        faces=faces,
        material=material,
        shape=(len(points),),
    )


def _two(name: str, values: Any) -> tuple[object, object]:
    both = tuple(values) if np.iterable(values) else ()
    if len(both) != 2:
        raise ValueError(f"{name} is {values!r}; give two numbers, along x and along y")
    return both


def _weigh(
    kind: str,
    material: Material | None,
    changes: dict[str, float],
    mass: float | None,
    extent: float,
) -> tuple[Material, float]:
    """The material and the mass, kilograms, of a body.

    `extent` is the body's length, metres, or its area, square metres.
    """
    made = _material(material, kind).changed(**changes)
    if mass is not None:
        mass = require_number("mass", mass, 1e-6, 1e3, "kg")
    if mass is not None and "density" in changes:
        raise ValueError(
            f"mass is {mass:g} and density is {changes['density']:g}; give one of them, the other "
            f"follows from the size"
        )
    if mass is None and (material is not None or "density" in changes):
        return made, made.density * extent
    mass = MASS if mass is None else mass
    return made.changed(density=mass / extent), mass


def _material(material: Material | None, kind: str) -> Material:
    """The material, by default that of the kind."""
    if material is not None and not isinstance(material, Material):
        raise ValueError(
            f"material is {material!r}; give a jaxsimp.Material, as jaxsimp.MATERIALS[{kind!r}]"
        )
    return material or MATERIALS[kind]


def _refuse_shear(name: str, material: Material) -> None:
    if material.shear_stiffness:
        raise ValueError(
            f"shear_stiffness is {material.shear_stiffness:g}; a {name} has no shear springs: "
            f"give 0"
        )


def _mass_spring(
    name: str,
    rest: np.ndarray,
    families: tuple[np.ndarray, ...],
    faces: np.ndarray,
    material: Material,
    mass: float,
    shape: tuple[int, ...],
) -> Body:
    """A body with equal particles, and equal springs in each family."""
    springs, sizes = np.concatenate(families), [len(pairs) for pairs in families]
    return Body(
        name=name,
        rest=rest,
        mass=np.full(len(rest), mass / len(rest)),
        springs=springs,
        families=_family_ids(sizes),
        rest_length=np.linalg.norm(rest[springs[:, 1]] - rest[springs[:, 0]], axis=1),
        stiffness=np.repeat([getattr(material, name) for name in FAMILIES], sizes),
        damping=np.full(len(springs), material.damping),
        faces=faces,
        material=material,
        shape=shape,
    )


def _family_ids(sizes: list[int]) -> Int[np.ndarray, " S"]:
    """Index of each spring's family in `FAMILIES`, from the sizes of the families."""
    return np.repeat(np.arange(len(FAMILIES)), sizes)


def _on_the_table(points: np.ndarray) -> np.ndarray:
    """Points moved so that the lowest is at z = 0, with their extent centred along x and y."""
    low, high = points.min(axis=0), points.max(axis=0)
    return points - np.array([*(low + high)[:2] / 2, low[2]])


def _pairs(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.stack([first.ravel(), second.ravel()], axis=1)


def _grid_springs(grid: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pairs of particles joined by stretch, shear and bend springs, shape (_, 2) each."""
    stretch = [_pairs(grid[:-1], grid[1:]), _pairs(grid[:, :-1], grid[:, 1:])]
    shear = [_pairs(grid[:-1, :-1], grid[1:, 1:]), _pairs(grid[:-1, 1:], grid[1:, :-1])]
    bend = [_pairs(grid[:-2], grid[2:]), _pairs(grid[:, :-2], grid[:, 2:])]
    return np.concatenate(stretch), np.concatenate(shear), np.concatenate(bend)


def _grid_faces(grid: np.ndarray) -> np.ndarray:
    """Two triangles per cell, counter-clockwise seen from above, shape (F, 3)."""
    corner, right = grid[:-1, :-1].ravel(), grid[1:, :-1].ravel()
    up, across = grid[:-1, 1:].ravel(), grid[1:, 1:].ravel()
    return np.concatenate(
        [np.stack([corner, right, up], axis=1), np.stack([right, across, up], axis=1)]
    )
