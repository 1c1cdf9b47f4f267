"""Models as interpolation in rest coordinates: p ≈ W q, for ropes and surfaces alike.

Row `i` of `W` holds the barycentric coordinates of the point nearest to the rest coordinates of
particle `i`, in the simplex that is nearest to them. Distances between a particle's goal and
`W q` distinguish the layers of a folded goal; distances between surfaces do not.
"""

import numpy as np
from jaxtyping import Float, Int

THIN = 1e-6  # height over longest edge, below which a triangle is treated as its edges


def interpolation_weights(
    rest: Float[np.ndarray, "N 3"],
    particles: Int[np.ndarray, " K"],
    elements: Int[np.ndarray, "M E"],
) -> Float[np.ndarray, "N K"]:
    """Weights of the key points in the model's position of every particle, shape (N, K).

    Of simplices at the same distance the first counts. Parts of a body that coincide at rest, as
    the two sides of a flat shirt, are therefore not distinguished.

    Args:
        rest: rest coordinates of the particles, metres.
        particles: ids of the key points.
        elements: segments (E = 2) or triangles (E = 3) as indices into `particles`, at least one.
    """
    least = np.full(len(rest), np.inf)
    chosen = np.zeros(len(rest), dtype=int)
    coordinates = np.zeros((len(rest), elements.shape[1]))
    closer = 1e-12 * np.ptp(rest, axis=0).max() ** 2  # above rounding
    for index, element in enumerate(elements):
        nearest, squared = nearest_in_simplex(rest, rest[particles[element]])
        better = squared < least - closer
        least[better], chosen[better] = squared[better], index
        coordinates[better] = nearest[better]
    weights = np.zeros((len(rest), len(particles)))
    np.add.at(weights, (np.arange(len(rest))[:, None], elements[chosen]), coordinates)
    return weights


def model_errors(
    goal: Float[np.ndarray, "N 3"],
    weights: Float[np.ndarray, "N K"],
    positions: Float[np.ndarray, "K 3"],
) -> tuple[float, float]:
    """Largest and root mean square distance between particles and model, metres."""
    squared = np.sum((weights @ positions - goal) ** 2, axis=1)
    return float(np.sqrt(squared.max())), float(np.sqrt(squared.mean()))


def nearest_in_simplex(
    points: Float[np.ndarray, "N 3"], corners: Float[np.ndarray, "E 3"]
) -> tuple[Float[np.ndarray, "N E"], Float[np.ndarray, " N"]]:
    """Barycentric coordinates of the nearest points of a simplex, and squared distances to them.

    Args:
        points: shape (N, 3), metres.
        corners: corners of a segment (E = 2) or a triangle (E = 3); length or area may be zero.

    Returns:
        Coordinates, shape (N, E), at least zero, each row summing to 1; and squared distances,
        shape (N,), square metres.
    """
    if len(corners) == 2:
        coordinates = _in_segment(points, corners)
    else:
        coordinates = _in_triangle(points, corners)
    return coordinates, np.sum((coordinates @ corners - points) ** 2, axis=1)


def _in_segment(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    edge = corners[1] - corners[0]
    length = max(edge @ edge, np.finfo(float).tiny)
    along = np.clip((points - corners[0]) @ edge / length, 0.0, 1.0)
    return np.stack([1.0 - along, along], axis=1)


def _in_triangle(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    best = np.zeros((len(points), 3))
    least = np.full(len(points), np.inf)
    for edge in ([0, 1], [1, 2], [2, 0]):
        coordinates, squared = nearest_in_simplex(points, corners[edge])
        better = squared < least
        least[better] = squared[better]
        best[better] = 0.0
        best[np.flatnonzero(better)[:, None], edge] = coordinates[better]
    edges = corners[1:] - corners[0]
    normal = np.cross(*edges)
    longest = np.sum((corners - np.roll(corners, 1, axis=0)) ** 2, axis=1).max()
    if np.linalg.norm(normal) <= THIN * longest:
        return best
    # A corner's coordinate is a fraction of the triangle's area: that of the triangle between the
    # opposite edge and the point. Two come from areas along the normal, the third is the rest.
    offset = points - corners[0]
    inner = np.stack([np.cross(offset, edges[1]), np.cross(edges[0], offset)]) @ normal
    inner /= normal @ normal
    flat = np.column_stack([1.0 - inner.sum(axis=0), inner.T])
    within = (flat >= 0).all(axis=1)
    best[within] = flat[within]
    return best
