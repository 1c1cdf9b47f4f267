"""Pictures of a scene at one time, drawn on the CPU: triangles with a depth buffer.

Matplotlib sorts triangles by their middles, which mixes up layers that lie on each other.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from jaxsimp.compiling import compiler
from jaxsimp.dynamics import NONE, Table
from jaxsimp.viz.scene import Scene
from jaxsimp.viz.shapes import CELLS, Mesh, body_mesh, cone, obstacle_mesh

FRONT, BACK, GHOST = (0.16, 0.5, 0.76), (0.96, 0.7, 0.36), (0.6, 0.64, 0.69)
OBSTACLE, TABLE, FOG = (0.86, 0.82, 0.74), (0.925, 0.935, 0.945), (0.969, 0.973, 0.98)
INK, LINES = (0.13, 0.16, 0.2), (0.8, 0.82, 0.85)
PICKERS = ((0.84, 0.37, 0.0), (0.0, 0.62, 0.45), (0.8, 0.47, 0.65))
"""Colours, as those of page.html."""
LIGHT = np.array([0.36, -0.55, 1.0]) / np.linalg.norm([0.36, -0.55, 1.0])
AZIMUTH, HEIGHT, HALF_ANGLE = -1.15, 0.62, np.radians(16.0)
"""Direction of the camera, and half its angle of view, radians."""
SHADOW_SIZE = 256
"""Width of the picture that the shadow is drawn to."""

SAMPLES = 2
"""Samples of a pixel along each axis."""
FILLED = 0.86
"""Part of the picture that a scene fills at most."""
GHOST_BEHIND = 1e-3
"""How much further away the goal counts than it is, so that a body in it hides it."""

Picture = Float[np.ndarray, "H W 3"]


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera.

    Attributes:
        eye: where it stands, shape (3,), metres.
        axes: unit vectors to the right, up and backwards, shape (3, 3).
        width: width of the picture, pixels.
        height: height of the picture, pixels.
    """

    eye: Float[np.ndarray, "3"]
    axes: Float[np.ndarray, "3 3"]
    width: int
    height: int

    def see(self, points: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "V 3"]:
        """Column, row and nearness, which is 1 over the distance along the view."""
        right, up, back = self.axes @ (points - self.eye).T
        scale = self.height / 2 / np.tan(HALF_ANGLE) / -back
        return np.stack(
            [self.width / 2 + scale * right, self.height / 2 - scale * up, -1 / back], axis=1
        )

    def on_table(self) -> tuple[Float[np.ndarray, "2 H W"], Bool[np.ndarray, "H W"]]:
        """Where the table is behind each pixel, metres, and whether it is there."""
        columns = (np.arange(self.width) + 0.5 - self.width / 2) * 2 / self.height
        rows = (self.height / 2 - np.arange(self.height) - 0.5) * 2 / self.height
        slope = np.tan(HALF_ANGLE)
        right, up, back = self.axes[:, :, None, None]
        ray = slope * (columns[None, None] * right + rows[None, :, None] * up) - back
        below = ray[2] < -1e-3
        far = self.eye[2] / -np.where(below, ray[2], -1.0)
        return self.eye[:2, None, None] + far * ray[:2], below


def camera_of(scene: Scene, width: int, height: int) -> Camera:
    """A camera that sees all frames of a scene, and its goal."""
    (c, s), (e, h) = [(np.cos(angle), np.sin(angle)) for angle in (AZIMUTH, HEIGHT)]
    axes = np.array([[-s, c, 0.0], [-c * h, -s * h, e], [c * e, s * e, h]])
    points = np.concatenate([scene.trajectory.positions.reshape(-1, 3), scene.goal]) @ axes.T
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    away = points - middle
    wide = np.maximum(np.abs(away[:, 0]) * height / width, np.abs(away[:, 1]))
    distance = max((wide / (FILLED * np.tan(HALF_ANGLE)) + away[:, 2]).max(), 0.1)
    return Camera((middle + np.array([0.0, 0.0, distance])) @ axes, axes, width, height)


class Painter:
    """Draws the pictures of a scene, in one size; what does not move is drawn once."""

    def __init__(self, scene: Scene, width: int, height: int) -> None:
        """Make a painter of pictures of `width` by `height` pixels."""
        self._scene, self._size = scene, (height, width)
        self.camera = camera_of(scene, SAMPLES * width, SAMPLES * height)
        self._has_table = any(isinstance(each, Table) for each in scene.obstacles)
        limits = scene.limits
        self._reach = float(np.linalg.norm(np.diff(limits, axis=0))) / 2
        self._still = [
            obstacle_mesh(each, limits) for each in scene.obstacles if not isinstance(each, Table)
        ]
        self._ghost = _Layer(self.camera, body_mesh(scene.body, scene.goal))
        self._background = np.empty((*reversed((self.camera.width, self.camera.height)), 3))
        self._background[:] = FOG
        if self._has_table:
            self._ground, self._below = self.camera.on_table()
            self._draw_table(limits)

    def paint(
        self, positions: Float[np.ndarray, "N 3"], held: Sequence[int] | np.ndarray = ()
    ) -> Picture:
        """The picture of positions, with a gripper at each particle that a picker holds."""
        body = body_mesh(self._scene.body, positions)
        picture = self._background.copy()
        if self._has_table:
            self._paint_shadow(picture, [body, *self._still])
        depth = np.zeros(picture.shape[:2])
        for mesh in self._still:
            _paint(picture, depth, _Layer(self.camera, mesh), OBSTACLE, OBSTACLE)
        shown = _Layer(self.camera, body)
        _paint(picture, depth, shown, FRONT, BACK, self._scene.body.size / CELLS)
        _darken(picture[shown.box], shown.outline() & (shown.depth >= depth[shown.box]), 0.75)
        self._paint_ghost(picture, depth)
        for picker, particle in enumerate(held):
            if particle != NONE:
                tip = cone(positions[particle], 0.16 * self._reach)
                color = tuple(1.2 * part for part in PICKERS[picker % len(PICKERS)])
                _paint(picture, depth, _Layer(self.camera, tip), color, color)
        height, width = self._size
        return picture.reshape(height, SAMPLES, width, SAMPLES, 3).mean(axis=(1, 3)).clip(0, 1)

    def place(self, points: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "V 2"]:
        """Column and row of points in the picture, pixels."""
        return self.camera.see(points)[:, :2] / SAMPLES

    def _draw_table(self, limits: Float[np.ndarray, "2 3"]) -> None:
        """The table, with squares, which fades into the background."""
        middle = limits.mean(axis=0)[:2, None, None]
        far = np.linalg.norm((self._ground - middle) / (3.2 * self._reach), axis=0)
        fade = (1 - _smooth(0.45, 1.0, far)) * self._below
        cell = cell_of(self._reach)
        lines = np.maximum(
            0.55 * _grid(self._ground, cell, 1.2), _grid(self._ground, 5 * cell, 1.5)
        )
        _blend(self._background, fade, TABLE)
        _blend(self._background, fade * lines, LINES)

    def _paint_shadow(self, picture: Picture, meshes: Sequence[Mesh]) -> None:
        """Darken the table where light does not reach it."""
        low, size, inside, at = self._shadow_place
        depth = np.zeros((SHADOW_SIZE, SHADOW_SIZE))
        for mesh in meshes:
            cast = mesh.points[:, :2] - LIGHT[:2] / LIGHT[2] * mesh.points[:, 2:]
            flat = np.column_stack([(cast - low) / size * SHADOW_SIZE, np.ones(len(cast))])
            _fill(flat, mesh.faces, depth, np.empty(depth.shape, int), np.empty((*depth.shape, 2)))
        soft = ndimage.gaussian_filter(depth, 0.01 * SHADOW_SIZE)
        picture[inside] *= 1 - 0.34 * ndimage.map_coordinates(soft, at, order=1)[:, None]

    @cached_property
    def _shadow_place(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Corner and size of the shadow's picture, metres; pixels in it, and their places."""
        low, high = self._scene.limits[:, :2]
        margin = 0.6 * max(0.0, self._scene.limits[1, 2]) + 0.12 * self._reach
        low, size = low - margin, high - low + 2 * margin
        place = (self._ground - low[:, None, None]) / size[:, None, None]
        inside = self._below & (np.abs(place - 0.5) < 0.5).all(axis=0)
        return low, size, inside, place[::-1, inside] * SHADOW_SIZE - 0.5

    def _paint_ghost(self, picture: Picture, depth: Float[np.ndarray, "H W"]) -> None:
        """The goal, where the body does not hide it."""
        box = self._ghost.box
        seen = self._ghost.depth * (1 - GHOST_BEHIND) > depth[box]
        part = picture[box]
        part[seen] = 0.7 * part[seen] + 0.3 * self._ghost.shade(GHOST, GHOST, seen)
        _darken(part, self._ghost.outline() & seen, 0.35)


class _Layer:
    """A mesh as a camera sees it.

    Attributes:
        box: the rows and columns that it covers.
        depth: nearness at each pixel of the box; 0 where it is not seen.
    """

    def __init__(self, camera: Camera, mesh: Mesh) -> None:
        self._mesh = mesh
        screen = camera.see(mesh.points)
        size = np.array([camera.width, camera.height])
        low = np.floor(screen[:, :2].min(axis=0) - 2).clip(0, size).astype(int)
        high = np.ceil(screen[:, :2].max(axis=0) + 2).clip(low, size).astype(int)
        self.box = slice(low[1], high[1]), slice(low[0], high[0])
        self.depth = np.zeros((high - low)[::-1])
        self._face = np.full(self.depth.shape, -1)
        self._weights = np.zeros((*self.depth.shape, 2))
        screen[:, :2] -= low
        _fill(screen, mesh.faces, self.depth, self._face, self._weights)
        a, b, c = np.moveaxis(screen[mesh.faces, :2], 1, 0)
        (ux, uy), (vx, vy) = (b - a).T, (c - a).T
        # Rows go down, so a triangle that turns right is one that faces the camera.
        self._is_front = (ux * vy - uy * vx < 0) | mesh.is_solid

    def shade(
        self,
        front: tuple[float, ...],
        back: tuple[float, ...],
        where: Bool[np.ndarray, "h w"],
        cell: float = 0.0,
    ) -> Float[np.ndarray, "P 3"]:
        """Colours of some pixels of the box, in which the mesh is seen."""
        face, (u, v) = self._face[where], self._weights[where].T
        weights = np.stack([1 - u - v, u, v])
        corners = self._mesh.faces[face]
        normal = np.einsum("ip,pik->pk", weights, self._mesh.normals[corners])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True) + 1e-12
        is_front = self._is_front[face]
        normal[~is_front] *= -1
        color = np.where(is_front[:, None], np.array(front), np.array(back))
        if cell and self._mesh.rest is not None and len(face):
            rest = np.zeros((2, *where.shape))
            rest[:, where] = np.einsum("ip,pik->kp", weights, self._mesh.rest[corners])
            color = color * (1 - 0.13 * _grid(rest, cell, 1.5)[where])[:, None]
        light = 0.46 + 0.18 * (0.5 + 0.5 * normal[:, 2]) + 0.42 * (normal @ LIGHT).clip(0)
        return color * light[:, None]

    def outline(self) -> Bool[np.ndarray, "h w"]:
        """Pixels along the outline, and where front meets back."""
        kind = np.where(self._face < 0, 0, np.where(self._is_front[self._face], 1, 2))
        edge = np.zeros(kind.shape, bool)
        across, down = np.diff(kind, axis=1) != 0, np.diff(kind, axis=0) != 0
        edge[:, :-1] |= across
        edge[:, 1:] |= across
        edge[:-1] |= down
        edge[1:] |= down
        return edge & (self._face >= 0)


def cell_of(reach: float) -> float:
    """Side of the squares on the table, metres; a heavier line is every fifth."""
    return float(10.0 ** np.floor(np.log10(reach / 1.2)))


def _paint(
    picture: Picture,
    depth: Float[np.ndarray, "H W"],
    layer: _Layer,
    front: tuple[float, ...],
    back: tuple[float, ...],
    cell: float = 0.0,
) -> None:
    """Draw a layer into a picture, where it is nearer than what is there."""
    nearer = layer.depth > depth[layer.box]
    picture[layer.box][nearer] = layer.shade(front, back, nearer, cell)
    depth[layer.box][nearer] = layer.depth[nearer]


def _darken(picture: Picture, where: Bool[np.ndarray, "H W"], share: float) -> None:
    picture[where] = (1 - share) * picture[where] + share * np.array(INK)


def _blend(picture: Picture, share: Float[np.ndarray, "H W"], color: tuple[float, ...]) -> None:
    picture += share[..., None] * (np.array(color) - picture)


def _smooth(low: float, high: float, value: np.ndarray) -> np.ndarray:
    part = ((value - low) / (high - low)).clip(0, 1)
    return part * part * (3 - 2 * part)


def _grid(at: Float[np.ndarray, "2 H W"], cell: float, wide: float) -> Float[np.ndarray, "H W"]:
    """Lines of squares: 1 on a line, 0 a few pixels beside it; none where they would blur."""
    place = at / cell
    if min(place.shape) < 2:
        return np.zeros(place.shape[1:])
    down, across = np.gradient(place, axis=(1, 2))
    change = np.abs(down) + np.abs(across)
    off = np.abs((place - 0.5) % 1 - 0.5) / np.maximum(change, 1e-6)
    clear = (1.4 - 3 * change.max(axis=0)).clip(0, 1)
    return (1 - (off.min(axis=0) / wide).clip(0, 1)) * clear


@compiler("pictures")
@no_type_check
def _fill(
    screen: np.ndarray,
    faces: np.ndarray,
    depth: np.ndarray,
    face_at: np.ndarray,
    weights: np.ndarray,
) -> None:
    """Fill triangles where they are nearer than `depth`: its value, their id, and two weights."""
    height, width = depth.shape
    for face in range(len(faces)):
        a, b, c = screen[faces[face, 0]], screen[faces[face, 1]], screen[faces[face, 2]]
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if area == 0 or min(a[2], b[2], c[2]) <= 0:
            continue
        first_row = max(0, int(np.floor(min(a[1], b[1], c[1]) - 0.5)))
        last_row = min(height - 1, int(np.ceil(max(a[1], b[1], c[1]))))
        first = max(0, int(np.floor(min(a[0], b[0], c[0]) - 0.5)))
        last = min(width - 1, int(np.ceil(max(a[0], b[0], c[0]))))
        for row in range(first_row, last_row + 1):
            for column in range(first, last + 1):
                x, y = column + 0.5 - a[0], row + 0.5 - a[1]
                u = (x * (c[1] - a[1]) - y * (c[0] - a[0])) / area
                v = ((b[0] - a[0]) * y - (b[1] - a[1]) * x) / area
                if u < 0 or v < 0 or u + v > 1:
                    continue
                near = a[2] + u * (b[2] - a[2]) + v * (c[2] - a[2])
                if near > depth[row, column]:
                    depth[row, column], face_at[row, column] = near, face
                    weights[row, column, 0], weights[row, column, 1] = u, v
