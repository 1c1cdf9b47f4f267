"""Key points: the few particles that a goal makes worth grasping."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int


@dataclass(frozen=True, eq=False)
class KeyPoints:
    """The smallest model that fits a goal, as particles of the body.

    Attributes:
        particles: ids of the key points in ascending order, shape (K,).
        positions: where the model has them in the goal, shape (K, 3), metres.
        elements: the model's segments, shape (K - 1, 2), or triangles, shape (M, 3), as
            indices into `particles`.
        num_particles: number of particles of the body, `N`.
        method: what found them.
        sizes: numbers of key points tried, in ascending order; the last one fits.
        errors: error of the model at each size, metres.
        threshold: error below which a model fits, metres.
    """

    particles: Int[np.ndarray, " K"]
    positions: Float[np.ndarray, "K 3"]
    elements: Int[np.ndarray, "M E"]
    num_particles: int
    method: str
    sizes: tuple[int, ...]
    errors: tuple[float, ...]
    threshold: float

    def __len__(self) -> int:
        return len(self.particles)

    @property
    def mask(self) -> Bool[np.ndarray, " N"]:
        """True at the particles that may be grasped: indexes the particle axis of an action."""
        mask = np.zeros(self.num_particles, dtype=bool)
        mask[self.particles] = True
        return mask
