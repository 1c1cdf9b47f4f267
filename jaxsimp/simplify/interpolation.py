"""Models as interpolation in rest coordinates: p ≈ W q, for ropes and surfaces alike.

Particle `i` is where the model's simplex nearest to its rest coordinates takes it: row `i` of
`W` holds the barycentric coordinates of the nearest point. Distances between a particle's goal
and `W q` see every layer of a folded goal, as distances between surfaces cannot.
"""

import numpy as np
from jaxtyping import Float, Int


def interpolation_weights(
    rest: Float[np.ndarray, "N 3"],
    particles: Int[np.ndarray, " K"],
    elements: Int[np.ndarray, "M E"],
) -> Float[np.ndarray, "N K"]:
    """Weights of the key points in the model's position of every particle, shape (N, K).

    Args:
        rest: rest coordinates of the particles, metres.
        particles: ids of the key points.
        elements: segments (E = 2) or triangles (E = 3) as indices into `particles`, at least one.
    """
    import igl

    corners = np.ascontiguousarray(rest[particles], dtype=np.float64)
    simplices = np.ascontiguousarray(elements, dtype=np.int64)
    points = np.ascontiguousarray(rest, dtype=np.float64)
    _, nearest, feet = igl.point_mesh_squared_distance(points, corners, simplices)
    chosen = simplices[nearest]
    weights = np.zeros((len(rest), len(particles)))
    rows = np.arange(len(rest))[:, None]
    weights[rows, chosen] = _barycentric(feet, corners[chosen])
    return weights


def model_errors(
    goal: Float[np.ndarray, "N 3"],
    weights: Float[np.ndarray, "N K"],
    positions: Float[np.ndarray, "K 3"],
) -> tuple[float, float]:
    """Largest and root mean square distance between particles and model, metres."""
    squared = np.sum((weights @ positions - goal) ** 2, axis=1)
    return float(np.sqrt(squared.max())), float(np.sqrt(squared.mean()))


def _barycentric(
    points: Float[np.ndarray, "N 3"], corners: Float[np.ndarray, "N E 3"]
) -> Float[np.ndarray, "N E"]:
    """Barycentric coordinates of points of segments or triangles, shape (N, E)."""
    edges = corners[:, 1:] - corners[:, :1]
    along = np.linalg.pinv(np.swapaxes(edges, 1, 2)) @ (points - corners[:, 0])[:, :, None]
    inner = np.clip(along[:, :, 0], 0.0, 1.0)
    return np.concatenate([1.0 - inner.sum(axis=1, keepdims=True), inner], axis=1)
