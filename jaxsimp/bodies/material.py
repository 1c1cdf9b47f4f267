"""Materials: the physical parameters of a body, in one place.

A new parameter of the body is a field of `Material`. Its name is also in `PARAMETERS` if
calibrations can fit it and ensembles can vary it.
"""

from dataclasses import dataclass, fields, replace
from types import MappingProxyType

from jaxsimp.checks import keep, require_number

FAMILIES = ("stretch_stiffness", "shear_stiffness", "bend_stiffness")
"""Families of springs, by the name of their stiffness; `Body.families` holds indices into this."""
PARAMETERS = ("stiffness", "damping", "drag", "friction")
"""Parameters that calibrations fit and ensembles vary; `stiffness` stands for all `FAMILIES`."""
FACTORS = ("mass", *PARAMETERS, "thickness")
"""Parameters that `Material.scaled` and `Body.scaled` multiply; `mass` stands for the density."""
GROUPS = MappingProxyType({"mass": ("density",), "stiffness": FAMILIES})
LIMITS = MappingProxyType(
    {
        "density": (1e-6, 1e6, "kg/m (a sheet: kg/m2)"),
        **dict.fromkeys(FAMILIES, (0.0, 1e9, "N/m")),
        "damping": (0.0, 1e6, "N s/m"),
        "drag": (0.0, 1e6, "/s"),
        "friction": (0.0, 1e3, ""),
        "thickness": (0.0, 1.0, "m"),
    }
)
"""Lowest and highest value of each parameter, and its unit: far beyond any rope or cloth, and far
from overflow in float32."""


@dataclass(frozen=True, kw_only=True)
class Material:
    """The physical parameters of a body, independent of its shape and size.

    Attributes:
        density: mass of a rope per length, kilograms per metre; mass of a sheet per area,
            kilograms per square metre.
        stretch_stiffness: newtons per metre. Rope or cloth: stiffness of each spring between
            neighbours. Mesh: stiffness of the sheet, distributed over the springs along edges.
        shear_stiffness: newtons per metre, stiffness of each spring along a diagonal of a cloth's
            cell. Ropes and meshes have no such springs, and need 0.
        bend_stiffness: newtons per metre. Rope or cloth: stiffness of each spring between particles
            two apart. Mesh: stiffness of the sheet, distributed over the springs across edges.
        damping: force per rate of elongation, newton-seconds per metre. Rope or cloth: damping of
            each spring. Mesh: damping of the sheet, distributed over all springs.
        drag: rate of air drag on every particle, per second: dv/dt = -drag v.
        friction: Coulomb coefficient between the body and obstacles.
        thickness: metres; a particle rests on the table at half of it.

    Raises:
        ValueError: if a parameter is not a number within its `LIMITS`.
    """

    density: float
    stretch_stiffness: float
    shear_stiffness: float = 0.0
    bend_stiffness: float
    damping: float
    drag: float
    friction: float
    thickness: float

    def __post_init__(self) -> None:
        for name, limits in LIMITS.items():  # plain floats: others round what is made of them
            keep(self, **{name: require_number(name, getattr(self, name), *limits)})

    def changed(self, **values: float) -> "Material":
        """The material with other values of some parameters.

        Args:
            values: values of parameters by their name, in the units of `Material`.

        Raises:
            TypeError: if no parameter has a given name.
            ValueError: if a value is out of its range.
        """
        refuse_unknown(values, tuple(field.name for field in fields(self)))
        return replace(self, **values)

    def scaled(self, **factors: float) -> "Material":
        """The material with some parameters times factors.

        Args:
            factors: factors by a name in `FACTORS` or `FAMILIES`. `mass` multiplies the density,
                `stiffness` the stiffness of each family.

        Raises:
            TypeError: if no parameter has a given name.
            ValueError: if a product is out of the parameter's range.
        """
        refuse_unknown(factors, (*FACTORS, *FAMILIES))
        values: dict[str, float] = {}
        for name, factor in factors.items():
            factor = require_number(f"the factor of {name}", factor, -1e12, 1e12)
            for field in GROUPS.get(name, (name,)):
                values[field] = factor * values.get(field, getattr(self, field))
        return replace(self, **values)


def refuse_unknown(given: dict[str, float], known: tuple[str, ...]) -> None:
    """Raise a `TypeError` if a name is unknown."""
    for name in given:
        if name not in known:
            raise TypeError(f"{name} is no parameter here; choose from {', '.join(known)}")


_SHEET = Material(
    density=0.25,
    stretch_stiffness=4.0,
    bend_stiffness=0.5,
    damping=1e-3,
    drag=3.0,
    friction=0.5,
    thickness=0.004,
)
MATERIALS = MappingProxyType(
    {
        "rope": Material(
            density=0.04,
            stretch_stiffness=150.0,
            bend_stiffness=3.0,
            damping=0.02,
            drag=1.0,
            friction=0.5,
            thickness=0.008,
        ),
        "cloth": Material(
            density=0.02 / 0.09,
            stretch_stiffness=1.5,
            shear_stiffness=0.5,
            bend_stiffness=0.1,
            damping=1e-3,
            drag=3.0,
            friction=0.5,
            thickness=0.004,
        ),
        "mesh": _SHEET,
        "garment": _SHEET.changed(density=0.3),
    }
)
"""Default materials. That of a garment is two layers of light cotton."""
