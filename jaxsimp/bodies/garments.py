"""Garments from their dimensions: towel, T-shirt, trousers and skirt, flat on the table.

By default front and back, lying on each other, are one sheet of twice the fabric: such a garment
cannot open, or move front against back. With `sheets=2` they are two sheets of the same outline,
sewn together at the sides, and open at neck, cuffs, waist and hem; see `jaxsimp.bodies.sewing`.
Self-contact holds them apart.

Seen from above, x is across the garment and y along it, towards the neck or the waist. The mesh
is its own mirror image in x. Left is where x < 0.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Int

from jaxsimp.bodies.body import Body
from jaxsimp.bodies.constructors import from_mesh
from jaxsimp.bodies.material import MATERIALS
from jaxsimp.bodies.meshes import Points
from jaxsimp.bodies.outlines import COUNT_TOLERANCE, mesh_symmetric_outline
from jaxsimp.bodies.sewing import sew
from jaxsimp.bodies.size import LARGEST, MOST_PARTICLES, require_size
from jaxsimp.bodies.topology import Faces, boundary_loops
from jaxsimp.checks import require_count, require_number


@dataclass(frozen=True, eq=False)
class Garment:
    """A body with the positions of its parts.

    Attributes:
        body: the body to simulate.
        landmarks: particle ids of named points, as `"left_armpit"`. Of two sheets those of the
            front and the seams; points of the back that are not on a seam have the same name
            after `back_`, as `"back_neck"`.
        mirror: particle id of each particle's mirror image in x, shape (N,).
        opposite: id of the particle at the same place of the other sheet, shape (N,); on a seam,
            and in a garment of one sheet, its own id. Of two sheets the front has the lower ids.
    """

    body: Body
    landmarks: Mapping[str, int]
    mirror: Int[np.ndarray, " N"]
    opposite: Int[np.ndarray, " N"]


def towel(
    length: float = 0.6, width: float = 0.4, *, num_particles: int = 600, **options: Any
) -> Garment:
    """A rectangle. Landmarks: `left_top`, `middle_top` to `right_bottom`.

    Args:
        length: along y, metres.
        width: along x, metres.
        num_particles: number of particles, met within 10 %.
        options: arguments of `from_mesh`; the material is `MATERIALS["garment"]` by default.

    Raises:
        ValueError: if a dimension is no length of a body, or another argument is out of range.
    """
    _require(length=length, width=width)
    half = {
        "middle_top": (0.0, 0.0),
        "top": (width / 2, 0.0),
        "bottom": (width / 2, -length),
        "middle_bottom": (0.0, -length),
    }
    return _make("towel", half, num_particles, options)


def t_shirt(
    length: float = 0.5,
    chest: float = 0.34,
    *,
    sleeve_length: float = 0.14,
    sleeve_width: float = 0.13,
    neck_width: float = 0.14,
    neck_depth: float = 0.05,
    slope: float = 20.0,
    num_particles: int = 600,
    sheets: int = 1,
    **options: Any,
) -> Garment:
    """A T-shirt for a child: 0.5 m long, 0.6 m from cuff to cuff.

    Shoulders and sleeves are one straight line that falls from the neck; cuffs are at right
    angles to it. Landmarks: `neck` (its lowest point), `left_collar` (the corner of neck and
    shoulder), `left_shoulder` (above the armpit), `left_cuff_top`, `left_cuff_bottom`,
    `left_armpit`, `left_hem`, the same with `right`, and `middle_hem`.

    Args:
        length: along y, from the collar to the hem, metres.
        chest: across the body below the sleeves, metres.
        sleeve_length: along the sleeve's upper side, from above the armpit to the cuff, metres.
        sleeve_width: width of the cuff, metres.
        neck_width: width of the neck opening, metres.
        neck_depth: depth of the neck opening, metres.
        slope: slope of shoulders and sleeves, degrees below the x axis.
        num_particles: number of particles of all sheets, met within 10 %.
        sheets: 1, or 2 for front and back, sewn together at the shoulders, sleeves and
            sides.
        options: arguments of `from_mesh`; the material, of each sheet, is `MATERIALS["garment"]`
            by default, with half the density, stiffness and damping for two sheets.

    Raises:
        ValueError: if a dimension is no length of a body, the outline is not that of a T-shirt, or
            another argument is out of range.
    """
    _require(
        length=length,
        chest=chest,
        sleeve_length=sleeve_length,
        sleeve_width=sleeve_width,
        neck_width=neck_width,
        neck_depth=neck_depth,
    )
    slope = require_number("slope", slope, 0.0, 60.0, "degrees")
    _require_less("neck_width", neck_width, "the chest", chest)
    cos, sin = np.cos(np.deg2rad(slope)), np.sin(np.deg2rad(slope))
    shoulder = np.array([chest / 2, (neck_width - chest) / 2 * sin / cos])
    cuff_top = shoulder + sleeve_length * np.array([cos, -sin])
    cuff_bottom = cuff_top - sleeve_width * np.array([sin, cos])
    armpit = shoulder - [0.0, sleeve_width / cos]
    _require_less("the depth of the armpits", -armpit[1], "the length", length)
    _require_less("neck_depth", neck_depth, "the length", length)
    _require_less(
        "sleeve_width tan(slope)", sleeve_width * sin / cos, "sleeve_length", sleeve_length
    )
    half = {
        "neck": (0.0, -neck_depth),
        "collar": (neck_width / 2, 0.0),
        "shoulder": tuple(shoulder),
        "cuff_top": tuple(cuff_top),
        "cuff_bottom": tuple(cuff_bottom),
        "armpit": tuple(armpit),
        "hem": (chest / 2, -length),
        "middle_hem": (0.0, -length),
    }
    seams = ("collar", "shoulder", "cuff_bottom", "armpit")
    return _make("T-shirt", half, num_particles, options, sheets, seams)


def trousers(
    length: float = 0.6,
    waist: float = 0.28,
    *,
    rise: float = 0.2,
    cuff: float = 0.13,
    spread: float = 0.06,
    num_particles: int = 600,
    sheets: int = 1,
    **options: Any,
) -> Garment:
    """Trousers for a child, their legs apart.

    Landmarks: `middle_waist`, `crotch`, `left_waist`, `left_cuff_outer`,
    `left_cuff_inner`, and the same with `right`.

    Args:
        length: along y, from the waist to the cuffs, metres.
        waist: across the top, metres.
        rise: from the waist to the crotch, metres.
        cuff: across the end of a leg, metres.
        spread: distance of each leg's end beyond the waist, outwards, metres; may be below zero.
        num_particles: number of particles of all sheets, met within 10 %.
        sheets: 1, or 2 for front and back, sewn together at the outer and inner sides of
            the legs.
        options: arguments of `from_mesh`; the material, of each sheet, is `MATERIALS["garment"]`
            by default, with half the density, stiffness and damping for two sheets.

    Raises:
        ValueError: if a dimension is no length of a body, the outline is not that of trousers, or
            another argument is out of range.
    """
    _require(length=length, waist=waist, rise=rise, cuff=cuff)
    spread = require_number("spread", spread, -LARGEST, LARGEST, "m")
    _require_less("rise", rise, "the length", length)
    _require_less("cuff", cuff, "half the waist and spread", waist / 2 + spread)
    half = {
        "middle_waist": (0.0, 0.0),
        "waist": (waist / 2, 0.0),
        "cuff_outer": (waist / 2 + spread, -length),
        "cuff_inner": (waist / 2 + spread - cuff, -length),
        "crotch": (0.0, -rise),
    }
    return _make("trousers", half, num_particles, options, sheets, ("waist", "cuff_inner"))


def skirt(
    length: float = 0.35,
    waist: float = 0.26,
    *,
    hem: float = 0.44,
    num_particles: int = 600,
    sheets: int = 1,
    **options: Any,
) -> Garment:
    """A skirt, wider at its hem.

    Landmarks: `left_waist`, `left_hem`, the same with `right`, `middle_waist` and `middle_hem`.

    Args:
        length: along y, metres.
        waist: across the top, metres.
        hem: across the bottom, metres.
        num_particles: number of particles of all sheets, met within 10 %.
        sheets: 1, or 2 for front and back, sewn together at both sides.
        options: arguments of `from_mesh`; the material, of each sheet, is `MATERIALS["garment"]`
            by default, with half the density, stiffness and damping for two sheets.

    Raises:
        ValueError: if a dimension is no length of a body, or another argument is out of range.
    """
    _require(length=length, waist=waist, hem=hem)
    half = {
        "middle_waist": (0.0, 0.0),
        "waist": (waist / 2, 0.0),
        "hem": (hem / 2, -length),
        "middle_hem": (0.0, -length),
    }
    return _make("skirt", half, num_particles, options, sheets, ("waist",))


Half = Mapping[str, tuple[float, ...]]
"""Named corners of the right half of an outline, x and y, metres."""
SheetMesh = tuple[Points, Faces, Int[np.ndarray, " V"]]
"""Points, triangles, and mirror images of the points; the corners come first."""


def _make(
    name: str,
    half: Half,
    num_particles: int,
    options: Mapping[str, Any],
    sheets: int = 1,
    seams: tuple[str, ...] = (),
) -> Garment:
    """A garment from the corners of its right half.

    Of two sheets those sides of the outline are sewn that begin at the corners `seams`.
    """
    sheets = require_count("sheets", sheets, 1, 2)
    num_particles = require_count("num_particles", num_particles, 3, MOST_PARTICLES)
    options = {"name": name, "material": MATERIALS["garment"].scaled(**_PART[sheets]), **options}
    if sheets == 1:
        mesh = mesh_symmetric_outline(np.array(list(half.values())), num_particles)
        return _lay(half, mesh, options)
    mesh, seam = _mesh_front(name, half, num_particles, seams)
    front = _lay(half, mesh, options)
    body, opposite = sew(front.body, seam)
    count = front.body.num_particles
    mirror = np.concatenate([front.mirror, opposite[front.mirror[opposite[count:]]]])
    back = {
        f"back_{label}": int(opposite[particle])
        for label, particle in front.landmarks.items()
        if opposite[particle] != particle
    }
    return Garment(body, {**front.landmarks, **back}, mirror, opposite)


_PART: Mapping[int, Mapping[str, float]] = {
    1: {},
    2: {"mass": 0.5, "stiffness": 0.5, "damping": 0.5},
}
"""Factors on the default material of each sheet, by the number of sheets."""


def _lay(half: Half, mesh: SheetMesh, options: Mapping[str, Any]) -> Garment:
    """A garment of one sheet."""
    points, faces, mirror = mesh
    body = from_mesh(points, faces, **options)
    if body.num_particles != len(points):
        raise ValueError(
            f"the {body.name} has parts too small for its size; give larger dimensions"
        )
    landmarks = {}
    for corner, (label, (x, _)) in enumerate(half.items()):
        if x == 0:
            landmarks[label] = corner
        else:
            landmarks[f"right_{label}"] = corner
            landmarks[f"left_{label}"] = int(mirror[corner])
    return Garment(body, landmarks, mirror, np.arange(len(points)))


def _mesh_front(
    name: str, half: Half, num_particles: int, seams: tuple[str, ...]
) -> tuple[SheetMesh, Int[np.ndarray, "E 2"]]:
    """One of two sheets that have so many particles together, and the edges of its seams."""
    corners, asked = np.array(list(half.values())), num_particles // 2
    best: tuple[SheetMesh, np.ndarray] | None = None
    missed = num_particles
    for _ in range(10):  # how many particles both share follows from the mesh
        try:
            mesh = mesh_symmetric_outline(corners, asked)
        except ValueError as error:
            raise ValueError(f"each of two sheets of the {name}: {error}") from error
        seam = _seam(half, mesh, seams)
        missing = num_particles - (2 * len(mesh[0]) - len(np.unique(seam)))
        if best is None or abs(missing) < abs(missed):
            best, missed = (mesh, seam), missing
        if abs(missing) <= 1:
            break
        asked += missing // 2
    assert best is not None
    if abs(missed) > COUNT_TOLERANCE * num_particles:
        raise ValueError(
            f"{num_particles} particles are asked for; two sheets of this {name} are met with "
            f"{num_particles - missed}: ask for that, or for many more"
        )
    return best


def _seam(half: Half, mesh: SheetMesh, seams: tuple[str, ...]) -> Int[np.ndarray, "E 2"]:
    """Edges of both halves on the sides of the outline that begin at the corners `seams`."""
    _, faces, mirror = mesh
    labels, corners = list(half), {*range(len(half)), *mirror[: len(half)].tolist()}
    (loop,) = boundary_loops(faces)
    edges = []
    for label in seams:
        start = labels.index(label)
        at = loop.index(start)
        for turned in (loop[at:] + loop[:at], [start, *loop[:at][::-1], *loop[at + 1 :][::-1]]):
            side = turned[: turned.index(start + 1) + 1]
            if corners.isdisjoint(side[1:-1]):
                edges.append(np.stack([side[:-1], side[1:]], axis=1))
                break
    right = np.concatenate(edges)
    return np.concatenate([right, mirror[right]])


def _require(**dimensions: float) -> None:
    for name, value in dimensions.items():
        require_size(name, value, smallest=1e-3)


def _require_less(name: str, value: float, limit_name: str, limit: float) -> None:
    if not value < limit:
        raise ValueError(f"{name} is {value:.4g} m; make it less than {limit_name}, {limit:.4g} m")
