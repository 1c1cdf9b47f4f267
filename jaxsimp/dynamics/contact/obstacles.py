"""Obstacles: rigid, convex, at rest; each gives its signed distance and outward normal.

A sphere, a capsule and a rounded box are a point, a segment and a box, grown by a radius: their
distances are those to the core, less the radius (Minkowski sum). All distances are exact outside
and convex everywhere, so the plane through the nearest point of the surface, square to the normal,
separates a point from the obstacle: contact and pickers rely on this.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsimp.bodies import Body
from jaxsimp.bodies.material import FAMILIES
from jaxsimp.bodies.meshes import covering_radii
from jaxsimp.checks import as_reals, require_number

Values = Float[Array | np.ndarray, "..."] | float
"""One number for each point."""
Axes = Sequence[Any]
"""Values of points along x, y and z, shape (*N,) each; a normal may have numbers among them."""
Number = Float[Array | np.ndarray, "..."] | float | int
Vector = Float[Array | np.ndarray, "... 3"] | tuple[float | int, float | int, float | int]
SHAPES_OF_NUMBERS: dict[Any, tuple[int, ...]] = {Number: (), Vector: (3,)}
"""Shapes of an obstacle's numbers by the annotation of their field; any for another."""

STRETCH = FAMILIES.index("stretch_stiffness")
"""The family of springs that are a rope's links."""
FARTHEST, SHORTEST = 1e6, 1e-6
"""Largest number of an obstacle, and least length of a normal or an axis: float32 squares them."""
UP = (0.0, 0.0, 1.0)
"""The constant normal of the table: contact along it is arithmetic of heights alone."""
LEAST_SIZE = 2.0
"""Least radius of an obstacle with the body's around it, as a multiple of the body's `gap`."""


@runtime_checkable
class Obstacle(Protocol):
    """A rigid, convex obstacle: a frozen dataclass whose leaves are its numbers."""

    def distance(self, x: Values, y: Values, z: Values) -> tuple[Values, Axes]:
        """Signed distance, metres, negative inside, and outward unit normal, for each point."""

    def size(self) -> tuple[str, float]:
        """The field with its smallest radius or half width, and that value, metres.

        Raises:
            ValueError: if a number is out of its range.
        """


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Table:
    """The half-space below z = 0."""

    def distance(self, x: Values, y: Values, z: Values) -> tuple[Values, Axes]:
        """See `Obstacle`."""
        return z, UP

    def size(self) -> tuple[str, float]:
        """See `Obstacle`."""
        return "", np.inf


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Plane:
    """The half-space behind a plane.

    Attributes:
        point: a point of the plane, shape (3,), metres.
        normal: direction out of the half-space, of any length, shape (3,).
    """

    point: Vector
    normal: Vector

    def distance(self, x: Values, y: Values, z: Values) -> tuple[Values, Axes]:
        """See `Obstacle`."""
        normal = jnp.asarray(self.normal, dtype=float)
        unit = list(normal * jax.lax.rsqrt(jnp.vdot(normal, normal)))
        return _dot(unit, _from(self.point, x, y, z)), unit

    def size(self) -> tuple[str, float]:
        """See `Obstacle`."""
        if not np.linalg.norm(self.normal) >= SHORTEST:
            raise ValueError(
                f"normal is {_told(self.normal)}; give a direction of a length of {SHORTEST:g} to "
                f"{FARTHEST:g}"
            )
        return "", np.inf


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Sphere:
    """A sphere.

    Attributes:
        center: shape (3,), metres.
        radius: metres.
    """

    center: Vector
    radius: Number

    def distance(self, x: Values, y: Values, z: Values) -> tuple[Values, Axes]:
        """See `Obstacle`."""
        return _grown(_from(self.center, x, y, z), self.radius)

    def size(self) -> tuple[str, float]:
        """See `Obstacle`."""
        return "radius", _positive("radius", self.radius)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Capsule:
    """A cylinder with hemispherical ends, such as a bar.

    Attributes:
        start: middle of one end of the cylinder, shape (3,), metres.
        end: middle of the other end, shape (3,), metres.
        radius: metres.
    """

    start: Vector
    end: Vector
    radius: Number

    def distance(self, x: Values, y: Values, z: Values) -> tuple[Values, Axes]:
        """See `Obstacle`."""
        axis = list(jnp.asarray(self.end) - jnp.asarray(self.start))
        away = _from(self.start, x, y, z)
        share = jnp.clip(_dot(axis, away) / _dot(axis, axis), 0.0, 1.0)
        return _grown([a - share * b for a, b in zip(away, axis, strict=True)], self.radius)

    def size(self) -> tuple[str, float]:
        """See `Obstacle`."""
        if not np.linalg.norm(np.subtract(self.end, self.start)) >= SHORTEST:
            raise ValueError(
                f"start and end are both {_told(self.end)}; give two points at least "
                f"{SHORTEST:g} m apart, or a Sphere instead"
            )
        return "radius", _positive("radius", self.radius)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Box:
    """A box with rounded edges, turned about z.

    Attributes:
        center: shape (3,), metres.
        half_sizes: half the length along each of its axes, roundings included, shape (3,), metres.
        rounding: radius of its edges and corners, metres; 0 for sharp ones, whose normal jumps.
        turn: angle about z, counterclockwise seen from above, radians.
    """

    center: Vector
    half_sizes: Vector
    rounding: Number = 0.01
    turn: Number = 0.0

    def distance(self, x: Values, y: Values, z: Values) -> tuple[Values, Axes]:
        """See `Obstacle`."""
        cos, sin = jnp.cos(self.turn), jnp.sin(self.turn)
        east, north, up = _from(self.center, x, y, z)
        place = [cos * east + sin * north, cos * north - sin * east, up]
        core = jnp.asarray(self.half_sizes) - self.rounding
        over = [jnp.abs(at) - half for at, half in zip(place, core, strict=True)]
        beyond, normal = _length([jnp.maximum(each, 0.0) for each in over])
        deepest = jnp.maximum(jnp.maximum(over[0], over[1]), over[2])
        inside = deepest <= 0.0
        # Inside the core the nearest face counts.
        nearest = [over[0] >= deepest, over[1] >= deepest, over[2] >= deepest]
        nearest[1] &= ~nearest[0]
        nearest[2] &= ~(nearest[0] | nearest[1])
        east, north, up = (
            jnp.where(at < 0.0, -1.0, 1.0) * jnp.where(inside, face, along)
            for at, face, along in zip(place, nearest, normal, strict=True)
        )
        distance = jnp.where(inside, deepest, beyond) - self.rounding
        return distance, [cos * east - sin * north, sin * east + cos * north, up]

    def size(self) -> tuple[str, float]:
        """See `Obstacle`."""
        least = _positive("half_sizes", self.half_sizes)
        if not 0 <= float(self.rounding) <= least:
            raise ValueError(
                f"rounding is {float(self.rounding):.4g} m; give zero or more, and at most the "
                f"smallest of half_sizes, {least:.4g} m"
            )
        return "half_sizes", least


SHAPES = {shape.__name__: shape for shape in (Table, Plane, Sphere, Capsule, Box)}
"""The shapes of obstacles, by name."""


def table_with_edge(
    edge: float = 0.0, *, rounding: float = 0.01, half_width: float = 1.0, height: float = 0.7
) -> Box:
    """A table that ends: its top is at z = 0 and covers x up to `edge`.

    Args:
        edge: x of the edge, metres.
        rounding: radius of the edge, metres.
        half_width: half the length and width of the top, metres.
        height: thickness of the block under the top, metres.

    Raises:
        ValueError: if a number that is known is out of its range.
    """
    sizes = {"rounding": rounding, "half_width": half_width, "height": height}
    ranges = {"edge": (edge, -FARTHEST)} | {name: (size, 0.0) for name, size in sizes.items()}
    for name, (value, lowest) in ranges.items():
        if not isinstance(value, jax.core.Tracer):
            require_number(name, value, lowest, FARTHEST, "m")
    center = (edge - half_width, 0.0, -height / 2)
    return Box(center, (half_width, half_width, height / 2), rounding)


def gap(body: Body) -> float:
    """Radius of the largest ball that fits between a body's particles at rest, metres.

    Half the longest link of a rope; for a sheet the largest radius about a triangle, or half the
    longest side of an obtuse one.
    """
    if not len(body.faces):
        return float(body.rest_length[body.families == STRETCH].max(initial=0.0)) / 2
    return float(covering_radii(body.rest, body.faces).max())


def least_radius(body: Body) -> float:
    """Smallest radius or half width of an obstacle that holds a body off, metres.

    A body is held off at its particles alone: a thinner obstacle slips between them.
    """
    return max(0.0, LEAST_SIZE * gap(body) - body.radius)


def make_obstacles(obstacles: Sequence[Obstacle], body: Body) -> tuple[Obstacle, ...]:
    """The obstacles, checked, with arrays for numbers.

    Raises:
        ValueError: if `check_obstacles` raises.
    """
    check_obstacles(obstacles, body)
    return tuple(
        _changed(each, {name: jnp.asarray(value) for name, value in _numbers(each).items()})
        for each in obstacles
    )


def check_obstacles(obstacles: Sequence[Any], body: Body) -> None:
    """Check obstacles of a body, without JAX.

    Raises:
        ValueError: if an entry is no obstacle, a number has another shape, is not finite or out
            of its range, or an obstacle is smaller than `least_radius` of the body.
    """
    if not isinstance(obstacles, Sequence):
        raise ValueError(f"obstacles is {obstacles!r}; give a tuple of them, as (Table(),)")
    for obstacle in obstacles:
        if isinstance(obstacle, type) or not isinstance(obstacle, Obstacle):
            raise ValueError(
                f"obstacles has {obstacle!r}; give Table(), or a Plane, Sphere, Capsule or Box"
            )
        try:
            name, size = _changed(obstacle, _numbers(obstacle)).size()
        except ValueError as error:
            raise ValueError(f"{type(obstacle).__name__}: {error}") from error
        if np.isfinite(size):
            _check_size(f"{type(obstacle).__name__}: {name}", size, body)


def _check_size(name: str, size: float, body: Body) -> None:
    """Check that an obstacle does not slip between a body's particles.

    Raises:
        ValueError: if it does.
    """
    least = least_radius(body)
    if size < least * (1 - 1e-6):  # rounding of float32
        raise ValueError(
            f"{name} is {size:.4g} m; the particles of this {body.name} leave gaps of radius "
            f"{gap(body):.4g} m, through which obstacles thinner than {least * (1 + 5e-4):.4g} m "
            f"slip. Give at least that, or a body of more particles"
        )


def has_table(obstacles: Sequence[Obstacle]) -> bool:
    """Whether the table is among the obstacles."""
    return any(isinstance(obstacle, Table) for obstacle in obstacles)


def _changed(obstacle: Any, numbers: dict[str, Any]) -> Any:
    """The obstacle with other numbers."""
    return dataclasses.replace(obstacle, **numbers)


def _numbers(obstacle: Any) -> dict[str, np.ndarray]:
    """An obstacle's numbers by field.

    Raises:
        ValueError: if one has another shape, is not finite or beyond `FARTHEST`.
    """
    numbers = {}
    for field in dataclasses.fields(obstacle):
        given = getattr(obstacle, field.name)
        value = as_reals(given)
        own = () if value is None else value.shape
        shape = SHAPES_OF_NUMBERS.get(field.type, own)
        if value is None or value.shape != shape or not np.all(np.abs(value) <= FARTHEST):
            wanted = {(): "a finite number", (3,): "three finite numbers"}.get(
                shape, "finite numbers"
            )
            told = repr(given) if value is None else _told(value)
            raise ValueError(f"{field.name} is {told}; give {wanted} up to {FARTHEST:g}")
        numbers[field.name] = value
    return numbers


def _positive(name: str, value: Any) -> float:
    """The least of some numbers that must all be above zero."""
    least = float(np.min(value))
    if not least > 0:
        raise ValueError(f"{name} is {_told(value)}; give metres above zero")
    return least


def _told(value: Any) -> str:
    """Numbers as messages show them."""
    numbers = [f"{each:.6g}" for each in np.ravel(value)]
    return numbers[0] if np.ndim(value) == 0 else f"({', '.join(numbers)})"


def _from(origin: Vector, x: Values, y: Values, z: Values) -> list[Any]:
    """Coordinates relative to an origin."""
    return [x - origin[0], y - origin[1], z - origin[2]]


def _grown(away: Axes, radius: Number) -> tuple[Array, Axes]:
    """Distance and normal of a core grown by a radius, from vectors off its nearest points."""
    length, normal = _length(away)
    return length - radius, normal


def _length(vector: Axes) -> tuple[Array, Axes]:
    """Lengths and directions of vectors; 0 and up where there is hardly a length."""
    squared = _dot(vector, vector)
    some = squared > 1e-20
    length = jnp.sqrt(jnp.where(some, squared, 1.0))
    unit = [jnp.where(some, each / length, up) for each, up in zip(vector, UP, strict=True)]
    return jnp.where(some, length, 0.0), unit


def _dot(a: Axes, b: Axes) -> Any:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
