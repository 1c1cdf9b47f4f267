"""The verb `plan`: from a goal to a plan that is carried out, verified and shown.

The face loads each room at first use, so that `jaxsimp --help` imports none of them.
"""

import math
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from rich.console import Console

import jaxsimp
from jaxsimp.cli import plan_report
from jaxsimp.cli.beside import contact_compiled_beside
from jaxsimp.cli.hints import told_hints
from jaxsimp.cli.plan_report import FIGURE_FILE, PAGE_FILE, PLANS_FOLDER, ROWS_FILE, Row

if TYPE_CHECKING:
    from jaxsimp.goal_plan import GoalPlan, GoalPlanner

FAILED = 1
"""Exit status if no plan is successful."""
XYZ = tuple[float, float, float]
PLAN_FILE, RESULT_FILE, REPORT_FILE = "plan.npz", "result.json", "report.md"
FIELDS = ("score", "merit", "success", "rollouts", "seconds", "compile_seconds", "environment")
"""Fields of a row that the report reads."""


@dataclass(frozen=True)
class Options:
    """Plan how to bring a rope, cloth or garment to a goal, carry it out, and show it.

    The goal is a file, as for `jaxsimp simplify`; or --fold or --letter names a goal of the body.
    The plan is carried out in our dynamics, with self-contact, and again in MuJoCo. The folder of
    results gets the plan, its figures, an animation that any browser shows, and a report. The same
    command resumes what was interrupted.

    The exit status is 0 if the best plan has a score of at least 0.9, 1 if none has, 2 for wrong
    input.
    """

    goal: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="[GOAL]")] = None
    """File of the goal."""
    body: Path | None = None
    """The body at rest, as for `jaxsimp simplify`; a cloth of 0.3 m or a rope of 0.5 m by default
    for --fold and --letter."""
    fold: str | None = None
    """Folds as the goal: side, diagonal, quarter, letter or four_corners, of the rectangle around
    what lies; sleeves_in of a T-shirt, or leg_over_leg of trousers, made from dimensions."""
    letter: str | None = None
    """Letter as the goal of a rope: C, M, O, S or U."""
    particles: int | None = None
    """Number of particles that the body is meshed anew with; those of its file by default."""
    press: bool = False
    """Lay the body, a garment as worn or modelled in space, on the table, pressed flat."""
    start: str = "flat"
    """Start: flat, crumpled, or a file of positions."""
    scale: float = 1.0
    """Metres in one unit of the files: 0.001 for millimetres."""
    up: str | None = None
    """Axis of the files that points up: z, y or x; z by default."""
    planner: str = "default"
    """Search: default, cem, or random_shooting."""
    cost: str = "particles"
    """Cost of a state: particles, shape, either_end, chamfer or daxbench."""
    pickers: int = 2
    """Number of pickers."""
    actions: int | None = None
    """Number of actions; by default what the goal needs."""
    limits: Annotated[XYZ | None, tyro.conf.arg(metavar="X Y Z")] = None
    """Largest displacement of an action along x, y and z, metres; by default by the body's size."""
    pinch: Annotated[tuple[float, int] | None, tyro.conf.arg(metavar="RADIUS LAYERS")] = None
    """Fingers that hold all within a radius, metres, and so many layers on either side of the
    particle's own; that particle alone by default."""
    gripper_distance: float = 0.0
    """Least distance of two grippers that both hold something, metres; plans in which they come
    nearer cost more."""
    seeds: int = 1
    """Number of plans, of which the one of the highest score is kept, less what grippers cost
    that come too near."""
    tolerance: float | None = None
    """Error below which a model of the goal fits, metres; the method's own by default."""
    verify: bool = True
    """Carry out the plan in MuJoCo, too."""
    out: Path | None = None
    """Folder of results; by default named after the goal, with -plan."""
    mixed: bool = False
    """Go on in a folder with rows of another environment; the report says so."""
    json: Path | None = None
    """Further file for the result, as an object."""

    def check(self) -> None:
        """Check the options before any computation.

        Raises:
            ValueError: if not exactly one goal is given, or an option is out of its range.
        """
        from jaxsimp.bodies.size import require_scale
        from jaxsimp.checks import require_choice, require_count
        from jaxsimp.cli.paths import require_writable
        from jaxsimp.cli.plan_goal import check_goal
        from jaxsimp.goal_plan import SEARCHES
        from jaxsimp.tasks import COSTS

        check_goal(self)
        require_choice("planner", self.planner, SEARCHES)
        require_choice("cost", self.cost, COSTS)
        require_choice("up", self.up or "z", ("x", "y", "z"))
        require_scale(self.scale)
        require_count("seeds", self.seeds, 1, 1000)
        if self.json is not None:
            require_writable(self.json, "--json")

    @property
    def name(self) -> str:
        """Name of the goal."""
        return self.goal.stem if self.goal else str(self.fold or self.letter)

    @property
    def folder(self) -> Path:
        """Folder of results."""
        return self.out or Path(f"{self.name}-plan")

    def run(self) -> int:
        """Plan, and write the folder of results.

        Returns:
            The exit status: 0, or `FAILED`.

        Raises:
            ValueError: if a file or an option is invalid.
            OSError: if a file cannot be written.
        """
        self.check()
        console = Console(width=None if sys.stdout.isatty() else 100, highlight=False)
        begun = time.perf_counter()
        console.print("key points of the goal; the first time this compiles, for up to a minute")
        with contact_compiled_beside():
            planner = planner_of(self)
        console.print(
            f"{len(planner.key_points)} key points {planner.key_points.particles.tolist()}"
        )
        folder = self.folder
        with jaxsimp.records.open_folder(folder, config(planner)):
            rows = planned(planner, self.seeds, folder, console, mixed=self.mixed)
            best = max(rows, key=lambda row: -math.inf if row["merit"] is None else row["merit"])
            console.print("replay in MuJoCo, and figures" if self.verify else "figures")
            result = write_result(planner, best, rows, folder, verify=self.verify)
        if self.json:
            jaxsimp.records.write_json(self.json, result)
        seconds = time.perf_counter() - begun
        console.print(
            f"{plan_report.told(result)}, in {seconds:.0f} s: {folder}/report.md", markup=False
        )
        return 0 if result["success"] else FAILED


def planner_of(options: Options) -> "GoalPlanner":
    """The planner of the goal that the options name.

    Raises:
        ValueError: if a file or an option is invalid.
    """
    from jaxsimp.cli.plan_goal import body_and_goal
    from jaxsimp.goal_plan import goal_planner
    from jaxsimp.goals import load_goal
    from jaxsimp.tasks.reaching import STARTS

    with told_hints():
        body, goal = body_and_goal(options)
        start: Any = options.start
        if start not in STARTS:
            _, start = load_goal(start, body, scale=options.scale, up=options.up or "z")
    return goal_planner(
        body,
        goal,
        start=start,
        search=options.planner,
        cost=options.cost,
        tolerance=options.tolerance,
        num_actions=options.actions,
        num_pickers=options.pickers,
        limits=options.limits,
        pinch=jaxsimp.Pinch(*options.pinch) if options.pinch else None,
        gripper_distance=options.gripper_distance,
        name=options.name,
    )


def config(planner: "GoalPlanner") -> dict[str, Any]:
    """What the results of a folder have in common: the goal, the task and the search."""
    from hashlib import sha256

    import numpy as np

    task = planner.task
    episode = task.episode_fn(0)
    arrays = (task.body.rest, task.body.faces, task.goal, episode.start)
    numbers = b"".join(np.ascontiguousarray(each).tobytes() for each in arrays)
    return {
        "goal": task.name,
        "sha256": sha256(numbers).hexdigest(),
        "num_particles": task.body.num_particles,
        "key_points": planner.key_points.particles.tolist(),
        "search": repr(planner.algorithm),
        "cost": getattr(task.terminal_cost, "__name__", str(task.terminal_cost)),
        "num_actions": planner.planner.task.num_actions,
        "num_pickers": task.num_pickers,
        "limits": list(task.limits),
        "pinch": None if task.pinch is None else vars(task.pinch),
        "gripper_distance": task.gripper_distance,
        "action_seconds": task.action_seconds,
        "time_step": task.time_step,
    }


def planned(
    planner: "GoalPlanner", num_seeds: int, folder: Path, console: Console, *, mixed: bool
) -> list[Row]:
    """A row for each seed; those that the folder has are not planned again."""
    from jaxsimp import records
    from jaxsimp.cli.progress import progress_bar

    environment = records.environment()
    rows = records.RowFile(folder / ROWS_FILE, ("seed",), FIELDS)

    def fault(row: Row) -> str | None:
        try:
            records.load_plan(folder / plan_file(row["seed"]))
        except (ValueError, OSError) as error:
            return str(error)
        return None

    rows.resume(
        environment, mixed=mixed, fault=fault, tell=lambda line: console.print(line, markup=False)
    )
    seeds = [(seed,) for seed in range(num_seeds)]
    left = rows.left(seeds)
    if left:
        (folder / PLANS_FOLDER).mkdir(exist_ok=True)
        console.print("compiling the search")
        compile_seconds, seconds = planner.prepare(), planner.estimate_seconds()
        console.print(
            f"compiled in {compile_seconds:.0f} s; plans of about {seconds:.0f} s: {len(left)}"
        )
        with progress_bar(console) as progress:
            bar = progress.add_task("search", total=len(left) * planner.num_questions)
            for (seed,) in left:
                found = planner.plan(seed, lambda: progress.advance(bar))
                found.save(folder / plan_file(seed))
                rows.append(_row(found, compile_seconds) | {"environment": environment})
                compile_seconds = 0.0
    return rows.in_order(seeds)


def plan_file(seed: int) -> str:
    """Path of the plan of a seed, in the folder of results."""
    return f"{PLANS_FOLDER}/{seed}.npz"


def _row(found: "GoalPlan", compile_seconds: float) -> Row:
    return {
        "seed": found.seed,
        "score": found.score if math.isfinite(found.score) else None,
        "merit": found.merit if math.isfinite(found.merit) else None,
        "success": found.is_success,
        "rollouts": found.search.num_rollouts,
        "counted_rollouts": found.search.price,
        "seconds": found.search.seconds,
        "compile_seconds": compile_seconds + found.search.compile_seconds,
        "missed_contacts": found.execution.missed,
    }


def write_result(
    planner: "GoalPlanner", best: Row, rows: list[Row], folder: Path, *, verify: bool
) -> Row:
    """Replay the best plan, write plan, figures and report, and return the result."""
    from shutil import copyfile

    from jaxsimp import records, viz
    from jaxsimp.engines import least_distance

    saved = records.load_plan(folder / plan_file(best["seed"]))
    with records.whole_file(folder / PLAN_FILE) as part:
        copyfile(folder / plan_file(best["seed"]), part)
    score = math.nan if best["score"] is None else best["score"]
    executions = {"carried out in our dynamics, with self-contact": (saved.positions, score)}
    result: Row = {
        "goal": planner.task.name,
        "key_points": planner.key_points.particles.tolist(),
        "num_actions": len(saved.actions.pick),
        **{name: best[name] for name in ("seed", "score", "success", "rollouts", "seconds")},
        "compile_seconds": sum(row["compile_seconds"] for row in rows),
        "scores": [row["score"] for row in rows],
    }
    if verify:
        replayed = _replayed(planner, saved)
        executions["carried out in MuJoCo"] = replayed.positions, replayed.score
        result["mujoco_full_score"] = replayed.score if math.isfinite(replayed.score) else None
    scene = viz.scene_of_plan(saved, title=planner.task.name)
    result["least_gripper_distance"] = least_distance(scene.trajectory)
    files = {"plan": PLAN_FILE, "animation": PAGE_FILE, "figure": FIGURE_FILE}
    result |= {name: str(folder / file) for name, file in files.items()}
    result["environment"] = best["environment"]
    plan_report.save_figures(planner, executions, folder)
    viz.animate(folder / PAGE_FILE, scene)
    records.write_json(folder / RESULT_FILE, result)
    records.write_text(folder / REPORT_FILE, plan_report.report(planner, saved, result, rows))
    return result


def _replayed(planner: "GoalPlanner", saved: "jaxsimp.SavedPlan") -> "jaxsimp.Execution":
    assert saved.episode is not None
    (found,) = jaxsimp.replay(planner.task, [saved.episode], [saved.actions])
    return found
