"""Frames of a scene as mesh files, by trimesh."""

from pathlib import Path
from typing import Any

from jaxsimp.goals import Positions
from jaxsimp.records import whole_file
from jaxsimp.viz.scene import Scene
from jaxsimp.viz.shapes import body_mesh


def save_frames(folder: str | Path, scene: Scene, suffix: str = "obj") -> list[Path]:
    """Write each frame as a mesh `frame_0000.obj`, ...: a sheet's triangles, or a rope's tube.

    The vertices of a sheet are the particles, in their order.

    Args:
        folder: folder for the files; it is made.
        scene: the scene.
        suffix: format that trimesh writes: obj, ply or glb, for three.

    Returns:
        The paths of the files.

    Raises:
        OSError: if a file cannot be written.
    """
    Path(folder).mkdir(parents=True, exist_ok=True)
    frames = scene.trajectory.positions
    digits = max(4, len(str(len(frames) - 1)))
    paths = [Path(folder) / f"frame_{index:0{digits}}.{suffix}" for index in range(len(frames))]
    for path, positions in zip(paths, frames, strict=True):
        save_mesh(path, scene, positions)
    return paths


def save_mesh(path: str | Path, scene: Scene, positions: Positions) -> None:
    """Write positions of a scene's body as a mesh file, in the format of its suffix.

    GLB has y up, as its readers expect.

    Raises:
        OSError: if the file cannot be written.
    """
    made = _trimesh(scene, positions, is_y_up=Path(path).suffix.lower() in (".glb", ".gltf"))
    with whole_file(path) as part:
        made.export(part)


def _trimesh(scene: Scene, positions: Positions, *, is_y_up: bool) -> Any:
    import trimesh

    mesh = body_mesh(scene.body, positions)
    points = mesh.points[:, [1, 2, 0]] if is_y_up else mesh.points
    return trimesh.Trimesh(points, mesh.faces, process=False)
