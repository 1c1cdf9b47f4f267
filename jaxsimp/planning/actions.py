"""Encodings: how the distribution that CEM searches with is turned into actions.

Both encodings draw, for each action and picker, a *choice* among the K candidates or None,
and a displacement within the limits. They share one interface: `init`, `sample`, `decode`,
`update`; distributions and samples are pytrees, and all functions are pure.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from jaxsimp.dynamics import NONE, Actions


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["candidates", "limits"],
    meta_fields=["num_actions", "num_pickers"],
)
@dataclass(frozen=True)
class ActionSpace:
    """The plans that may be searched.

    Attributes:
        candidates: ids of the particles that may be grasped, shape (K,).
        limits: largest displacement of one action along x, y, z, shape (3,), metres.
        num_actions: `T`, static.
        num_pickers: `G`, static.
    """

    candidates: Int[Array, " K"]
    limits: Float[Array, " 3"]
    num_actions: int
    num_pickers: int

    def actions(self, choice: Int[Array, "*B T G"], direction: Float[Array, "*B T G 3"]) -> Actions:
        """The actions of choices (K means None) and displacements in units of the limits."""
        ids = jnp.append(self.candidates, NONE)
        limits = jnp.broadcast_to(self.limits, direction.shape)
        return Actions(ids[choice], direction * limits)


@runtime_checkable
class Encoding(Protocol):
    """What CEM needs to know of a distribution over plans."""

    @property
    def name(self) -> str:
        """What it is called in `ENCODINGS`."""
        ...

    def init(self, space: ActionSpace, spread: float) -> PyTree[Any]:
        """The distribution before any sample; `spread` is the deviation of displacements."""
        ...

    def sample(
        self, space: ActionSpace, distribution: PyTree[Any], key: PRNGKeyArray, num: int
    ) -> PyTree[Any]:
        """Draw `num` samples, leading axis `num` on every leaf."""
        ...

    def decode(self, space: ActionSpace, sample: PyTree[Any]) -> Actions:
        """The actions of one sample, or of samples along leading axes."""
        ...

    def update(
        self, space: ActionSpace, distribution: PyTree[Any], elites: PyTree[Any], smoothing: float
    ) -> PyTree[Any]:
        """Fit to the elites, keeping the share `smoothing` of the distribution before."""
        ...

    def mean(self, space: ActionSpace, distribution: PyTree[Any]) -> PyTree[Any]:
        """The sample at the centre of the distribution."""
        ...


@partial(jax.tree_util.register_dataclass, data_fields=["mean", "spread"], meta_fields=[])
@dataclass(frozen=True)
class Gaussian:
    """Independent normal distributions: means and standard deviations of any one shape."""

    mean: Float[Array, "*shape"]
    spread: Float[Array, "*shape"]

    def sample(self, key: PRNGKeyArray, num: int) -> Float[Array, "num *shape"]:
        """Draws clipped to [-1, 1]."""
        noise = jax.random.normal(key, (num, *self.mean.shape))
        return jnp.clip(self.mean[None] + self.spread[None] * noise, -1.0, 1.0)

    def update(self, elites: Float[Array, "E *shape"], smoothing: float) -> "Gaussian":
        """Towards the mean and deviation of the elites."""
        return Gaussian(
            _blend(self.mean, elites.mean(axis=0), smoothing),
            _blend(self.spread, elites.std(axis=0), smoothing),
        )


@dataclass(frozen=True)
class GaussianIndex:
    """The paper's encoding: a Gaussian over (dx, dy, dz, g) in [-1, 1], `g` a grasped index.

    `g` is mapped linearly to [0, K + 1] and floored: k < K grasps candidate k, K is None
    (SoftAgent's pick-and-place encoding, as run by the paper's author).
    """

    name: str = "gaussian_index"

    def init(self, space: ActionSpace, spread: float) -> Gaussian:
        """Mean 0, the given deviation in all four coordinates."""
        shape = (space.num_actions, space.num_pickers, 4)
        return _centred(shape, spread)

    def sample(
        self, space: ActionSpace, distribution: Gaussian, key: PRNGKeyArray, num: int
    ) -> Float[Array, "num T G 4"]:
        """Draws in [-1, 1]."""
        return distribution.sample(key, num)

    def decode(self, space: ActionSpace, sample: Float[Array, "*B T G 4"]) -> Actions:
        """Floor the index; scale the displacement."""
        count = len(space.candidates)
        index = jnp.floor((sample[..., 3] + 1.0) / 2.0 * (count + 1)).astype(int)
        return space.actions(jnp.clip(index, 0, count), sample[..., :3])

    def update(
        self,
        space: ActionSpace,
        distribution: Gaussian,
        elites: Float[Array, "E T G 4"],
        smoothing: float,
    ) -> Gaussian:
        """Moments of the elites."""
        return distribution.update(elites, smoothing)

    def mean(self, space: ActionSpace, distribution: Gaussian) -> Float[Array, "T G 4"]:
        """The mean vector."""
        return distribution.mean


@partial(
    jax.tree_util.register_dataclass, data_fields=["frequency", "displacement"], meta_fields=[]
)
@dataclass(frozen=True)
class ChoiceAndGaussian:
    """A categorical distribution of choices beside a Gaussian of displacements.

    Attributes:
        frequency: of each candidate, and of None, shape (T, G, K + 1).
        displacement: in units of the limits, shape (T, G, 3).
    """

    frequency: Float[Array, "T G K1"]
    displacement: Gaussian


@dataclass(frozen=True)
class Categorical:
    """Elite frequencies over the candidates and None, and a Gaussian over displacements."""

    name: str = "categorical"

    def init(self, space: ActionSpace, spread: float) -> ChoiceAndGaussian:
        """Every choice equally likely; displacements of mean 0."""
        shape = (space.num_actions, space.num_pickers)
        choices = len(space.candidates) + 1
        return ChoiceAndGaussian(
            jnp.full((*shape, choices), 1.0 / choices, dtype=float),
            _centred((*shape, 3), spread),
        )

    def sample(
        self, space: ActionSpace, distribution: ChoiceAndGaussian, key: PRNGKeyArray, num: int
    ) -> tuple[Int[Array, "num T G"], Float[Array, "num T G 3"]]:
        """Choices and displacements."""
        key_choice, key_move = jax.random.split(key)
        # By the inverse of the cumulative distribution: one random number a draw, where
        # `jax.random.categorical` takes one a candidate.
        cumulative = jnp.cumsum(distribution.frequency, axis=-1)
        uniform = jax.random.uniform(key_choice, (num, *cumulative.shape[:-1]))
        drawn = (uniform * cumulative[None, ..., -1])[..., None]
        choice = jnp.sum(drawn >= cumulative[None, ..., :-1], axis=-1)
        return choice, distribution.displacement.sample(key_move, num)

    def decode(
        self, space: ActionSpace, sample: tuple[Int[Array, "*B T G"], Float[Array, "*B T G 3"]]
    ) -> Actions:
        """Scale the displacement."""
        return space.actions(*sample)

    def update(
        self,
        space: ActionSpace,
        distribution: ChoiceAndGaussian,
        elites: tuple[Int[Array, "E T G"], Float[Array, "E T G 3"]],
        smoothing: float,
    ) -> ChoiceAndGaussian:
        """Frequencies and moments of the elites."""
        choice, move = elites
        counted = jax.nn.one_hot(choice, len(space.candidates) + 1).mean(axis=0)
        return ChoiceAndGaussian(
            _blend(distribution.frequency, counted, smoothing),
            distribution.displacement.update(move, smoothing),
        )

    def mean(
        self, space: ActionSpace, distribution: ChoiceAndGaussian
    ) -> tuple[Int[Array, "T G"], Float[Array, "T G 3"]]:
        """The likeliest choices with the mean displacements."""
        return distribution.frequency.argmax(axis=-1), distribution.displacement.mean


def _centred(shape: tuple[int, ...], spread: float) -> Gaussian:
    # With a dtype, or the first update would compile for one type and the next for another.
    return Gaussian(jnp.zeros(shape, dtype=float), jnp.full(shape, spread, dtype=float))


def _blend(old: Array, new: Array, smoothing: float) -> Array:
    return smoothing * old + (1.0 - smoothing) * new


ENCODINGS: dict[str, Encoding] = {
    encoding.name: encoding for encoding in (Categorical(), GaussianIndex())
}
"""The pick encodings by name."""
