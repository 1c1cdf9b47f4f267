"""Sewing: a flat sheet and its copy, joined along seams, as the front and back of a garment."""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Int

from jaxsimp.bodies.body import Body
from jaxsimp.bodies.topology import are_among, boundary_edges, distinct_edges, half_edges
from jaxsimp.checks import require_ids

TAPER = 4.0
"""Distance from the seam beyond which front and back lie a thickness apart at rest, in
thicknesses. From the seam to there the front rises by half a thickness, which lengthens it by 1 %
at most."""


def sew(
    sheet: Body, seam: Int[np.ndarray, "E 2"], *, name: str | None = None
) -> tuple[Body, Int[np.ndarray, " N"]]:
    """Two copies of a flat sheet, front above back, joined along edges of its boundary.

    Particles of the seam are shared. The front has the particles of the sheet, in their order, and
    faces up; particles of the back that are not on the seam follow in the same order, and its
    triangles face down, so that the surface has one outside.

    Masses, springs, rest lengths, stiffness and damping are those of both sheets laid flat; what
    both have between the same particles of the seam is added up. The seam is a hinge: no spring
    joins front and back across it.

    At rest the back lies on the table and the front a thickness above it, the seam half-way
    between them; see `TAPER`.

    Args:
        sheet: one sheet, flat, at z = 0.
        seam: particle ids of the edges to join, each on the sheet's boundary, shape (E, 2).
        name: name of the body, that of the sheet by default.

    Returns:
        The body, and for each of its particles the one at the same place of the other sheet, on
        the seam its own id, shape (N,).

    Raises:
        ValueError: if the sheet has no thickness, the seam is empty or not on the boundary, or an
            edge inside the sheet joins two particles of the seam, where front and back would be
            joined too.
    """
    thickness = sheet.material.thickness
    if not thickness > 0:
        raise ValueError(
            "thickness is 0; front and back lie a thickness apart: give metres above zero, or one "
            "sheet"
        )
    on_seam = _on_seam(sheet, seam)
    count, free = sheet.num_particles, np.flatnonzero(~on_seam)
    image = np.arange(count)
    image[free] = count + np.arange(len(free))
    opposite = np.concatenate([image, free])
    from scipy.spatial import cKDTree

    away, _ = cKDTree(sheet.rest[on_seam]).query(sheet.rest)
    rise = thickness / 2 * np.minimum(1.0, away / (TAPER * thickness))
    rest = np.concatenate([sheet.rest, sheet.rest[free]])
    rest[:, 2] += thickness / 2 + np.concatenate([rise, -rise[free]])
    springs, first, group = _both(sheet.springs, image)
    body = replace(
        sheet,
        name=name or sheet.name,
        rest=rest,
        mass=np.concatenate([np.where(on_seam, 2.0, 1.0) * sheet.mass, sheet.mass[free]]),
        springs=springs,
        families=np.tile(sheet.families, 2)[first],
        rest_length=np.tile(sheet.rest_length, 2)[first],
        stiffness=np.bincount(group, weights=np.tile(sheet.stiffness, 2)),
        damping=np.bincount(group, weights=np.tile(sheet.damping, 2)),
        faces=np.concatenate([sheet.faces, image[sheet.faces[:, ::-1]]]),
        shape=(len(rest),),
    )
    return body, opposite


def _on_seam(sheet: Body, seam: np.ndarray) -> Bool[np.ndarray, " N"]:
    """Whether each particle is on the seam, if the sheet can be sewn there."""
    seam = require_ids("seam", seam, sheet.num_particles)
    if not len(seam):
        raise ValueError(
            "the seam has no edge; give one or more, pairs of particles on the boundary"
        )
    inside = seam[~are_among(seam, boundary_edges(sheet.faces)[0])]
    if len(inside):
        raise ValueError(
            f"the edge {inside[0].tolist()} of the seam is not on the boundary of the "
            f"{sheet.name}; give edges of one triangle"
        )
    on_seam = np.zeros(sheet.num_particles, dtype=bool)
    on_seam[seam] = True
    edges, _, _ = distinct_edges(half_edges(sheet.faces)[0])
    across = edges[on_seam[edges].all(axis=1) & ~are_among(edges, seam)]
    if len(across):
        start, end = sheet.rest[across[0], :2].round(4).tolist()
        raise ValueError(
            f"the {sheet.name} is one edge wide from seam to seam, from {start} to {end}: that "
            f"edge would join front and back: ask for more particles, or widen it"
        )
    return on_seam


def _both(springs: np.ndarray, image: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Springs of both sheets, each pair once: pairs, their first rows, and the pair of each row."""
    rows = np.concatenate([springs, image[springs]])
    pairs, group, _ = distinct_edges(rows)
    _, first = np.unique(group, return_index=True)
    # In the order of the sheet's springs, those of the back last.
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return pairs[order], first[order], rank[group]
