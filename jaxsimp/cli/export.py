"""The verb `export`: plans as other programs read them.

The face loads each room at first use, so that `jaxsimp --help` imports none of them.
"""

import csv
import io
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

import jaxsimp

FORMATS = ("csv", "json", "mjcf", "obj", "ply", "glb")
FRAMES = ("obj", "ply")
"""Formats of which a folder has a file for each frame."""


@dataclass(frozen=True)
class Options:
    """A plan as other programs read it: waypoints of grippers, MJCF, meshes.

    csv and json are timed waypoints of the grippers: time (s), picker, x, y, z (m), closed or open,
    and the particle. mjcf is the body for MuJoCo, with the plan as keyframes: "start", "action_1",
    ..., "settled". obj and ply are a folder with a mesh for each frame, glb is one mesh of the end.

    The least distance between two grippers is printed, so that a robot's can be told from it. Times
    are those of the plan, in which pickers go from grasp to grasp at once.
    """

    path: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="PATH")]
    """A plan file."""
    to: str
    """Format: csv, json, mjcf, obj, ply or glb."""
    out: Path | None = None
    """File to write, or folder for obj and ply; the name of the plan by default."""
    fps: float = 30.0
    """Frames or waypoints per second."""
    variant: str = "full"
    """Variant of the MuJoCo model: full or fast."""

    def run(self) -> int:
        """Write the plan.

        Returns:
            The exit status, 0.

        Raises:
            ValueError: if the file is no plan, the format is unknown, or what is to be written is
                the plan itself; nothing is written then.
            OSError: if a file cannot be written.
        """
        from jaxsimp.checks import require_choice
        from jaxsimp.cli.paths import require_writable
        from jaxsimp.engines import least_distance

        require_choice("to", self.to, FORMATS)
        out = self.out or Path(self.path.stem + ("" if self.to in FRAMES else f".{self._suffix}"))
        if self.to not in FRAMES:
            require_writable(out, "--out")
        if out.resolve() == self.path.resolve():
            raise ValueError(f"{out} is another file of this command; give another --out")
        plan = jaxsimp.load_plan(self.path)
        scene = jaxsimp.scene_of_plan(plan, frames_per_second=self.fps)
        self._write(out, plan, scene)
        near = least_distance(scene.trajectory)
        print(f"wrote {out}")
        print(f"least distance between grippers: {f'{near:.4f} m' if near is not None else 'none'}")
        return 0

    @property
    def _suffix(self) -> str:
        return "xml" if self.to == "mjcf" else self.to

    def _write(self, out: Path, plan: "jaxsimp.SavedPlan", scene: "jaxsimp.Scene") -> None:
        from jaxsimp.viz import save_frames, save_mesh

        match self.to:
            case "csv":
                jaxsimp.records.write_text(out, table_of(scene.trajectory))
            case "json":
                jaxsimp.records.write_json(out, rows_of(scene.trajectory))
            case "mjcf":
                self._write_mjcf(out, plan)
            case "glb":
                save_mesh(out, scene, scene.trajectory.positions[-1])
            case _:
                save_frames(out, scene, self.to)

    def _write_mjcf(self, out: Path, plan: "jaxsimp.SavedPlan") -> None:
        task, last = plan.task(), len(plan.positions) - 1
        names = ["start", *(f"action_{index}" for index in range(1, last)), "settled"]
        picked = sorted({int(each) for each in plan.actions.pick.ravel()} - {jaxsimp.NONE})
        with jaxsimp.records.whole_file(out) as part:
            jaxsimp.save_mjcf(
                part,
                task.body,
                self.variant,
                picked,
                obstacles=task.obstacles,
                keyframes=dict(zip(names, plan.positions, strict=True)),
            )


def rows_of(trajectory: "jaxsimp.Trajectory") -> list[dict[str, Any]]:
    """Waypoints as JSON, of microseconds and micrometres."""
    from jaxsimp.engines import waypoints

    rows = [each._asdict() for each in waypoints(trajectory)]
    return [
        {name: round(each, 6) if isinstance(each, float) else each for name, each in row.items()}
        for row in rows
    ]


def table_of(trajectory: "jaxsimp.Trajectory") -> str:
    """Waypoints as CSV, with a line of names."""
    from jaxsimp.engines import Waypoint

    text = io.StringIO()
    writer = csv.DictWriter(text, Waypoint._fields, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows_of(trajectory))
    return text.getvalue()
