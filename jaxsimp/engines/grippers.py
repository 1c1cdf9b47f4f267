"""Waypoints: where grippers are, when, and whether they hold, for a robot to follow.

Times are those of the plan, in which a picker lets go and grasps elsewhere at once; a robot takes
its own time on the way.
"""

from itertools import combinations
from typing import NamedTuple

import numpy as np

from jaxsimp.dynamics import NONE
from jaxsimp.engines.trajectory import Trajectory, grasps


class Waypoint(NamedTuple):
    """Where a gripper is at a time.

    Attributes:
        time: seconds.
        picker: number of the picker, from 0.
        x: metres.
        y: metres.
        z: metres, with z up.
        gripper: "closed", or "open" where it has just let go.
        particle: particle that it holds, or lets go.
    """

    time: float
    picker: int
    x: float
    y: float
    z: float
    gripper: str
    particle: int


def waypoints(trajectory: Trajectory) -> list[Waypoint]:
    """A waypoint for each frame in which a picker holds a particle or lets it go, by time.

    At one time a picker first lets go, and then grasps.
    """
    found = []
    for picker, begin, end in grasps(trajectory):
        particle = int(trajectory.held[begin, picker])
        for frame in range(begin, end + 1):
            x, y, z = map(float, trajectory.positions[frame, particle])
            gripper = "open" if frame == end else "closed"
            time = float(trajectory.times[frame])
            found.append(Waypoint(time, picker, x, y, z, gripper, particle))
    return sorted(found, key=lambda each: (each.time, each.picker, each.gripper == "closed"))


def least_distance(trajectory: Trajectory) -> float | None:
    """Least distance of two grippers that hold particles at one time, metres; None without such.

    Between frames it is that of their straight paths.
    """
    found = []
    for first, second in combinations(range(trajectory.held.shape[1]), 2):
        for frame, (a, b) in enumerate(trajectory.held[:, [first, second]]):
            if NONE not in (a, b):
                before, after = (
                    trajectory.positions[k, a] - trajectory.positions[k, b]
                    for k in (frame, frame + 1)
                )
                found.append(_nearest(before, after))
    return min(found, default=None)


def _nearest(start: np.ndarray, end: np.ndarray) -> float:
    """Distance of a segment from the origin."""
    way = end - start
    share = np.clip(-(start @ way) / max(float(way @ way), 1e-30), 0.0, 1.0)
    return float(np.linalg.norm(start + share * way))
