"""Hausdorff distance between triangle meshes, surface to surface."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

THIN = 1e-9  # ratio of height to longest edge below which a triangle is treated as that edge


@dataclass(frozen=True, eq=False)
class Surface:
    """A triangle mesh in space; triangles without area count as segments or points.

    Attributes:
        points: vertex positions, shape (V, 3), metres.
        faces: vertex ids of the triangles, shape (F, 3), at least one.

    Raises:
        ValueError: if an array is not valid for a mesh.
    """

    points: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]

    def __post_init__(self) -> None:
        if len(self.faces) == 0:
            raise ValueError("the surface has 0 triangles; give at least 1")
        if self.faces.min() < 0 or self.faces.max() >= len(self.points):
            raise ValueError(
                f"faces names vertices {self.faces.min()} to {self.faces.max()}; "
                f"a surface of {len(self.points)} points has ids 0 to {len(self.points) - 1}"
            )
        if not np.isfinite(self.points[self.faces]).all():
            raise ValueError("a vertex of the surface is not finite; give coordinates in metres")


def hausdorff_distance(first: Surface, second: Surface, spacing: float) -> float:
    """Hausdorff distance of two surfaces: the largest distance of a point of one from the other.

    Distances from a sample to the other surface are exact; only their starting points are
    sampled. No point of a surface is farther than `spacing / sqrt(3)` from a sample, so the
    result lies between the exact distance less `spacing / sqrt(3)` and the exact distance.
    Vertices are samples, so distances reached at vertices are exact. Layers that cover each other
    count as one surface: the distance of sets does not show that one of them is missing.

    Args:
        first: a surface, metres.
        second: a surface, metres.
        spacing: largest distance of neighbouring samples along a triangle's edge, metres.

    Raises:
        ValueError: if the spacing is not above zero.
    """
    return max(
        _farthest(sample_surface(first, spacing), second),
        _farthest(sample_surface(second, spacing), first),
    )


def sample_surface(surface: Surface, spacing: float) -> Float[np.ndarray, "P 3"]:
    """Points that cover a surface, shape (P, 3), metres: a regular grid on each triangle.

    A triangle is divided into similar ones with edges no longer than `spacing`; a point of
    a triangle is at most its longest edge over sqrt(3) from the nearest vertex.

    Args:
        surface: the surface to sample.
        spacing: longest edge of the small triangles, metres.

    Raises:
        ValueError: if the spacing is not above zero.
    """
    if not spacing > 0:
        raise ValueError(f"spacing is {spacing:g}; give a distance above zero, in metres")
    corners = surface.points[surface.faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    divisions = np.maximum(1, np.ceil(longest / spacing)).astype(int)
    return np.concatenate(
        [
            (_barycentric_grid(count) @ corners[divisions == count]).reshape(-1, 3)
            for count in np.unique(divisions).tolist()
        ]
    )


def _barycentric_grid(divisions: int) -> np.ndarray:
    """Barycentric coordinates of a triangle's grid points, shape (P, 3)."""
    first, second = np.mgrid[: divisions + 1, : divisions + 1].reshape(2, -1)
    inside = first + second <= divisions
    first, second = first[inside], second[inside]
    return np.stack([first, second, divisions - first - second], axis=1) / divisions


def _farthest(samples: np.ndarray, surface: Surface) -> float:
    """Largest distance of a sample from the surface, metres."""
    import igl

    points = np.asarray(surface.points, dtype=np.float64)
    squared, _, _ = igl.point_mesh_squared_distance(
        np.asarray(samples, dtype=np.float64), points, _without_slivers(points, surface.faces)
    )
    return float(np.sqrt(squared.max()))


def _without_slivers(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Triangles, with those of rounded height zero replaced by their longest edges (a, b, b).

    libigl treats such an edge as a segment, but projects onto the plane of a sliver, whose normal
    is only rounding, with an error of the order of the triangle's size.
    """
    corners = points[faces]
    edges = np.roll(corners, -1, axis=1) - corners
    lengths = np.linalg.norm(edges, axis=2)
    height_by_edge = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    thin = height_by_edge <= THIN * lengths.max(axis=1) ** 2
    longest = lengths.argmax(axis=1)
    rows = np.arange(len(faces))
    start, end = faces[rows, longest], faces[rows, (longest + 1) % 3]
    return np.where(thin[:, None], np.stack([start, end, end], axis=1), faces).astype(np.int64)
