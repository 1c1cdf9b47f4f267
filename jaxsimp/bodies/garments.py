"""Garments from their dimensions: towel, T-shirt, trousers and skirt, flat on the table.

Front and back, sewn together and lying on each other, are one sheet of twice the fabric: a
garment cannot open, turn inside out, or move front against back.

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
from jaxsimp.bodies.outlines import mesh_symmetric_outline


@dataclass(frozen=True, eq=False)
class Garment:
    """A body with the positions of its parts.

    Attributes:
        body: the body to simulate.
        landmarks: particle ids of named points, as `"left_armpit"`.
        mirror: particle id of each particle's mirror image, shape (N,).
    """

    body: Body
    landmarks: Mapping[str, int]
    mirror: Int[np.ndarray, " N"]


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
        ValueError: if a dimension is not above zero, or another argument is out of range.
    """
    _require(length=length, width=width)
    half = {
        "middle_top": (0.0, 0.0),
        "top": (width / 2, 0.0),
        "bottom": (width / 2, -length),
        "middle_bottom": (0.0, -length),
    }
    return _sew("towel", half, num_particles, options)


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
        num_particles: number of particles, met within 10 %.
        options: arguments of `from_mesh`; the material is `MATERIALS["garment"]` by default.

    Raises:
        ValueError: if a dimension is not above zero, the outline is not that of a T-shirt, or
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
    if not 0 <= slope <= 60:
        raise ValueError(f"slope is {slope:g}; give 0 to 60 degrees")
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
    return _sew("T-shirt", half, num_particles, options)


def trousers(
    length: float = 0.6,
    waist: float = 0.28,
    *,
    rise: float = 0.2,
    cuff: float = 0.13,
    spread: float = 0.06,
    num_particles: int = 600,
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
        num_particles: number of particles, met within 10 %.
        options: arguments of `from_mesh`; the material is `MATERIALS["garment"]` by default.

    Raises:
        ValueError: if a dimension is not above zero, the outline is not that of trousers, or
            another argument is out of range.
    """
    _require(length=length, waist=waist, rise=rise, cuff=cuff)
    _require_less("rise", rise, "the length", length)
    _require_less("cuff", cuff, "half the waist and spread", waist / 2 + spread)
    half = {
        "middle_waist": (0.0, 0.0),
        "waist": (waist / 2, 0.0),
        "cuff_outer": (waist / 2 + spread, -length),
        "cuff_inner": (waist / 2 + spread - cuff, -length),
        "crotch": (0.0, -rise),
    }
    return _sew("trousers", half, num_particles, options)


def skirt(
    length: float = 0.35,
    waist: float = 0.26,
    *,
    hem: float = 0.44,
    num_particles: int = 600,
    **options: Any,
) -> Garment:
    """A skirt, wider at its hem.

    Landmarks: `left_waist`, `left_hem`, the same with `right`, `middle_waist` and `middle_hem`.

    Args:
        length: along y, metres.
        waist: across the top, metres.
        hem: across the bottom, metres.
        num_particles: number of particles, met within 10 %.
        options: arguments of `from_mesh`; the material is `MATERIALS["garment"]` by default.

    Raises:
        ValueError: if a dimension is not above zero, or another argument is out of range.
    """
    _require(length=length, waist=waist, hem=hem)
    half = {
        "middle_waist": (0.0, 0.0),
        "waist": (waist / 2, 0.0),
        "hem": (hem / 2, -length),
        "middle_hem": (0.0, -length),
    }
    return _sew("skirt", half, num_particles, options)


def _sew(
    name: str,
    half: Mapping[str, tuple[float, ...]],
    num_particles: int,
    options: Mapping[str, Any],
) -> Garment:
    """A garment from the named corners of its right half."""
    points, faces, mirror = mesh_symmetric_outline(np.array(list(half.values())), num_particles)
    options = {"name": name, "material": MATERIALS["garment"], **options}
    body = from_mesh(points, faces, **options)
    if body.num_particles != len(points):
        raise ValueError(f"the {name} has parts too small for its size; give larger dimensions")
    landmarks = {}
    for corner, (label, (x, _)) in enumerate(half.items()):  # the corners are the first particles
        if x == 0:
            landmarks[label] = corner
        else:
            landmarks[f"right_{label}"] = corner
            landmarks[f"left_{label}"] = int(mirror[corner])
    return Garment(body, landmarks, mirror)


def _require(**dimensions: float) -> None:
    for name, value in dimensions.items():
        if not 0 < value < np.inf:
            raise ValueError(f"{name} is {value:g}; give a length above zero, in metres")


def _require_less(name: str, value: float, limit_name: str, limit: float) -> None:
    if not value < limit:
        raise ValueError(f"{name} is {value:.4g} m; it must be below {limit_name}, {limit:.4g} m")
