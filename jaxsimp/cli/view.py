"""The verb `view`: plans and goals, as they move.

The face loads each room at first use, so that `jaxsimp --help` imports none of them.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

import jaxsimp

PLANS = "plans"
"""Folder of the plans in a folder of results."""


@dataclass(frozen=True)
class Options:
    """Plans and goals as they move: in the browser, as a page, or as a video.

    A path is a plan file, a goal file (see `jaxsimp simplify --help`), or a folder of results,
    whose plans are shown. Several are shown beside one another, at most 12.

    Without --html and --video the view opens in any browser at the address that is printed, until
    Ctrl-C; that needs `pip install 'jaxsimp[viewer]'`. --html writes one page that needs neither
    Python nor a network. --video writes a .gif, or an .mp4 with `pip install 'jaxsimp[video]'`.

    A plan is carried out once more, in the engine that its file names.
    """

    paths: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="PATH ...")]
    """Plan files, goal files, or folders of results."""
    html: Path | None = None
    """Page to write."""
    video: Path | None = None
    """Video to write, .gif or .mp4."""
    fps: float = 30.0
    """Frames per second of the motion."""
    speed: float = 0.5
    """Speed of the video, as a multiple of real time."""
    port: int = 8080
    """Port of the address, or the next one that is free."""

    def run(self) -> int:
        """Show the paths, or write what is asked for.

        Returns:
            The exit status, 0.

        Raises:
            ValueError: if a path is neither a plan nor a goal, there are too many, or an option is
                invalid; nothing is written then.
            ImportError: if an extra is needed and not installed.
            OSError: if a file cannot be written.
        """
        from jaxsimp import viz
        from jaxsimp.cli.paths import require_writable
        from jaxsimp.viz.animation import require_count_of_scenes
        from jaxsimp.viz.video import require_video_path

        used = [path.resolve() for path in self.paths]
        for name, path in (("--html", self.html), ("--video", self.video)):
            if path is not None:
                require_writable(path, name)
                if path.resolve() in used:
                    raise ValueError(f"{path} is another file of this command; give another {name}")
                used.append(path.resolve())
        if self.video:
            require_video_path(self.video)
        paths = [path for given in self.paths for path in plans_of(given)]
        require_count_of_scenes(len(paths))
        scenes = [scene_of(path, self.fps) for path in paths]
        if self.html:
            viz.animate(self.html, scenes)
            print(f"wrote {self.html}")
        if self.video:
            viz.write_video(self.video, scenes, speed=self.speed)
            print(f"wrote {self.video}")
        if not self.html and not self.video:
            with viz.viewing(scenes, port=self.port) as viewer:
                print(f"open {viewer.address} in a browser; Ctrl-C ends", flush=True)
                viz.serve(viewer)
        return 0


def plans_of(path: Path) -> list[Path]:
    """The plans of a folder of results in their order; the path itself if it is a file.

    Raises:
        ValueError: if a folder has no plans.
    """
    if not path.is_dir():
        return [path]
    folder = path / PLANS if (path / PLANS).is_dir() else path
    found = sorted(folder.glob("*.npz"))
    if not found:
        raise ValueError(f"{path} has no plans; give a folder of results with {PLANS}/, or files")
    return found


def scene_of(path: Path, frames_per_second: float) -> "jaxsimp.Scene":
    """The scene of a plan file or a goal file.

    Raises:
        ValueError: if it is neither.
        OSError: if it cannot be opened.
    """
    if not _is_plan(path):
        body, goal = jaxsimp.goals.load_goal(path)
        return jaxsimp.scene_of_goal(body, goal, jaxsimp.simplify(body, goal), title=path.stem)
    plan = jaxsimp.load_plan(path)
    return jaxsimp.scene_of_plan(plan, title=path.stem, frames_per_second=frames_per_second)


def _is_plan(path: Path) -> bool:
    """Whether a file has the arrays of a plan; a reader tells what else is wrong with it."""
    import zipfile

    try:
        with zipfile.ZipFile(path) as archive:
            return "displacement.npy" in archive.namelist()
    except zipfile.BadZipFile:
        return False
