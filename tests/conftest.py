"""What every test shares: strict numerics, no display, and the house's Hypothesis profile."""

import atexit
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import jax
import jaxlib
import jaxtyping
import matplotlib
import pytest
from hypothesis import HealthCheck, settings
from matplotlib.figure import Figure

matplotlib.use("Agg")

# Most of the time of a test goes into compilation. Little optimisation and XLA's older emitters
# make of the same operations other machine code in less than half of it; what it gives differs by
# rounding. `JAXSIMP_OPTIMISED=1` leaves XLA as users have it, as `.ci/run` does for tests of layers
# that touch. A flag that an XLA does not know ends the process.
QUICK = "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"
if not os.environ.get("JAXSIMP_OPTIMISED"):
    jax.config.update("jax_disable_most_optimizations", True)
    os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = "true"  # for processes that tests start
    if jaxlib.version.__version_info__ < (0, 11):
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {QUICK}".strip()

if not os.environ.get("JAXSIMP_GPU"):
    jax.config.update("jax_platforms", "cpu")
jax.config.update("jax_numpy_rank_promotion", "raise")
# Many programs were compiled before: by another planner, an earlier test or the process that
# started this one. They are kept for as long as this process lives, in a folder of its own, since
# JAX does not write them in one piece. A test that passes must not owe it to what an
# earlier run left on disk.
programs = tempfile.mkdtemp(prefix="jaxsimp-tests-")
atexit.register(shutil.rmtree, programs, ignore_errors=True)
KEPT = {
    "jax_compilation_cache_dir": programs,
    "jax_persistent_cache_min_compile_time_secs": 0.0,
    "jax_persistent_cache_min_entry_size_bytes": 0,
}
for name, value in KEPT.items():
    jax.config.update(name, value)
    os.environ[name.upper()] = str(value)

settings.register_profile(
    "house",
    deadline=None,  # the first example compiles
    derandomize="CI" in os.environ,
    max_examples=25,
    # The fixtures below set a mode and hold no state, so examples may share them.
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
settings.load_profile("house")


@pytest.hookimpl(tryfirst=True)
def pytest_cmdline_main(config: pytest.Config) -> None:
    """With workers: each takes its share in order, and from the others when it has done it.

    Tests of a file stay together, and with them what they share; both work to the end.
    """
    if getattr(config.option, "numprocesses", None) and config.option.dist == "no":
        config.option.dist = "worksteal"


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


@pytest.fixture(scope="session", autouse=True)
def coarse_figures() -> Iterator[None]:
    """Figures are written with few dots: nobody looks at them, and most of the time is the dots."""
    plain = Figure.savefig

    def savefig(self: Figure, path: str | Path, **options: object) -> None:
        plain(self, path, **(options | {"dpi": 20}))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", savefig)
        yield


@pytest.fixture(scope="session")
def figures_saved(coarse_figures: None) -> Callable[[], AbstractContextManager[dict[str, Figure]]]:
    """A context that collects the figures written in it, by the names of their files.

    What a figure shows is in its artists, their data and labels; a file says only that it exists.
    """

    @contextmanager
    def collected() -> Iterator[dict[str, Figure]]:
        figures, plain = {}, Figure.savefig

        def savefig(self: Figure, path: str | Path, **options: object) -> None:
            figures[Path(path).name] = self
            plain(self, path, **options)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Figure, "savefig", savefig)
            yield figures

    return collected
