"""Registration: which point of a goal is which particle, for goals with points of their own.

A sheet that is flat at rest is laid out in the plane again, from the distances of neighbours in the
goal (see `jaxsimp.goals.flatten`): along the edges of a mesh, or between the nearest points of a
cloud. The layout is turned, mirrored and moved until its outline is the body's (P. Besl and N.
McKay, "A method for registration of 3-D shapes", 1992, from many turns); each particle then has the
place of its point of the layout. `jaxsimp.goals.curves` has ropes.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Complex, Float, Int

from jaxsimp.bodies import Body
from jaxsimp.bodies.meshes import WELD, face_areas
from jaxsimp.bodies.size import require_size
from jaxsimp.bodies.topology import (
    Faces,
    boundary_edges,
    connected_pieces,
    distinct_edges,
    half_edges,
)
from jaxsimp.checks import require_ids, require_reals, require_rows, require_shape
from jaxsimp.goals.check import NOISE, check_goal
from jaxsimp.goals.curves import along_curve
from jaxsimp.goals.flatten import MISFIT, lay_out, median_misfit
from jaxsimp.goals.outline_fit import Sheet, fit_outlines, in_space, outside
from jaxsimp.goals.shapes import Positions, flat

MOST_POINTS, MOST_OF_MESH = 20_000, 6_000
"""Largest number of points of a cloud, which is averaged, and of a mesh, which is laid out whole:
that takes 10 s, and in finer ones noise of 1 mm outweighs the edges."""
MOST_MATCHED = 3000
"""Largest number of points that are matched with as many particles, one by one."""
NEIGHBOURS = 8
GAP = 1.7
"""Largest distance of neighbours in a cloud, in median distances."""
THINNED = 2.0
"""Points for each particle, to which a denser cloud is averaged: that takes its noise away."""
ALIKE = 0.01
"""Misfit of outlines, relative to the body's size, above the least, of fits that are as good."""
CLOUD = 0.02
"""Largest distance between the body and a cloud, relative to the body's size, and besides a quarter
of the points' spacing: less than `NOISE`, as a corner that touches shows little elsewhere."""
SHORTCUTS = 0.005
"""Largest share of neighbours in a cloud whose distance in its layout is off by half of the usual
one: they are of two layers. Noise of 2 mm between points 7 mm apart gives up to 0.001."""
HOLE = 1.2
"""Largest radius of the circle about a triangle of a cloud's layout, in median distances of
neighbours: larger ones are gaps."""


@dataclass(frozen=True, eq=False)
class Registration:
    """The place of each particle in a goal that has points of its own.

    Attributes:
        positions: shape (N, 3), metres.
        error: largest distance by which the goal, laid flat, reaches beyond the body, or the body
            beyond the goal; for a rope that of the goal's points from the rope, metres.
        num_alike: number of ways to lay the body into the goal that fit about as well, such as the
            two directions of a rope or the eight of a square; that nearest to the start was taken.
    """

    positions: Positions
    error: float
    num_alike: int


def register(
    body: Body,
    points: Float[np.ndarray, "M 3"],
    faces: Int[np.ndarray, "F 3"] | None = None,
    *,
    start: Positions | None = None,
) -> Registration:
    """A goal from points that are not the body's particles: other ones, or in another order.

    The body is a rope, or a sheet of one layer that is flat at rest. Without `faces` the points are
    a cloud in any order, and its layers must lie further apart than its points, since neighbours
    are told by their distance. Noise of 2 mm on a cloth of 0.3 m does no harm.

    Args:
        body: the body.
        points: points of the goal, shape (M, 3), metres, z up.
        faces: triangles of a mesh of these points, shape (F, 3); None for a cloud.
        start: positions at the start, shape (N, 3), metres, which decide between ways that fit as
            well; by default the body flat on the table, and for a rope the first point of the goal
            is at its first end.

    Raises:
        ValueError: if the body is of several layers or not flat, an array has another shape or
            value, the goal does not fit the body, or `check_goal` refuses the result.
    """
    points = require_rows("points", points, 3)
    extent = float(np.ptp(points, axis=0).max()) if len(points) else 0.0
    require_size("the largest extent of the goal", extent, smallest=0.0)
    if start is not None:
        why = f"one row for each particle of the {body.name}"
        start = require_reals("start", start, body.rest.shape, why)
    most = MOST_POINTS if faces is None else MOST_OF_MESH
    if not 3 <= len(points) <= most:
        raise ValueError(
            f"the goal has {len(points)} points, and the {body.name} {body.num_particles} "
            f"particles; 3 to {most} points are registered: give more, or for a fine mesh those of "
            f"jaxsimp.bodies.remesh"
        )
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False) / len(points) ** 0.5
    least = float(spread[1 if len(body.faces) else 0])
    if least <= WELD * body.size:
        raise ValueError(
            f"the points of the goal lie on a line, or at one place, with a spread of {least:.2g} "
            f"m; give points of a {body.name} of {body.size:.3g} m"
        )
    if not len(body.faces):
        found = Registration(*along_curve(body, points, start), num_alike=2)
    else:
        found = _register_sheet(body, points, faces, flat(body) if start is None else start)
    check_goal(body, found.positions)
    return found


def _register_sheet(
    body: Body, points: np.ndarray, faces: np.ndarray | None, start: np.ndarray
) -> Registration:
    """A sheet from a mesh or a cloud."""
    rest, is_cloud = _at_rest(body), faces is None
    if faces is None:
        points = _thinned(points, int(THINNED * body.num_particles))
        edges = _neighbours(points)
    else:
        faces = require_ids("a triangle", faces, len(points), "points")
        require_shape("faces", faces, ("F", 3), "a row of three points for each triangle")
        if not len(faces):
            raise ValueError("there are no faces; give triangles, or None for a cloud of points")
        points, faces = _one_piece(points, faces)
        edges = distinct_edges(half_edges(faces)[0])[0]
    layout = _laid_out(body, points, edges, faces)
    sheet = Sheet(layout, _covered(layout, edges) if faces is None else faces)
    ways = fit_outlines(rest, sheet, ALIKE * body.size)
    spacing = float(np.median(np.abs(layout[edges[:, 1]] - layout[edges[:, 0]])))
    error = max(outside(ways[0], sheet), outside(layout, Sheet(ways[0], body.faces)))
    limit = NOISE * body.size + spacing / 2
    if is_cloud:
        limit = CLOUD * body.size + spacing / 4
    if error > limit:
        raise ValueError(
            f"laid flat, the goal reaches {error:.3g} m beyond the {body.name}, or falls short by "
            f"that; {limit:.3g} m is the limit. {_REMEDY}"
        )
    places = [_placed(place, sheet, points, spacing) for place in ways]
    nearest = min(places, key=lambda each: float(((each - start) ** 2).sum()))
    return Registration(nearest, error, len(places))


_REMEDY = (
    "Give a goal of this body in metres (scale=); of a cloud whose layers touch give a mesh (add "
    "faces), or its points in the order of the particles"
)


def _at_rest(body: Body) -> Sheet:
    """The body in the plane, if it is one layer."""
    flat(body)
    rest = body.rest[:, 0] + 1j * body.rest[:, 1]
    sheet = Sheet(rest, body.faces)
    if (sheet.areas() > 0).any() and (sheet.areas() < 0).any():
        raise ValueError(
            f"the {body.name} has several layers at rest; goals of other points are registered to "
            f"a sheet of one layer, or a rope: give the goal's points in the order of the particles"
        )
    return sheet


def _thinned(points: np.ndarray, count: int) -> np.ndarray:
    """A cloud averaged to so many points, if it has more."""
    if len(points) <= 1.5 * count:
        return points
    from scipy.cluster.vq import kmeans2

    centres, label = kmeans2(points, count, iter=10, minit="points", rng=np.random.default_rng(0))
    return centres[np.bincount(label, minlength=count) > 0]


def _neighbours(points: np.ndarray) -> Int[np.ndarray, "E 2"]:
    """Pairs of points of a cloud that are near to each other."""
    from scipy.spatial import cKDTree

    count = min(NEIGHBOURS, len(points) - 1)
    distance, other = cKDTree(points).query(points, k=count + 1)
    near = distance[:, 1:] <= GAP * np.median(distance[:, 1:])
    first = np.broadcast_to(np.arange(len(points))[:, None], near.shape)
    return distinct_edges(np.stack([first[near], other[:, 1:][near]], axis=1))[0]


def _one_piece(points: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The points of a mesh's triangles, those of one place joined if it is in pieces otherwise."""
    whole = (np.diff(np.sort(faces, axis=1), axis=1) > 0).all(axis=1)
    if not whole.any():
        raise ValueError(f"each of {len(faces)} triangles names a point twice; give a surface")
    faces = faces[whole]
    used, faces = np.unique(faces, return_inverse=True)
    points, faces = points[used], faces.reshape(-1, 3)
    if connected_pieces(half_edges(faces)[0], len(points))[0] > 1:
        points, where = np.unique(points, axis=0, return_inverse=True)
        faces = where.ravel()[faces]
    return points, faces


def _laid_out(
    body: Body, points: np.ndarray, edges: np.ndarray, faces: np.ndarray | None
) -> Complex[np.ndarray, " V"]:
    """The points in the plane, by the distances of neighbours."""
    pieces, _ = connected_pieces(edges, len(points))
    if pieces > 1:
        raise ValueError(
            f"the points of the goal are in {pieces} pieces, and the {body.name} is in one; give "
            f"more points, evenly spread, or a mesh in one piece (add faces)"
        )
    lengths = np.linalg.norm(points[edges[:, 1]] - points[edges[:, 0]], axis=1)
    first = None if faces is None else _conformal(points, faces)
    if first is not None and not np.isfinite(first).all():
        first = None  # of empty triangles
    layout = lay_out(edges, lengths, len(points), first)[-1]
    if faces is None:
        _check_shortcuts(body, layout, edges, lengths)
    misfit = median_misfit(layout, edges, lengths)
    if misfit > MISFIT:
        raise ValueError(
            f"laid flat, the distances of neighbours in the goal change by {misfit:.1%} in the "
            f"median; {MISFIT:.0%} is the limit for the {body.name}. {_REMEDY}"
        )
    return layout[:, 0] + 1j * layout[:, 1]


def _check_shortcuts(
    body: Body, layout: np.ndarray, edges: np.ndarray, lengths: np.ndarray
) -> None:
    """Raise a `ValueError` for a cloud with neighbours that are far apart in its layout."""
    apart = np.linalg.norm(layout[edges[:, 1]] - layout[edges[:, 0]], axis=1)
    share = float(np.mean(np.abs(apart - lengths) > np.median(lengths) / 2))
    if share > SHORTCUTS:
        raise ValueError(
            f"layers of the {body.name} are as near to each other as neighbours in the goal, at "
            f"{share:.1%} of these; {SHORTCUTS:.1%} is the limit. {_REMEDY}"
        )


def _conformal(points: np.ndarray, faces: np.ndarray) -> Float[np.ndarray, "V 2"]:
    """A first layout that keeps the angles of a mesh with a boundary, also of one with arms.

    Least-squares conformal maps (B. Lévy et al., 2002), with the mesh's area.
    """
    import igl

    rim = np.unique(boundary_edges(faces)[0])
    if not len(rim):
        raise ValueError(
            f"the mesh of the goal is closed, of {len(faces)} triangles; a sheet has a boundary: "
            f"give its points in the order of the particles"
        )
    far = rim[np.linalg.norm(points[rim] - points[rim[0]], axis=1).argmax()]
    pins = np.array([[0.0, 0.0], [1.0, 0.0]])
    with np.errstate(all="ignore"):
        layout, _ = igl.lscm(points, faces, np.array([rim[0], far]), pins)
    flat = Sheet(layout[:, 0] + 1j * layout[:, 1], faces)
    return layout * np.sqrt(face_areas(points, faces).sum() / np.abs(flat.areas()).sum())


def _covered(layout: np.ndarray, edges: np.ndarray) -> Faces:
    """Triangles of a cloud's layout, without those across gaps."""
    from scipy.spatial import Delaunay

    flat = np.stack([layout.real, layout.imag], axis=1)
    faces = Delaunay(flat).simplices.astype(np.int64)
    usual = np.median(np.abs(layout[edges[:, 1]] - layout[edges[:, 0]]))
    sides = np.abs(layout[faces] - layout[np.roll(faces, 1, axis=1)])
    areas = Sheet(layout, faces).areas()
    around = sides.prod(axis=1) / np.maximum(4 * np.abs(areas), 1e-300)  # radius of the circle
    return np.where((areas < 0)[:, None], faces[:, ::-1], faces)[around <= HOLE * usual]


def _placed(place: np.ndarray, sheet: Sheet, points: np.ndarray, spacing: float) -> Positions:
    """Positions of particles from their places in the layout."""
    from scipy.optimize import linear_sum_assignment
    from scipy.spatial.distance import cdist

    if len(points) == len(place) <= MOST_MATCHED:
        apart = cdist(in_space(place), in_space(sheet.points))
        _, match = linear_sum_assignment(apart**2)
        if apart[np.arange(len(place)), match].max() <= spacing / 2:
            return points[match]  # the points are the particles, in another order
    return _interpolated(place, sheet, points)


def _interpolated(place: np.ndarray, sheet: Sheet, points: np.ndarray) -> Positions:
    """Positions between the points of the goal; beyond its outline the nearest triangle goes on."""
    import igl

    _, face, _ = igl.point_mesh_squared_distance(
        in_space(place), in_space(sheet.points), sheet.faces
    )
    corners = sheet.faces[face]
    a, b, c = sheet.points[corners.T]
    double = 2 * sheet.areas()[face]
    second = ((place - a).conj() * (c - a)).imag / double
    third = ((b - a).conj() * (place - a)).imag / double
    # A sliver at the outline would lead far away.
    second, third = (np.clip(each, -0.5, 1.5) for each in (second, third))
    shares = np.stack([1 - second - third, second, third], axis=1)
    return (shares[:, :, None] * points[corners]).sum(axis=1)
