"""Encodings: distributions over plans, for the cross-entropy method.

An encoding draws, for each action and picker, a *choice* among the K candidates or none, and a
displacement within the limits. Distributions and samples are pytrees, and all functions are pure.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from jaxsimp.checks import keep, require_number
from jaxsimp.planning.space import ActionSpace, Plans


@runtime_checkable
class Encoding(Protocol):
    """A family of distributions over plans, for CEM."""

    @property
    def name(self) -> str:
        """Its name in `ENCODINGS`."""
        ...

    def init(self, space: ActionSpace, spread: float) -> PyTree[Any]:
        """The first distribution; `spread` is the standard deviation of displacements."""
        ...

    def sample(
        self, space: ActionSpace, distribution: PyTree[Any], key: PRNGKeyArray, num: int
    ) -> PyTree[Any]:
        """Draw `num` samples, leading axis `num` on every leaf."""
        ...

    def decode(self, space: ActionSpace, sample: PyTree[Any]) -> Plans:
        """The plan of one sample, or plans of samples along leading axes."""
        ...

    def encode(self, space: ActionSpace, plans: Plans) -> PyTree[Any]:
        """A sample of each plan, along the leading axes of the plans."""
        ...

    def update(
        self, space: ActionSpace, distribution: PyTree[Any], elites: PyTree[Any], smoothing: float
    ) -> PyTree[Any]:
        """Fit to the elites, keeping the fraction `smoothing` of the old distribution."""
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

    def decode(self, space: ActionSpace, sample: Float[Array, "*B T G 4"]) -> Plans:
        """Floor the index."""
        count = len(space.candidates)
        index = jnp.floor((sample[..., 3] + 1.0) / 2.0 * (count + 1)).astype(int)
        return Plans(jnp.clip(index, 0, count), sample[..., :3])

    def encode(self, space: ActionSpace, plans: Plans) -> Float[Array, "*B T G 4"]:
        """The middle of the index's interval."""
        index = (plans.choice + 0.5) / (len(space.candidates) + 1) * 2.0 - 1.0
        return jnp.concatenate([plans.direction, index[..., None]], axis=-1)

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
        frequency: frequency of each candidate, and of None, shape (T, G, K + 1).
        displacement: Gaussian of displacements, in units of the limits, shape (T, G, 3), or one
            for each choice, shape (T, G, K + 1, 3).
    """

    frequency: Float[Array, "T G K1"]
    displacement: Gaussian


class ChoiceAndDirection:
    """Encodings whose samples are plans."""

    def decode(self, space: ActionSpace, sample: Plans) -> Plans:
        """The sample itself."""
        return sample

    def encode(self, space: ActionSpace, plans: Plans) -> Plans:
        """The plans themselves."""
        return plans


@dataclass(frozen=True)
class Categorical(ChoiceAndDirection):
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
    ) -> Plans:
        """Choices and displacements."""
        key_choice, key_move = jax.random.split(key)
        choice = _draw_choices(distribution.frequency, key_choice, num)
        return Plans(choice, distribution.displacement.sample(key_move, num))

    def update(
        self,
        space: ActionSpace,
        distribution: ChoiceAndGaussian,
        elites: Plans,
        smoothing: float,
    ) -> ChoiceAndGaussian:
        """Frequencies and moments of the elites."""
        choice, move = elites.choice, elites.direction
        counted = jax.nn.one_hot(choice, len(space.candidates) + 1).mean(axis=0)
        return ChoiceAndGaussian(
            _blend(distribution.frequency, counted, smoothing),
            distribution.displacement.update(move, smoothing),
        )

    def mean(self, space: ActionSpace, distribution: ChoiceAndGaussian) -> Plans:
        """The likeliest choices with the mean displacements."""
        return Plans(distribution.frequency.argmax(axis=-1), distribution.displacement.mean)


@dataclass(frozen=True)
class Joint(ChoiceAndDirection):
    """Joint distribution of choice and displacement: a Gaussian per candidate in each slot.

    A slot is one action of one picker. A fold of several corners has many orders; with one Gaussian
    for all candidates of a slot, as in `Categorical`, a corner tried there later inherits the
    displacement of another. Candidates with few elites borrow from all elites of the slot
    (shrinkage: `borrowed` counts as that many elites).

    A search that has converged on some folds no longer tries others, so a fraction `fresh` of the
    slots is drawn uniformly from all choices and displacements, whatever the distribution (a
    defensive mixture: Hesterberg, "Weighted average importance sampling and defensive mixture
    distributions", Technometrics, 1995).

    Raises:
        ValueError: if a number is out of its range.
    """

    name: str = "joint"
    borrowed: float = 0.5
    fresh: float = 0.05

    def __post_init__(self) -> None:
        borrowed = require_number("borrowed", self.borrowed, 1e-6, 1e6, "elites")
        keep(self, borrowed=borrowed, fresh=require_number("fresh", self.fresh, 0.0, 1.0))

    def init(self, space: ActionSpace, spread: float) -> ChoiceAndGaussian:
        """Every choice equally likely; displacements of mean 0."""
        shape = (space.num_actions, space.num_pickers, len(space.candidates) + 1)
        frequency = jnp.full(shape, 1.0 / shape[-1], dtype=float)
        return ChoiceAndGaussian(frequency, _centred((*shape, 3), spread))

    def sample(
        self, space: ActionSpace, distribution: ChoiceAndGaussian, key: PRNGKeyArray, num: int
    ) -> Plans:
        """Choices, and displacements of the Gaussians chosen."""
        key_choice, key_move, key_fresh, key_any, key_anywhere = jax.random.split(key, 5)
        choice = _draw_choices(distribution.frequency, key_choice, num)
        gaussian = distribution.displacement
        noise = jax.random.normal(key_move, (*choice.shape, 3))
        move = _of_choice(gaussian.mean, choice) + _of_choice(gaussian.spread, choice) * noise
        fresh = jax.random.bernoulli(key_fresh, self.fresh, choice.shape)
        anything = jax.random.randint(key_any, choice.shape, 0, len(space.candidates) + 1)
        anywhere = jax.random.uniform(key_anywhere, move.shape, minval=-1.0, maxval=1.0)
        choice = jnp.where(fresh, anything, choice)
        return Plans(choice, jnp.where(fresh[..., None], anywhere, jnp.clip(move, -1.0, 1.0)))

    def update(
        self,
        space: ActionSpace,
        distribution: ChoiceAndGaussian,
        elites: Plans,
        smoothing: float,
    ) -> ChoiceAndGaussian:
        """Frequencies of the elites, and moments of those that made each choice."""
        choice, move = elites.choice, elites.direction
        chosen = jax.nn.one_hot(choice, len(space.candidates) + 1, dtype=move.dtype)
        count = chosen.sum(axis=0)[..., None]

        def average(values: Float[Array, "E T G 3"]) -> Float[Array, "T G K1 3"]:
            own = jnp.einsum("etgk,etga->tgka", chosen, values)
            every = values.mean(axis=0)[:, :, None]
            return (own + self.borrowed * every) / (count + self.borrowed)

        mean, square = average(move), average(move**2)
        spread = jnp.sqrt(jnp.maximum(square - mean**2, 0.0))
        gaussian = distribution.displacement
        return ChoiceAndGaussian(
            _blend(distribution.frequency, chosen.mean(axis=0), smoothing),
            Gaussian(
                _blend(gaussian.mean, mean, smoothing), _blend(gaussian.spread, spread, smoothing)
            ),
        )

    def mean(self, space: ActionSpace, distribution: ChoiceAndGaussian) -> Plans:
        """The likeliest choices with their mean displacements."""
        choice = distribution.frequency.argmax(axis=-1)
        return Plans(choice, _of_choice(distribution.displacement.mean, choice[None])[0])


def _draw_choices(
    frequency: Float[Array, "T G K1"], key: PRNGKeyArray, num: int
) -> Int[Array, "num T G"]:
    """Choices by the inverse of the cumulative distribution.

    It takes one random number per draw; `jax.random.categorical` takes one per candidate.
    """
    cumulative = jnp.cumsum(frequency, axis=-1)
    uniform = jax.random.uniform(key, (num, *cumulative.shape[:-1]))
    drawn = (uniform * cumulative[None, ..., -1])[..., None]
    return jnp.sum(drawn >= cumulative[None, ..., :-1], axis=-1)


def _of_choice(
    values: Float[Array, "T G K1 3"], choice: Int[Array, "num T G"]
) -> Float[Array, "num T G 3"]:
    """The values of the choice in each slot."""
    return jnp.take_along_axis(values[None], choice[..., None, None], axis=-2)[..., 0, :]


def _centred(shape: tuple[int, ...], spread: float) -> Gaussian:
    # With a dtype: otherwise the first update compiles for one type and the next for another.
    return Gaussian(jnp.zeros(shape, dtype=float), jnp.full(shape, spread, dtype=float))


def _blend(old: Array, new: Array, smoothing: float) -> Array:
    return smoothing * old + (1.0 - smoothing) * new


ENCODINGS: dict[str, Encoding] = {
    encoding.name: encoding for encoding in (Categorical(), GaussianIndex(), Joint())
}
"""The pick encodings by name."""
