"""Goals from files: arrays of positions, or meshes whose points are the body's particles."""

import warnings
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from jaxsimp.bodies import MATERIALS, Body, from_mesh, rope_along
from jaxsimp.bodies.mesh_files import load_mesh, read_file, read_mesh
from jaxsimp.bodies.meshes import z_up
from jaxsimp.bodies.size import MOST_TRIANGLES, require_scale, require_size
from jaxsimp.checks import require_count, require_shape, require_whole
from jaxsimp.goals.check import MAX_STRETCH, NOISE, check_goal
from jaxsimp.goals.flatten import flatten
from jaxsimp.goals.registration import register
from jaxsimp.goals.shapes import Positions

SPREAD = 8.0
"""Distance of neighbours above the usual one, in median deviations, that noise explains: 5 are the
most of 1000 steps of any Gaussian noise."""
UNEVEN, NO_ORDER = 1.4, 0.7
"""Longest step over the usual one, and mean step over the mean distance of any two particles: above
both, particles are in no order. Accordions of a rope reach the second with even steps."""

SHUFFLED = 2.0
"""Median distance of the body's neighbours, over that at rest, above which points are in another
order: they are anywhere."""
MOST_NUMBERS = 40_000_000
"""Largest array of frames: 320 MB."""


class _UnfitError(ValueError):
    """What is wrong with an array of a file."""


def load_goal(
    path: str | Path,
    body: Body | None = None,
    *,
    scale: float = 1.0,
    up: str = "z",
    frame: int = -1,
    start: Positions | None = None,
) -> tuple[Body, Positions]:
    """A goal from a file, and its body.

    An `.npz` file holds `positions`, shape (N, 3), metres, and may hold `rest`, the rest
    coordinates, shape (N, 3), or (N, 2) for a flat body, and `faces`, shape (F, 3). An `.npy` file
    holds positions. Positions of several frames have shape (frames, N, 3). A mesh file (OBJ, PLY,
    OFF, GLB, ...) holds the positions as its points.

    With `body` the points may be others than its particles, or in another order, as those of a
    scan or of another mesh: they are registered (see `jaxsimp.goals.register`), and a warning says
    how well they fit.

    Without `body` an `.npz` file defines the body, with default physics. With `faces` it is
    `from_mesh(rest, faces)`; without `rest` it is flat at rest, with the edge lengths of the goal
    (see `jaxsimp.goals.flatten`): accurate to about 1 % of its size where creases lie along edges
    of the triangles, otherwise too short by up to a triangle at each crease. Without `faces` it
    is a rope: at rest along `rest` if given, otherwise straight, evenly spaced by the median
    distance of neighbours in the goal, which must be in order along the rope.

    Args:
        path: path of the file.
        body: body of the goal.
        scale: metres in one unit of the file: 0.001 for millimetres.
        up: axis of the file that points up: "z", "y" or "x".
        frame: which of several frames, counted from 0, or from the end below 0; the last by
            default.
        start: positions at the start, shape (N, 3), metres, which decide between ways to register
            that fit as well.

    Raises:
        ValueError: if the file cannot be read or lacks an array or the frame, if the body that it
            defines or the goal is invalid (see `check_goal`), or its points cannot be registered.
    """
    with _naming(path):
        members = ("positions", "rest", "faces")
        arrays = _read(path, members if body is None else members[:1])
        arrays["positions"] = _one_frame(arrays["positions"], frame)
        positions = _scaled({"positions": arrays["positions"]}, scale, up)["positions"]
        if body is not None and _are_particles(body, positions):
            return body, check_goal(body, positions)
        if body is not None:
            faces = _read(path, ("positions", "faces")).get("faces")
            return body, _registered(path, body, positions, faces, start)
        if not _holds_arrays(path):
            raise ValueError(
                "a mesh does not say how it is at rest; give the body too (body=, or --body)"
            )
        return _with_body(positions, _scaled(arrays, scale, up))


def _one_frame(positions: np.ndarray, frame: int) -> np.ndarray:
    """The positions of a frame, if there are several."""
    if positions.ndim != 3:
        return positions
    count = len(positions)
    require_count("the number of frames", count, 1)
    return positions[require_count("frame", frame, -count, count - 1)]


def _are_particles(body: Body, positions: np.ndarray) -> bool:
    """Whether there is a point for each particle, and neighbours of the body are not anywhere."""
    if len(positions) != body.num_particles:
        return False
    first, second = body.springs[body.families == 0].T
    length = np.linalg.norm(positions[second] - positions[first], axis=1)
    is_large = np.ptp(positions, axis=0).max() > MAX_STRETCH * body.size
    rest = body.rest_length[body.families == 0]
    return bool(is_large or np.median(length / rest) <= SHUFFLED)


def _registered(
    path: str | Path,
    body: Body,
    points: np.ndarray,
    faces: np.ndarray | None,
    start: Positions | None,
) -> Positions:
    """The goal of a file whose points are not the body's particles, with a word of it."""
    found = register(body, points, faces, start=start)
    warnings.warn(
        f"{path}: its {len(points)} points are not the {body.num_particles} particles of the "
        f"{body.name} in their order, and were registered to them, within {found.error:.2g} m; "
        f"{found.num_alike} ways fit as well, and the nearest to the start was taken",
        stacklevel=4,
    )
    return found.positions


def load_body(path: str | Path, *, scale: float = 1.0, up: str | None = None) -> Body:
    """A body from a file, with default physics.

    An `.npz` file holds `rest`, shape (N, 3), or (N, 2) for a flat body, metres, and for a sheet
    `faces`, shape (F, 3); without `faces` the body is a rope, as from an `.npy` file of `rest`. Any
    other file is a mesh at rest (OBJ, PLY, STL, OFF, GLB, ...), in metres, which
    `jaxsimp.bodies.clean_mesh` cleans.

    Args:
        path: path of the file.
        scale: metres in one unit of the file: 0.001 for millimetres.
        up: axis of the file that points up, as for `jaxsimp.load_mesh`.

    Raises:
        ValueError: if the file cannot be read or lacks an array, or the body is invalid.
    """
    with _naming(path):
        if not _holds_arrays(path):
            return from_mesh(*load_mesh(path, scale=scale, up=up))
        arrays = _scaled(_read(path, ("rest", "faces")), scale, up or "z")
        return _body_of(arrays["rest"], arrays)


def _holds_arrays(path: str | Path) -> bool:
    return Path(path).suffix.lower() in (".npz", ".npy")


@contextmanager
def _naming(path: str | Path) -> Iterator[None]:
    """Put the path before the message of an error that does not name it."""
    try:
        yield
    except ValueError as error:
        message = str(error)
        named = message.startswith(str(path))
        raise ValueError(message if named else f"{path}: {message}") from error


def _read(path: str | Path, members: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Those arrays of a file that it has; the first is needed."""
    needed = members[0]
    if not _holds_arrays(path):
        return dict(zip((needed, "faces"), read_mesh(path), strict=True))
    remedy = f"an .npz file, written with np.savez(path, {needed}={needed})"
    data = BytesIO(read_file(path, remedy))
    if Path(path).suffix.lower() == ".npy":
        return {needed: _read_array(needed, data)}
    try:
        with zipfile.ZipFile(data) as archive:
            names = archive.namelist()
            held = [name for name in members if f"{name}.npy" in names]
            # The header says how large an array is before it is unpacked.
            arrays = {}
            for name in held:
                with archive.open(f"{name}.npy") as member:
                    arrays[name] = _read_array(name, member)
    except _UnfitError:
        raise
    except Exception as error:  # the readers raise many kinds of errors on a broken file
        raise ValueError(f"it is damaged, or is no .npz file; give {remedy}") from error
    if needed not in arrays:
        told = ", ".join(name.removesuffix(".npy") for name in names[:8]) or "none"
        raise ValueError(f"it has no array {needed!r} (it has {told}); give {remedy}")
    return arrays


def _read_array(name: str, file: Any) -> np.ndarray:
    """An array in NumPy's format, if its header says that it holds not too many numbers."""
    header = BytesIO(file.read(2**16))
    try:
        version = np.lib.format.read_magic(header)
        read = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }[version]
        shape, in_columns, dtype = read(header)
    except Exception as error:  # the reader raises many kinds of errors
        raise _UnfitError(
            f"{name} is no array in NumPy's format; write it with np.savez(path, {name}={name})"
        ) from error
    if dtype.kind not in "fiu":
        raise _UnfitError(f"{name} is of {dtype}; give an array of real numbers")
    count = int(np.prod(shape, dtype=object))
    if int(np.prod(shape[-2:], dtype=object)) > 3 * MOST_TRIANGLES:
        raise _UnfitError(
            f"{name} has shape {shape}; a body has {MOST_TRIANGLES // 2} particles at most: "
            f"give fewer"
        )
    if count > MOST_NUMBERS:
        raise _UnfitError(
            f"{name} has shape {shape}; {MOST_NUMBERS} numbers are the limit: give fewer frames"
        )
    rest = count * dtype.itemsize - (len(header.getvalue()) - header.tell())
    held = header.read() + (file.read(rest) if rest > 0 else b"")
    if len(held) < count * dtype.itemsize:
        raise _UnfitError(f"{name} is cut short; write the file again")
    array = np.frombuffer(held, dtype, count)
    return array.reshape(shape, order="F" if in_columns else "C")


def _scaled(arrays: dict[str, np.ndarray], scale: float, up: str) -> dict[str, np.ndarray]:
    """Coordinates as floats in metres, z up, and triangles as whole numbers."""
    scale = require_scale(scale)
    made = {}
    for name, array in arrays.items():
        if name == "faces":
            made[name] = require_whole(name, array)
        elif name == "rest" and array.ndim == 2 and array.shape[1] == 2:
            made[name] = scale * _rows_of_three(name, _in_three(array))
        else:
            made[name] = scale * z_up(_rows_of_three(name, array), up)
    return made


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
    rest = arrays.get("rest")
    if rest is not None and len(rest) != len(positions):
        raise ValueError(
            f"rest has {len(rest)} rows and positions has {len(positions)}; give one row for each "
            f"particle in both"
        )
    if "faces" not in arrays:
        return rope_along(_straight(positions) if rest is None else rest)
    faces = arrays["faces"]
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
    """Coordinates as floats."""
    require_shape(name, array, ("N", 3), "one row of x, y, z for each particle")
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
        raise ValueError(
            f"positions has {len(positions)} rows; a rope has at least 2 particles: give more, or "
            f"add faces"
        )
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    spacing = np.median(steps)
    if not spacing > 0:
        raise ValueError(
            f"the median distance of neighbours in positions is {spacing:g} m; give particles "
            f"that are apart, in order along the rope"
        )
    require_size("the largest extent of positions", np.ptp(positions, axis=0).max(), smallest=0.0)
    _check_order(positions, steps)
    x = spacing * np.arange(len(positions))
    return np.stack([x, np.zeros_like(x), np.zeros_like(x)], axis=1)


def _check_order(positions: np.ndarray, steps: np.ndarray) -> None:
    """Raise a `ValueError` for particles that are not in order along an evenly spaced rope.

    Steps between neighbours are even, up to creases, which shorten them, to noise, and to a lift
    over another part of the rope. Without an order neighbours are as far apart as any two.
    """
    from scipy.spatial.distance import pdist

    usual, longest = float(np.median(steps)), int(steps.argmax())
    noise = SPREAD * float(np.median(np.abs(steps - usual)))
    noise += NOISE * float(np.ptp(positions, axis=0).max()) + MATERIALS["rope"].thickness
    jumps = steps[longest] > MAX_STRETCH * usual + noise
    some = np.linspace(0, len(positions) - 1, min(len(positions), 500)).round().astype(int)
    any_two = float(pdist(positions[some]).mean())
    lost = steps.mean() > NO_ORDER * any_two and steps[longest] > UNEVEN * usual
    if jumps or lost:
        raise ValueError(
            f"positions are in no order along a rope: particles {longest} and {longest + 1} are "
            f"{steps[longest]:.3g} m apart, neighbours usually {usual:.3g} m, any two particles "
            f"{any_two:.3g} m. Add faces for a sheet, rest for a rope with uneven particles, or "
            f"give the body (body=, or --body)"
        )
