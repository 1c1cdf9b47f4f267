"""A figure of obstacles: a towel drawn over a bar by hand."""

from typing import TYPE_CHECKING

from experiments.scripted import scripted_plan
from jaxsimp import make_task, viz
from jaxsimp.engines import Execution, MassSprings

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def plot_obstacles(quick: bool) -> tuple["Figure", str]:
    """Start, actions, settled state and goal of the towel, with self-contact, and the scores."""
    task = make_task("towel_over_bar", quick=quick)
    episode = task.episode_fn(0)
    plan = scripted_plan(task, episode)

    def carried_out(self_contact: bool) -> Execution:
        return MassSprings(self_contact).executor(task)(episode, plan)

    passing, touching = carried_out(False), carried_out(True)
    shown = {"by hand": (touching.positions, touching.score)}
    figure = viz.plot_executions(task.body, task.goal, shown, task.name, task.obstacles)
    side = task.resolution
    return figure, (
        f"a towel of {side} x {side} over a bar scores {passing.score:.3f} without, "
        f"{touching.score:.3f} with self-contact"
    )
