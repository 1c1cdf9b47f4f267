"""Bodies: the type that simulation, simplification and planning share.

A body is a mass-spring system: particles with masses, springs between pairs of particles, and (for
surfaces) triangles, of one material. A rope and a cloth differ only in the values of these arrays,
so all other code handles one type of body; `jaxsimp.bodies.constructors` makes them.

All arrays are NumPy on the host and read-only; `jaxsimp.dynamics` turns a body into the arrays of
a simulation.
"""

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxsimp.bodies.material import FACTORS, FAMILIES, Material, refuse_unknown
from jaxsimp.bodies.size import LARGEST, MOST_PARTICLES, require_size
from jaxsimp.bodies.topology import distinct_edges
from jaxsimp.checks import (
    as_reals,
    keep,
    require_count,
    require_ids,
    require_numbers,
    require_shape,
    require_whole,
)

_FLOATS: dict[str, tuple[float, float, str]] = {
    "rest": (-10 * LARGEST, 10 * LARGEST, "m"),
    "mass": (1e-12, 1e3, "kg"),
    "rest_length": (1e-9, 10 * LARGEST, "m"),
    "stiffness": (0.0, 1e12, "N/m"),
    "damping": (0.0, 1e12, "N s/m"),
}
"""Limits of the arrays' values: generous, and far from overflow in float32."""


@dataclass(frozen=True, eq=False)
class Body:
    """A mass-spring system of `N` particles, `S` springs and `F` triangles.

    A simulation takes masses, stiffness and damping from the arrays, and all other parameters from
    the material. The constructors fill the arrays from the material; each spring may differ from
    it. Arrays are copied, and read-only, also after unpickling.

    Attributes:
        name: the kind of body, for messages and reports.
        rest: rest coordinates, shape (N, 3), metres: the unstretched body, its lowest point at
            z = 0, centred along x and y. Flat, except for a mesh that is not flat.
        mass: particle masses, shape (N,), kilograms.
        springs: particle ids of the spring ends, shape (S, 2), no pair twice.
        families: index of each spring's family in `FAMILIES`, shape (S,): 0 for stretch, 1 for
            shear, 2 for bend.
        rest_length: spring lengths at zero force, shape (S,), metres.
        stiffness: spring stiffness, shape (S,), newtons per metre.
        damping: force per rate of elongation of the spring, shape (S,), newton-seconds per metre.
        faces: particle ids of the triangles, shape (F, 3); F = 0 for a rope.
        material: the physical parameters.
        shape: number of particles along each axis of a grid, `(rows, columns)` for a cloth;
            `(N,)` for a body without a grid, as a rope or a mesh.

    Raises:
        ValueError: if the name is no text, an array has the wrong shape or a value out of range, if
            there are no particles or more than `MOST_PARTICLES`, if the extent is outside
            `SMALLEST` to `LARGEST` (see `jaxsimp.bodies.size`), or if a spring joins a particle to
            itself or a pair already joined.
    """

    name: str
    rest: Float[np.ndarray, "N 3"]
    mass: Float[np.ndarray, " N"]
    springs: Int[np.ndarray, "S 2"]
    families: Int[np.ndarray, " S"]
    rest_length: Float[np.ndarray, " S"]
    stiffness: Float[np.ndarray, " S"]
    damping: Float[np.ndarray, " S"]
    faces: Int[np.ndarray, "F 3"]
    material: Material
    shape: tuple[int, ...]

    def __post_init__(self) -> None:
        if not isinstance(self.name, str):
            raise ValueError(f"name is {self.name!r}; give a text, such as 'shirt'")
        if not isinstance(self.material, Material):
            raise ValueError(f"material is {self.material!r}; give a jaxsimp.Material")
        for name in (*_FLOATS, "springs", "families", "faces"):
            own = _own(name, getattr(self, name))
            own.flags.writeable = False
            keep(self, **{name: own})
        _check_shapes(self)
        if self.num_particles > 1 and np.isfinite(self.rest).all():
            require_size(f"the largest extent of the {self.name}", self.size)
        for name, (lowest, highest, unit) in _FLOATS.items():
            require_numbers(name, getattr(self, name), lowest, highest, unit)
        _check_ids(self)

    def __reduce__(self) -> tuple[type["Body"], tuple[Any, ...]]:
        """Make copies with the constructor, since pickled arrays lose their read-only flag."""
        return type(self), tuple(getattr(self, field.name) for field in fields(self))

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

    @property
    def radius(self) -> float:
        """Half the thickness, metres: a particle rests on the table at this height."""
        return self.material.thickness / 2

    def scaled(
        self, *, stiffness: float | Float[np.ndarray, " S"] = 1.0, **factors: float
    ) -> "Body":
        """The body with its parameters times factors, in the arrays and in the material.

        Args:
            stiffness: factor on the stiffness of all springs, or of each one, shape (S,). The
                material's stiffness of a family then has the median factor of its springs, or of
                all springs if the family has none.
            factors: factors of other parameters, by a name in `FACTORS`.

        Raises:
            TypeError: if no parameter has a given name.
            ValueError: if a product is out of the parameter's range.
        """
        refuse_unknown(factors, FACTORS)
        require_numbers("stiffness", stiffness, 0.0, 1e12)
        if np.ndim(stiffness) and np.shape(stiffness) != self.stiffness.shape:
            raise ValueError(
                f"stiffness has shape {np.shape(stiffness)}; give one factor, or one for each of "
                f"{len(self.stiffness)} springs"
            )
        each = np.broadcast_to(stiffness, self.stiffness.shape)
        members = [each[self.families == family] for family in range(len(FAMILIES))]
        by_family = {
            name: float(np.median(own if len(own) else stiffness))
            for name, own in zip(FAMILIES, members, strict=True)
        }
        material = self.material.scaled(**by_family, **factors)
        return replace(
            self,
            mass=self.mass * factors.get("mass", 1.0),
            stiffness=self.stiffness * each,
            damping=self.damping * factors.get("damping", 1.0),
            material=material,
        )


def _own(name: str, values: Any) -> np.ndarray:
    """A copy of an array of the body: whole numbers for ids, floats for the rest."""
    if name not in _FLOATS:
        return require_whole(name, values)
    reals = as_reals(values)
    if reals is None:
        raise ValueError(f"{name} holds no real numbers; give an array in {_FLOATS[name][2]}")
    given = np.asarray(values)
    whole_or_half = given.dtype.kind != "f" or given.dtype.itemsize < 4
    return reals if whole_or_half else given.copy(order="K")


def _check_shapes(body: Body) -> None:
    for name, letter, width in (("rest", "N", 3), ("springs", "S", 2), ("faces", "F", 3)):
        require_shape(name, getattr(body, name), (letter, width), "one row for each")
    count, num_springs = len(body.rest), len(body.springs)
    require_count("num_particles", count, 1, MOST_PARTICLES)
    expected: dict[str, tuple[int, ...]] = {
        "mass": (count,),
        "families": (num_springs,),
        "rest_length": (num_springs,),
        "stiffness": (num_springs,),
        "damping": (num_springs,),
    }
    for name, shape in expected.items():
        array = getattr(body, name)
        why = f"for {count} particles, the rows of rest, and {num_springs} springs"
        require_shape(name, array, shape, why)


def _check_ids(body: Body) -> None:
    for name in ("springs", "faces"):
        require_ids(name, getattr(body, name), body.num_particles)
    unknown = np.flatnonzero((body.families < 0) | (body.families >= len(FAMILIES)))
    if unknown.size:
        raise ValueError(
            f"families is {body.families[unknown[0]]} for spring {unknown[0]}; give 0 for "
            f"stretch, 1 for shear or 2 for bend"
        )
    pairs, _, times = distinct_edges(body.springs)
    for fault, bad in (
        ("joins a particle to itself", pairs[:, 0] == pairs[:, 1]),
        ("is there twice", times > 1),
    ):
        if bad.any():
            raise ValueError(f"the spring {pairs[bad][0].tolist()} {fault}; leave it out")
