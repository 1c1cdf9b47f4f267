"""Goals from files: arrays of positions, or meshes whose points are the body's particles."""

from pathlib import Path

import numpy as np

from jaxsimp.body import Body, from_mesh, rope_along
from jaxsimp.goals.check import check_goal
from jaxsimp.goals.shapes import Positions
from jaxsimp.meshes import read_mesh


def load_goal(path: str | Path, body: Body | None = None) -> tuple[Body, Positions]:
    """A goal from a file, and the body that it is for.

    An `.npz` file holds `positions`, shape (N, 3), metres, and may hold `rest`, the rest
    coordinates, shape (N, 3), or (N, 2) for a flat body, and `faces`, shape (F, 3). A mesh file
    (OBJ, PLY, OFF, GLB, ...) holds the positions as its points, in the body's order: they are
    not welded, and an STL file, which repeats its points, will not match.

    Without a body an `.npz` file defines it, with default physics. With `faces` it is
    `from_mesh(rest, faces)`; without rest coordinates the size of the triangles at rest would
    be unknown, so they are required. Without `faces` it is a rope: at rest along `rest` if that
    is given, and otherwise straight, evenly spread by the median distance of neighbours in the
    goal.

    Args:
        path: of the file.
        body: the one that the goal is for.

    Raises:
        ValueError: if the file cannot be read or lacks what is needed, the body that it defines
            is refused, or the goal is (see `check_goal`).
    """
    try:
        if Path(path).suffix.lower() == ".npz":
            arrays = _read_arrays(path)
        else:
            arrays = {"positions": read_mesh(path)[0]}
            if body is None:
                raise ValueError("a mesh does not say how it is at rest; give the body too")
        positions = _rows_of_three("positions", arrays["positions"])
        made = _body_of(positions, arrays) if body is None else body
        return made, check_goal(made, positions)
    except ValueError as error:
        message = str(error)
        named = message.startswith(str(path))
        raise ValueError(message if named else f"{path}: {message}") from error


def _read_arrays(path: str | Path) -> dict[str, np.ndarray]:
    """The arrays of an `.npz` file that make a goal."""
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in ("positions", "rest", "faces") if name in file}
    except Exception as error:  # np.load raises whatever a broken file makes of it
        raise ValueError(
            f"it cannot be read as .npz ({type(error).__name__}: {error}); write it with "
            f"np.savez(path, positions=positions)"
        ) from error
    if "positions" not in arrays:
        raise ValueError(
            "it has no array 'positions'; write it with np.savez(path, positions=positions)"
        )
    return arrays


def _body_of(positions: np.ndarray, arrays: dict[str, np.ndarray]) -> Body:
    """The body that a file defines."""
    rest = _rows_of_three("rest", arrays["rest"]) if "rest" in arrays else None
    if rest is not None and len(rest) != len(positions):
        raise ValueError(f"rest has {len(rest)} rows and positions has {len(positions)}")
    if "faces" not in arrays:
        return rope_along(_straight(positions) if rest is None else rest)
    if rest is None:
        raise ValueError(
            "it has faces but no array 'rest', so the body's size at rest is unknown; add rest, "
            "or give the body"
        )
    faces = arrays["faces"]
    if not np.issubdtype(faces.dtype, np.integer):
        raise ValueError(f"faces is of {faces.dtype}; whole numbers are needed, ids of particles")
    body = from_mesh(rest, faces.astype(np.int64))
    if body.num_particles != len(positions):
        raise ValueError(
            f"{len(positions) - body.num_particles} of {len(positions)} particles coincide with "
            f"others at rest, or belong to no triangle; leave them out of rest, faces and positions"
        )
    return body


def _rows_of_three(name: str, array: np.ndarray) -> np.ndarray:
    """Coordinates as floats, with z = 0 where rest coordinates have none."""
    if not (np.issubdtype(array.dtype, np.floating) or np.issubdtype(array.dtype, np.integer)):
        raise ValueError(f"{name} is of {array.dtype}; real numbers are needed, in metres")
    if name == "rest" and array.ndim == 2 and array.shape[1] == 2:
        array = np.concatenate([array, np.zeros((len(array), 1))], axis=1)
    if array.ndim != 2 or array.shape[1] != 3:
        raise ValueError(f"{name} has shape {array.shape}; one row of x, y, z a particle is needed")
    return array.astype(float)


def _straight(positions: np.ndarray) -> np.ndarray:
    """A straight rope along x with the median distance of a goal's neighbours."""
    if len(positions) < 2:
        raise ValueError(f"positions has {len(positions)} rows; a rope has at least 2 particles")
    spacing = np.median(np.linalg.norm(np.diff(positions, axis=0), axis=1))
    if not 0 < spacing < np.inf:
        raise ValueError(
            f"the median distance of neighbours in positions is {spacing:g} m; give particles "
            f"that are apart, in order along the rope"
        )
    x = spacing * np.arange(len(positions))
    return np.stack([x, np.zeros_like(x), np.zeros_like(x)], axis=1)
