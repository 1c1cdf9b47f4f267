"""Plan files: a plan and its motion as `.npz`."""

import os
import zipfile
import zlib
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxsimp.dynamics import Actions


def save_plan(path: Path, actions: Actions, positions: Float[np.ndarray, "T2 N 3"]) -> None:
    """Write a plan as `.npz`: it appears under its name whole or not at all.

    Args:
        path: of the file.
        actions: the plan.
        positions: of its execution, see `Execution`.
    """
    part = path.with_name(path.name + ".part")
    with part.open("wb") as file:
        np.savez_compressed(
            file, pick=actions.pick, displacement=actions.displacement, positions=positions
        )
    os.replace(part, path)


def load_plan(path: Path) -> tuple[Actions, dict[str, Any]]:
    """Read a plan written by `save_plan`: its actions, and all arrays by name.

    Raises:
        ValueError: if the file holds no plan.
    """
    try:
        with path.open("rb") as file:
            arrays = dict(np.load(file))
    except (ValueError, EOFError, TypeError, zipfile.BadZipFile, zlib.error) as error:
        raise ValueError(f"{path} cannot be read ({error}); it is not a saved plan") from error
    missing = {"pick", "displacement", "positions"} - arrays.keys()
    if missing:
        raise ValueError(f"{path} has no {', '.join(sorted(missing))}; it is not a saved plan")
    return Actions(jnp.asarray(arrays["pick"]), jnp.asarray(arrays["displacement"])), arrays
