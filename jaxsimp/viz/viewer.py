"""The view in a browser, served by viser (the extra `viewer`): for plans of any length."""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from jaxsimp.checks import require_count
from jaxsimp.dynamics import NONE, Table
from jaxsimp.viz.animation import require_scenes
from jaxsimp.viz.raster import BACK, FRONT, GHOST, INK, OBSTACLE, PICKERS, cell_of
from jaxsimp.viz.scene import Scene, at_time, past_paths
from jaxsimp.viz.shapes import body_mesh, cone, obstacle_mesh

PORT = 8080
TICK = 1 / 30
"""Time between two pictures while it plays, seconds."""
GAP = 0.25
"""Free space between scenes, as a fraction of the largest."""


class Viewer:
    """Scenes beside one another in a browser, and the time that they show.

    Attributes:
        address: address to open.
        duration: duration of the longest scene, seconds.
    """

    def __init__(self, server: Any, scenes: Sequence[Scene]) -> None:
        """Fill a server of viser with scenes."""
        self.address = f"http://localhost:{server.get_port()}"
        self.duration = max(float(scene.trajectory.times[-1]) for scene in scenes)
        width = (1 + GAP) * max(float(np.ptp(scene.limits[:, 0])) for scene in scenes)
        server.scene.set_up_direction("+z")
        self._stages = [
            _Stage(server, scene, f"/{index}", (index - (len(scenes) - 1) / 2) * width)
            for index, scene in enumerate(scenes)
        ]
        self._make_controls(server, scenes)
        if any(isinstance(each, Table) for scene in scenes for each in scene.obstacles):
            cell = cell_of(width / 2)
            # A little below 0, where flat sheets lie.
            server.scene.add_grid(
                "/table",
                2 * width * len(scenes),
                3 * width,
                cell_size=cell,
                section_size=5 * cell,
                position=(0.0, 0.0, -1e-3),
            )
        _aim(server, width * len(scenes))
        self.seek(0.0)

    def seek(self, seconds: float) -> None:
        """Show the scenes at a time."""
        for stage in self._stages:
            stage.show(seconds)

    def tick(self, seconds: float) -> None:
        """Let the time of this many seconds pass, if it plays."""
        if self._play.value and self.duration:
            passed = self._time.value + seconds * self._speed.value
            self._time.value = (
                0.0 if self._time.value >= self.duration else min(passed, self.duration)
            )

    def _make_controls(self, server: Any, scenes: Sequence[Scene]) -> None:
        gui, end = server.gui, round(self.duration, 3) or 1.0
        self._time = gui.add_slider("time (s)", 0.0, end, step=end / 1000, initial_value=0.0)
        self._play = gui.add_checkbox("play", self.duration > 0)
        self._speed = gui.add_slider("speed", 0.05, 2.0, step=0.05, initial_value=0.5)
        self._time.on_update(lambda _: self.seek(self._time.value))
        for name in ("goal", "key points", "pickers"):
            box = gui.add_checkbox(name, True)
            box.on_update(lambda event, name=name: self._set_visible(name, event.target.value))
        for scene in scenes:
            gui.add_markdown(f"**{scene.title}** {scene.caption}")
            if len(scene.costs) > 1:
                _add_curve(gui, scene.costs)

    def _set_visible(self, name: str, visible: bool) -> None:
        for stage in self._stages:
            stage.groups[name].visible = visible


class _Stage:
    """One scene on the server.

    Attributes:
        groups: what can be hidden, by name.
    """

    def __init__(self, server: Any, scene: Scene, name: str, shift: float) -> None:
        add, self._scene, self._name = server.scene, scene, name
        low, high = scene.limits
        middle = (low + high) / 2
        self._add, self._reach = add, float(np.linalg.norm(high - low)) / 2
        add.add_frame(name, show_axes=False, position=(shift - middle[0], -middle[1], 0.0))
        self.groups = {
            each: add.add_frame(f"{name}/{each}", show_axes=False)
            for each in ("goal", "key points", "pickers")
        }
        add.add_label(
            f"{name}/title",
            scene.title,
            position=(middle[0], middle[1], high[2] + 0.2 * self._reach),
        )
        self._add_still()
        mesh = body_mesh(scene.body, scene.trajectory.positions[0])
        sides = (("front", FRONT), ("back", BACK)) if not mesh.is_solid else (("front", FRONT),)
        self._bodies = [
            add.add_mesh_simple(
                f"{name}/{side}", mesh.points, mesh.faces, color=_rgb(color), side=side
            )
            for side, color in sides
        ]
        self._points = add.add_point_cloud(
            f"{name}/key points/all",
            scene.trajectory.positions[0][scene.key_points].astype(np.float32),
            _rgb(INK),
            point_size=0.02 * self._reach,
            point_shape="circle",
            precision="float32",
        )
        self._moving: list[Any] = []

    def show(self, seconds: float) -> None:
        """Show the scene at a time."""
        positions, held = at_time(self._scene.trajectory, seconds)
        points = body_mesh(self._scene.body, positions).points.astype(np.float32)
        for body in self._bodies:
            body.vertices = points
        self._points.points = positions[self._scene.key_points].astype(np.float32)
        for handle in self._moving:
            handle.remove()
        self._moving = [*self._grippers(positions, held), *self._paths(seconds)]

    def _add_still(self) -> None:
        add, scene, name = self._add, self._scene, self._name
        for index, obstacle in enumerate(scene.obstacles):
            if not isinstance(obstacle, Table):
                mesh = obstacle_mesh(obstacle, scene.limits)
                add.add_mesh_simple(
                    f"{name}/obstacle {index}",
                    mesh.points,
                    mesh.faces,
                    color=_rgb(OBSTACLE),
                    side="double",
                )
        goal = body_mesh(scene.body, scene.goal)
        add.add_mesh_simple(
            f"{name}/goal/all",
            goal.points,
            goal.faces,
            color=_rgb(GHOST),
            opacity=0.35,
            side="double",
        )

    def _grippers(self, positions: np.ndarray, held: np.ndarray) -> Iterator[Any]:
        for picker, particle in enumerate(held):
            if particle != NONE:
                mesh = cone(positions[particle], 0.16 * self._reach)
                yield self._add.add_mesh_simple(
                    f"{self._name}/pickers/{picker}",
                    mesh.points,
                    mesh.faces,
                    color=_color(picker),
                    side="double",
                )

    def _paths(self, seconds: float) -> Iterator[Any]:
        for index, (picker, path) in enumerate(past_paths(self._scene.trajectory, seconds)):
            if len(path) > 1:
                segments = np.stack([path[:-1], path[1:]], axis=1).astype(np.float32)
                yield self._add.add_line_segments(
                    f"{self._name}/pickers/path {index}",
                    segments,
                    _color(picker),
                    thickness=0.006 * self._reach,
                )


@contextmanager
def viewing(scenes: Scene | Sequence[Scene], *, port: int = PORT) -> Iterator[Viewer]:
    """A view of scenes beside one another, in any browser on this machine: a context.

    Args:
        scenes: what to show; see `make_scene`, `scene_of_plan` and `scene_of_goal`.
        port: port of the address; the next one that is free if it is in use.

    Raises:
        ValueError: if there are no scenes or too many, or the port is none.
        ImportError: if the extra `viewer` is not installed.
    """
    shown, port = require_scenes(scenes), require_count("port", port, 1, 65535)
    try:
        import viser
    except ImportError as error:
        raise ImportError(
            "the view in a browser needs viser, which is not installed; pip install "
            "'jaxsimp[viewer]', or write a page with --html, or animate"
        ) from error
    # Seen from this machine alone: the page asks for no password.
    server = viser.ViserServer(host="127.0.0.1", port=port, label="jaxsimp", verbose=False)
    try:
        yield Viewer(server, shown)
    finally:
        server.stop()


def serve(viewer: Viewer) -> None:
    """Let the time of a view pass, until Ctrl-C."""
    last = time.perf_counter()
    while True:
        time.sleep(TICK)
        now = time.perf_counter()
        viewer.tick(now - last)
        last = now


def _aim(server: Any, width: float) -> None:
    server.initial_camera.look_at = (0.0, 0.0, 0.0)
    server.initial_camera.position = (0.2 * width, -0.7 * width, 0.6 * width)


def _add_curve(gui: Any, costs: np.ndarray) -> None:
    import viser.uplot

    gui.add_uplot(
        (np.arange(1.0, len(costs) + 1), costs),
        (
            viser.uplot.Series(label="question"),
            viser.uplot.Series(label="cost of the best plan", stroke="#0072b2", width=2),
        ),
        title="cost of the best plan",
        scales={"x": viser.uplot.Scale(time=False)},
        aspect=1.8,
    )


def _color(picker: int) -> tuple[int, int, int]:
    return _rgb(PICKERS[picker % len(PICKERS)])


def _rgb(color: tuple[float, ...]) -> tuple[int, int, int]:
    red, green, blue = (round(255 * part) for part in color)
    return red, green, blue
