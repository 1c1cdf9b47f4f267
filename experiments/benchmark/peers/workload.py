"""The workload of every engine: a population of rollouts that needs no rule of grasping.

The plans are drawn so that no limit, table or stretch rule of the pickers binds: an engine only
has to carry the picked particles along their displacements.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, Shaped

from jaxsimp.bodies import Body, cloth, rope
from jaxsimp.dynamics import largest_time_step

GRAVITY = 9.81
"""Downward acceleration, metres per second squared."""
CARRYING_SPEED = 0.2
"""Largest mean speed of a picker along an axis, metres per second."""


class UnavailableError(Exception):
    """An engine cannot run here; the message says why."""


@dataclass(frozen=True, eq=False)
class Workload:
    """A population of rollouts of a body that starts flat on the table.

    Attributes:
        body: the body.
        time_step: time step, seconds.
        action_steps: number of time steps of one action.
        pick: ids of the particles carried, shape (B, T, G), none twice in an action.
        displacement: displacements of the pickers, shape (B, T, G, 3), metres, not downwards, and
            the same for all pickers of an action.
    """

    body: Body
    time_step: float
    action_steps: int
    pick: Int[np.ndarray, "B T G"]
    displacement: Float[np.ndarray, "B T G 3"]

    @property
    def population(self) -> int:
        """Number of rollouts, `B`."""
        return len(self.pick)

    @property
    def particle_steps(self) -> int:
        """Time steps of all particles of all rollouts."""
        num_actions = self.pick.shape[1]
        return self.population * num_actions * self.action_steps * self.body.num_particles

    @property
    def start(self) -> Float[np.ndarray, "N 3"]:
        """Positions at the start, metres."""
        return self.body.rest + np.array([0.0, 0.0, self.body.radius])

    @property
    def shares(self) -> Float[np.ndarray, " steps"]:
        """Fraction of a displacement in each step of an action: the parabola of jaxsimp."""
        middle = (np.arange(self.action_steps) + 0.5) / self.action_steps
        speed = middle * (1 - middle)
        return speed / speed.sum()

    @property
    def shortest(self) -> float:
        """Length below which the direction of a spring is regularised, metres."""
        return 1e-3 * self.body.spacing


def make_workload(
    body: Body, population: int, num_actions: int = 4, action_steps: int = 150, seed: int = 0
) -> Workload:
    """Rollouts with two pickers, at nine tenths of the largest stable time step, at most 2 ms.

    Args:
        body: the body.
        population: number of rollouts, `B`.
        num_actions: number of actions in each, `T`.
        action_steps: number of time steps of one action.
        seed: seed of the plans.
    """
    random = np.random.default_rng(seed)
    time_step = min(2e-3, 0.9 * largest_time_step(body))
    count, shape = body.num_particles, (population, num_actions)
    first = random.integers(0, count, shape)
    second = (first + random.integers(1, count, shape)) % count
    reach = CARRYING_SPEED * action_steps * time_step
    move = random.uniform((-reach, -reach, 0.0), reach, (*shape, 1, 3))
    return Workload(
        body=body,
        time_step=time_step,
        action_steps=action_steps,
        pick=np.stack([first, second], axis=-1).astype(np.int32),
        displacement=np.repeat(move, 2, axis=2).astype(np.float32),
    )


def make_body(kind: str, side: int) -> Body:
    """A body for measurements.

    Args:
        kind: "rope", "cloth", or "unstructured": the cloth with its particles in random order,
            like the springs of a triangle mesh.
        side: number of particles along the rope or along a side of the cloth.
    """
    if kind == "rope":
        return rope(side)
    body = cloth((side, side))
    return body if kind == "cloth" else shuffled(body)


def shuffled(body: Body, seed: int = 0) -> Body:
    """The same body with its particles in random order."""
    order = np.random.default_rng(seed).permutation(body.num_particles)
    rank = np.argsort(order)
    return Body(
        name=f"shuffled {body.name}",
        rest=body.rest[order],
        mass=body.mass[order],
        springs=rank[body.springs],
        families=body.families,
        rest_length=body.rest_length,
        stiffness=body.stiffness,
        damping=body.damping,
        faces=rank[body.faces],
        material=body.material,
        shape=(body.num_particles,),
    )


@dataclass(frozen=True, eq=False)
class Offsets:
    """The springs of a body by the offset `j - i` of their ends; entries without one are zero.

    Attributes:
        offsets: distinct offsets, ascending, shape (D,).
        stiffness: stiffness of the spring from `i` to `i + offsets[d]`, shape (D, N), newtons per
            metre.
        damping: damping coefficients, shape (D, N), newton-seconds per metre.
        rest_length: rest lengths, shape (D, N), metres.
    """

    offsets: Int[np.ndarray, " D"]
    stiffness: Float[np.ndarray, "D N"]
    damping: Float[np.ndarray, "D N"]
    rest_length: Float[np.ndarray, "D N"]


def by_offset(body: Body) -> Offsets:
    """The springs of a body by offset: few rows for a rope or a grid, many for other bodies."""
    low, high = body.springs.min(axis=1), body.springs.max(axis=1)
    offsets, row = np.unique(high - low, return_inverse=True)

    def table(values: np.ndarray) -> np.ndarray:
        filled = np.zeros((len(offsets), body.num_particles))
        filled[row, low] = values
        return filled

    return Offsets(offsets, table(body.stiffness), table(body.damping), table(body.rest_length))


def sorted_springs(body: Body) -> tuple[Int[np.ndarray, "S 2"], Float[np.ndarray, "S 3"]]:
    """Ends of the springs, in the order of particles for memory locality, and their parameters.

    The parameters are stiffness, newtons per metre, damping, newton-seconds per metre, and the
    force stiffness * rest length, newtons.
    """
    order = np.lexsort(np.sort(body.springs, axis=1).T[::-1])
    numbers = (body.stiffness, body.damping, body.stiffness * body.rest_length)
    return body.springs[order], np.stack(numbers, axis=-1)[order]


def in_lanes(plans: Shaped[np.ndarray, "B T *rest"], lanes: int) -> Shaped[np.ndarray, "..."]:
    """Plans of blocks of `lanes` samples, shape (blocks, T, lanes, *rest); the last is repeated."""
    blocks = -(-len(plans) // lanes)
    filled = plans[np.minimum(np.arange(blocks * lanes), len(plans) - 1)]
    return filled.reshape(blocks, lanes, *plans.shape[1:]).swapaxes(1, 2)


def from_lanes(
    positions: Float[np.ndarray, "blocks N 3 lanes"], population: int
) -> Float[np.ndarray, "B N 3"]:
    """Positions by sample, without those of repeated plans."""
    by_sample = np.moveaxis(positions, -1, 1)
    return by_sample.reshape(-1, *by_sample.shape[2:])[:population]
