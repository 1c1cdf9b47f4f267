"""Goals from files: arrays of positions, or meshes whose points are the body's particles."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from jaxsimp.bodies import Body, from_mesh, rope_along
from jaxsimp.bodies.mesh_files import load_mesh, read_mesh
from jaxsimp.goals.check import check_goal
from jaxsimp.goals.flatten import flatten
from jaxsimp.goals.shapes import Positions


def load_goal(path: str | Path, body: Body | None = None) -> tuple[Body, Positions]:
    """A goal from a file, and its body.

    An `.npz` file holds `positions`, shape (N, 3), metres, and may hold `rest`, the rest
    coordinates, shape (N, 3), or (N, 2) for a flat body, and `faces`, shape (F, 3). A mesh file
    (OBJ, PLY, OFF, GLB, ...) holds the positions as its points, in the body's order. Points are
    not welded, so an STL file, which repeats its points, does not match.

    Without `body` an `.npz` file defines the body, with default physics. With `faces` it is
    `from_mesh(rest, faces)`; without `rest` it is flat at rest, with the edge lengths of the goal
    (see `jaxsimp.goals.flatten`): accurate to about 1 % of its size where creases lie along edges
    of the triangles, otherwise too short by up to a triangle at each crease. Without `faces` it
    is a rope: at rest along `rest` if given, otherwise straight, evenly spaced by the median
    distance of neighbours in the goal.

    Args:
        path: path of the file.
        body: body of the goal.

    Raises:
        ValueError: if the file cannot be read or lacks an array, or if the body that it defines
            or the goal is invalid (see `check_goal`).
    """
    with _naming(path):
        if _is_npz(path):
            arrays = _read_arrays(path, "positions")
        else:
            arrays = {"positions": read_mesh(path)[0]}
            if body is None:
                raise ValueError("a mesh does not say how it is at rest; give the body too")
        positions = _rows_of_three("positions", arrays["positions"])
        if body is not None:
            return body, check_goal(body, positions)
        return _with_body(positions, arrays)


def load_body(path: str | Path) -> Body:
    """A body from a file, with default physics.

    An `.npz` file holds `rest`, shape (N, 3), or (N, 2) for a flat body, metres, and for a sheet
    `faces`, shape (F, 3); without `faces` the body is a rope. Any other file is a mesh at rest
    (OBJ, PLY, STL, OFF, GLB, ...), in metres, which `jaxsimp.bodies.clean_mesh` cleans.

    Args:
        path: path of the file.

    Raises:
        ValueError: if the file cannot be read or lacks an array, or the body is invalid.
    """
    with _naming(path):
        if not _is_npz(path):
            return from_mesh(*load_mesh(path))
        arrays = _read_arrays(path, "rest")
        return _body_of(_rows_of_three("rest", arrays["rest"]), arrays)


def _is_npz(path: str | Path) -> bool:
    return Path(path).suffix.lower() == ".npz"


@contextmanager
def _naming(path: str | Path) -> Iterator[None]:
    """Put the path before the message of an error that does not name it."""
    try:
        yield
    except ValueError as error:
        message = str(error)
        named = message.startswith(str(path))
        raise ValueError(message if named else f"{path}: {message}") from error


def _read_arrays(path: str | Path, needed: str) -> dict[str, np.ndarray]:
    """The arrays of an `.npz` file that define a goal or a body."""
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in ("positions", "rest", "faces") if name in file}
    except Exception as error:  # np.load raises many kinds of errors on a broken file
        raise ValueError(
            f"it cannot be read as .npz ({type(error).__name__}: {error}); write it with "
            f"np.savez(path, {needed}={needed})"
        ) from error
    if needed not in arrays:
        raise ValueError(
            f"it has no array {needed!r}; write it with np.savez(path, {needed}={needed})"
        )
    return arrays


def _with_body(positions: np.ndarray, arrays: dict[str, np.ndarray]) -> tuple[Body, Positions]:
    """The body that a file defines, and its goal."""
    body = _body_of(positions, arrays)
    try:
        return body, check_goal(body, positions)
    except ValueError as error:
        if "rest" in arrays or "faces" not in arrays:
            raise
        raise ValueError(
            f"{error}. The body was laid flat from this goal, and is too small if creases run "
            f"across its triangles: add rest, or give the body"
        ) from error


def _body_of(positions: np.ndarray, arrays: dict[str, np.ndarray]) -> Body:
    """The body that a file defines."""
    rest = _rows_of_three("rest", arrays["rest"]) if "rest" in arrays else None
    if rest is not None and len(rest) != len(positions):
        raise ValueError(f"rest has {len(rest)} rows and positions has {len(positions)}")
    if "faces" not in arrays:
        return rope_along(_straight(positions) if rest is None else rest)
    faces = arrays["faces"]
    if not np.issubdtype(faces.dtype, np.integer):
        raise ValueError(f"faces is of {faces.dtype}; whole numbers are needed, ids of particles")
    faces = faces.astype(np.int64)
    if rest is None:
        rest = _in_three(flatten(positions, faces))
    body = from_mesh(rest, faces)
    if body.num_particles != len(positions):
        raise ValueError(
            f"{len(positions) - body.num_particles} of {len(positions)} particles coincide with "
            f"others at rest, or belong to no triangle; leave them out of rest, faces and positions"
        )
    return body


def _rows_of_three(name: str, array: np.ndarray) -> np.ndarray:
    """Coordinates as floats, with z = 0 for flat rest coordinates."""
    if not (np.issubdtype(array.dtype, np.floating) or np.issubdtype(array.dtype, np.integer)):
        raise ValueError(f"{name} is of {array.dtype}; real numbers are needed, in metres")
    if name == "rest" and array.ndim == 2 and array.shape[1] == 2:
        array = _in_three(array)
    if array.ndim != 2 or array.shape[1] != 3:
        raise ValueError(f"{name} has shape {array.shape}; one row of x, y, z a particle is needed")
    bad = np.flatnonzero(~np.isfinite(array).all(axis=1))
    if bad.size:
        raise ValueError(
            f"{name} of particle {bad[0]} is {array[bad[0]].tolist()} ({bad.size} such "
            f"particles); give finite coordinates in metres"
        )
    return array.astype(float)


def _in_three(flat: np.ndarray) -> np.ndarray:
    """Flat coordinates with z = 0."""
    return np.concatenate([flat, np.zeros((len(flat), 1))], axis=1)


def _straight(positions: np.ndarray) -> np.ndarray:
    """A straight rope along x with the median distance of a goal's neighbours."""
    if len(positions) < 2:
        raise ValueError(f"positions has {len(positions)} rows; a rope has at least 2 particles")
    spacing = np.median(np.linalg.norm(np.diff(positions, axis=0), axis=1))
    if not spacing > 0:
        raise ValueError(
            f"the median distance of neighbours in positions is {spacing:g} m; give particles "
            f"that are apart, in order along the rope"
        )
    x = spacing * np.arange(len(positions))
    return np.stack([x, np.zeros_like(x), np.zeros_like(x)], axis=1)
