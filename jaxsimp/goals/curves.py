"""Ropes from points in any order: the curve through them, from end to end."""

import numpy as np
from jaxtyping import Float

from jaxsimp.bodies import Body
from jaxsimp.goals.check import MAX_STRETCH, NOISE
from jaxsimp.goals.shapes import Positions

THINNED = 1.5
"""Most points for each particle, above which a cloud is averaged to one for each."""
SHORTEST = 0.9
"""Least length of the curve, relative to the rope's."""
NEAR, FAR = 1.2, 5.0
"""Distance of points, in longest steps, below which a curve meets itself, and distance along it, in
such distances, above which: at a corner points are near to each other."""


def along_curve(
    body: Body, points: Float[np.ndarray, "M 3"], start: Positions | None
) -> tuple[Positions, float]:
    """Positions of a rope along the curve through points in any order, and the error.

    Neighbours are joined by the shortest tree (the minimum spanning tree). Its longest path is the
    curve, into which points beside it are inserted. Particles lie on it in proportion to their
    distances at rest.

    Args:
        body: a rope.
        points: shape (M, 3), metres.
        start: positions at the start, shape (N, 3), metres; of the two directions that is taken
            which is nearer to them, or without them nearer to the first point at the first end.

    Returns:
        Positions, shape (N, 3), metres, and the largest distance of a point from the curve, metres.

    Raises:
        ValueError: if the points do not lie along one curve about as long as the rope, or it meets
            itself.
    """
    rest = _arc(body.rest)
    limit = NOISE * rest[-1] + body.radius
    distinct = np.unique(points, axis=0)  # points at one place are no neighbours in a graph
    curve = _through(distinct, body.num_particles, limit)
    own = _arc(curve)
    error = float(_distances(points, curve).max())
    if error > limit:
        what = f"leaves out points {error:.3g} m away from it, and {limit:.3g} m is the limit"
    elif not SHORTEST <= own[-1] / rest[-1] <= MAX_STRETCH:
        what = (
            f"is {own[-1]:.3g} m long, and the {body.name} {rest[-1]:.3g} m; "
            f"{SHORTEST:g} to {MAX_STRETCH:g} of that is the limit"
        )
    elif _meets_itself(curve, own):
        what = "meets itself: some points are as near to others as to their neighbours"
    else:
        at = rest / rest[-1] * own[-1]
        if len(own) == len(at) and np.abs(own - at).max() <= np.diff(at).min() / 2:
            return _directed(curve, points[0], start), error  # the particles themselves
        found = np.stack([np.interp(at, own, curve[:, axis]) for axis in range(3)], axis=1)
        return _directed(found, points[0], start), error
    raise ValueError(
        f"the curve through the points {what}. Where a rope touches or crosses itself the order is "
        f"not known: give its points in order, as many as the {body.num_particles} particles"
    )


def _arc(points: np.ndarray) -> Float[np.ndarray, " M"]:
    """Distances along a curve from its first point."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    return np.concatenate([[0.0], steps.cumsum()])


def _meets_itself(curve: np.ndarray, arc: np.ndarray) -> bool:
    """Whether points are near to each other, and not so along the curve."""
    from scipy.spatial.distance import pdist

    near = NEAR * np.diff(arc).max()
    return bool(((pdist(curve) <= near) & (pdist(arc[:, None]) > FAR * near)).any())


def _through(points: np.ndarray, count: int, aside: float) -> Float[np.ndarray, "_ 3"]:
    """The curve, in order. A cloud denser than the rope is averaged to `count` points first."""
    if len(points) <= THINNED * count:
        return points[_path(points, aside)]
    from scipy.cluster.vq import kmeans2

    centres, label = kmeans2(points, count, iter=20, minit="++", rng=np.random.default_rng(0))
    curve = centres[np.bincount(label, minlength=count) > 0]
    curve = curve[_path(curve, aside)]
    # An average lies inside its points: the ends are half a spacing further out.
    ends = [_end(points, *curve[pair]) for pair in ([0, 1], [-1, -2])]
    return np.stack([ends[0], *curve, ends[1]])


def _end(points: np.ndarray, last: np.ndarray, before: np.ndarray) -> np.ndarray:
    """The last point of a curve moved on as far as there are points."""
    step = last - before
    near = points[np.linalg.norm(points - last, axis=1) <= np.linalg.norm(step)]
    share = ((near - last) @ step).max(initial=0.0) / (step @ step)
    return last + max(share, 1e-6) * step


def _path(points: np.ndarray, aside: float) -> list[int]:
    """Ids along the longest path in the minimum spanning tree, and of points beside it."""
    from scipy.sparse.csgraph import dijkstra, minimum_spanning_tree
    from scipy.spatial.distance import cdist

    distances = cdist(points, points)
    tree = minimum_spanning_tree(distances)
    first = int(dijkstra(tree, directed=False, indices=0).argmax())
    far, before = dijkstra(tree, directed=False, indices=first, return_predecessors=True)
    path = [int(far.argmax())]
    while path[-1] != first:
        path.append(int(before[path[-1]]))
    left = set(range(len(points))) - set(path)
    for point in sorted(left, key=lambda each: float(distances[each, path].min())):
        if distances[point, path].min() <= aside:
            a, b = path[:-1], path[1:]
            longer = distances[a, point] + distances[point, b] - distances[a, b]
            path.insert(1 + int(longer.argmin()), point)
    return path


def _distances(points: np.ndarray, curve: np.ndarray) -> Float[np.ndarray, " M"]:
    """Distance of each point from the segments of a curve."""
    starts, along = curve[:-1], np.diff(curve, axis=0)
    away = points[:, None] - starts[None]
    share = (away * along[None]).sum(axis=2) / np.maximum((along**2).sum(axis=1), 1e-300)
    off = away - np.clip(share, 0.0, 1.0)[..., None] * along[None]
    return np.linalg.norm(off, axis=2).min(axis=1)


def _directed(found: np.ndarray, first: np.ndarray, start: np.ndarray | None) -> Positions:
    """The positions from the one end or from the other."""
    ways = (found, found[::-1])
    if start is None:
        return min(ways, key=lambda each: float(np.linalg.norm(each[0] - first)))
    return min(ways, key=lambda each: float(((each - start) ** 2).sum()))
