"""Videos for papers and talks: GIF by Pillow, MP4 by the extra `video`."""

import subprocess
from collections.abc import Iterator, Sequence
from itertools import chain, groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import UInt8

from jaxsimp.checks import require_count, require_number, require_path
from jaxsimp.records import whole_file
from jaxsimp.viz.animation import require_scenes
from jaxsimp.viz.raster import INK, PICKERS, Painter
from jaxsimp.viz.scene import Scene, at_time, past_paths

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FORMATS = (".gif", ".mp4")
COLORS = 192
"""Colours of a GIF, of 256 at most."""
HOLD = 1.0
"""How long the end of the motion stays, seconds of the video."""
LEAST_WIDTH, MOST_WIDTH = 120, 4000
"""Least and most width of a panel, pixels."""
MOST_COLUMNS = 3
SHAPE = 0.75
"""Height of a panel over its width."""

Frame = UInt8[np.ndarray, "H W 3"]


def write_video(
    path: str | Path,
    scenes: Scene | Sequence[Scene],
    *,
    frames_per_second: float = 20.0,
    speed: float = 0.5,
    panel_width: int = 480,
) -> None:
    """Write scenes beside one another as a video.

    Args:
        path: path of the file: `.gif`, or `.mp4`, which needs the extra `video`.
        scenes: what to show; see `make_scene`, `scene_of_plan` and `scene_of_goal`.
        frames_per_second: frames in a second of the video, 1 to 60.
        speed: speed of the motion, as a multiple of real time, 0.01 to 100.
        panel_width: width of each panel, pixels.

    Raises:
        ValueError: if there are no scenes or too many, a number is out of its range, or the path
            has another suffix.
        ImportError: if the extra `video` is needed and not installed.
        OSError: if the file cannot be written.
    """
    path, shown = require_video_path(path), require_scenes(scenes)
    rate = require_number("frames_per_second", frames_per_second, 1.0, 60.0, "1/s")
    speed = require_number("speed", speed, 0.01, 100.0)
    width = require_count("panel_width", panel_width, LEAST_WIDTH, MOST_WIDTH)
    end = max(float(scene.trajectory.times[-1]) for scene in shown)
    times = np.append(np.arange(0.0, end, speed / rate), np.full(round(HOLD * rate), end))
    frames = _frames(shown, times, width)
    write = _write_gif if path.suffix.lower() == ".gif" else _write_mp4
    with whole_file(path) as part:
        write(part, frames, rate)


def require_video_path(path: str | Path) -> Path:
    """The path of a video.

    Raises:
        ValueError: if it is of no format that can be written.
        ImportError: if the extra `video` is needed and not installed.
    """
    path = Path(path)
    require_path(path, "give the path of a file that can be written")
    if path.suffix.lower() not in FORMATS:
        raise ValueError(f"{path} is no video; give a file in {', '.join(FORMATS)}")
    if path.suffix.lower() == ".mp4":
        _ffmpeg()
    return path


def _frames(scenes: Sequence[Scene], times: np.ndarray, width: int) -> Iterator[Frame]:
    """The frames of a video: pictures of all scenes, with their labels."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    columns = min(MOST_COLUMNS, len(scenes))
    rows = -(-len(scenes) // columns)
    height = 2 * round(SHAPE * width / 2)
    # Even numbers of pixels, as MP4 needs.
    size = 2 * round(columns * width / 2) / 100, rows * height / 100
    canvas = FigureCanvasAgg(Figure(figsize=size, dpi=100))
    panels = [
        _Panel(canvas.figure, scene, (rows, columns, index + 1), (width, height))
        for index, scene in enumerate(scenes)
    ]
    for time, group in groupby(times):  # the end is drawn once
        for panel in panels:
            panel.show(float(time))
        canvas.draw()
        frame = np.asarray(canvas.buffer_rgba())[..., :3].copy()
        yield from (frame for _ in group)


class _Panel:
    """One scene in a figure."""

    def __init__(
        self, figure: "Figure", scene: Scene, place: tuple[int, int, int], size: tuple[int, int]
    ) -> None:
        rows, columns, number = place
        row, column = divmod(number - 1, columns)
        box = (column / columns, 1 - (row + 1) / rows, 1 / columns, 1 / rows)
        self._axes, self._scene, self._painter = figure.add_axes(box), scene, Painter(scene, *size)
        self._axes.set_axis_off()
        self._picture = self._axes.imshow(
            np.zeros((size[1], size[0], 3)), extent=(0, size[0], size[1], 0)
        )
        text: dict[str, Any] = {"transform": self._axes.transAxes, "va": "top", "color": INK}
        scale = size[0] / 480
        self._axes.text(
            0.035, 0.96, scene.title.replace("$", r"\$"), weight="bold", size=10 * scale, **text
        )
        self._axes.text(0.035, 0.895, scene.caption, alpha=0.7, size=7.5 * scale, **text)
        self._clock = self._axes.text(
            0.965, 0.96, "", ha="right", alpha=0.7, size=7.5 * scale, **text
        )
        self._points = self._axes.scatter(
            [], [], s=20 * scale**2, color=INK, edgecolor="white", zorder=4
        )
        self._lines: list[Any] = []
        self._width = 1.8 * scale

    def show(self, time: float) -> None:
        """Draw the scene at a time."""
        positions, held = at_time(self._scene.trajectory, time)
        self._picture.set_data(self._painter.paint(positions, held))
        self._points.set_offsets(self._painter.place(positions[self._scene.key_points]))
        self._clock.set_text(f"{time:.2f} s")
        for line in self._lines:
            line.remove()
        self._lines = [
            self._axes.plot(
                *self._painter.place(path).T, color=PICKERS[picker % len(PICKERS)], lw=self._width
            )[0]
            for picker, path in past_paths(self._scene.trajectory, time)
        ]


def _write_gif(path: Path, frames: Iterator[Frame], rate: float) -> None:
    """Write a GIF: with one palette for all frames and no dither it stays small."""
    from PIL import Image

    pictures = [Image.fromarray(frame) for frame in frames]
    some = [np.asarray(each) for each in pictures[:: max(1, len(pictures) // 8)]]
    palette = Image.fromarray(np.concatenate(some)).quantize(COLORS, dither=Image.Dither.NONE)
    first, *rest = (each.quantize(palette=palette, dither=Image.Dither.NONE) for each in pictures)
    first.save(path, save_all=True, append_images=rest, duration=round(1000 / rate), loop=0)


def _write_mp4(path: Path, frames: Iterator[Frame], rate: float) -> None:
    first = next(frames)
    height, width = first.shape[:2]
    raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{rate:g}"]
    coded = ["-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "18", "-movflags", "+faststart"]
    command = [_ffmpeg(), "-loglevel", "error", "-y", *raw, "-i", "-", "-an", *coded, str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdin is not None
        assert process.stderr is not None
        try:
            for frame in chain([first], frames):
                process.stdin.write(frame.tobytes())
            process.stdin.close()
        except BrokenPipeError:
            pass  # it has said why
        told = process.stderr.read().decode(errors="replace").strip()
    if process.returncode:
        raise OSError(f"ffmpeg could not write the video ({told}); write a .gif instead")


def _ffmpeg() -> str:
    """Path of the program that writes MP4."""
    try:
        from imageio_ffmpeg import get_ffmpeg_exe
    except ImportError as error:
        raise ImportError(
            "MP4 needs imageio-ffmpeg, which is not installed; pip install 'jaxsimp[video]', or "
            "write a .gif"
        ) from error
    return str(get_ffmpeg_exe())
