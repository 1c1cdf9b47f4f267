"""What every test shares: strict numerics, no display, and the house's Hypothesis profile."""

import os
from collections.abc import Iterator

import jax
import jaxtyping
import matplotlib
import pytest
from hypothesis import HealthCheck, settings

matplotlib.use("Agg")

jax.config.update("jax_platforms", "cpu")
jax.config.update("jax_numpy_rank_promotion", "raise")
# A test that passes must not owe it to what an earlier run left on disk.
jax.config.update("jax_enable_compilation_cache", False)

settings.register_profile(
    "house",
    deadline=None,  # the first example compiles
    derandomize="CI" in os.environ,
    max_examples=25,
    # The fixtures below set a mode and hold no state, so examples may share them.
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
settings.load_profile("house")


@pytest.fixture
def x64() -> Iterator[None]:
    """Float64 for the length of the test: for oracles, gradients and convergence orders."""
    with jax.enable_x64(True):
        yield


@pytest.fixture
def rank_promotion() -> Iterator[None]:
    """Rank promotion allowed: for code of other libraries that relies on it."""
    with jax.numpy_rank_promotion("allow"):
        yield


@pytest.fixture
def unchecked_shapes() -> Iterator[None]:
    """No jaxtyping: for tests that the code itself refuses an array of the wrong shape.

    Everywhere else the annotations are checked first, and raise `jaxtyping.TypeCheckError`
    before the code sees its arguments.
    """
    before = jaxtyping.config.jaxtyping_disable
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", before)
