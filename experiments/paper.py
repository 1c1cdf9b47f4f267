"""The paper's study: `python -m experiments.run`."""

from dataclasses import dataclass
from typing import ClassVar

from experiments.plan_options import PlanOptions
from jaxsimp.tasks import task_names


@dataclass(frozen=True)
class PaperOptions(PlanOptions):
    """The paper's four tasks: key points of their goals, plans over them and over all particles.

    Stop it with Ctrl-C or kill it at any time: the same command resumes it.
    """

    NAME: ClassVar[str] = "paper"

    tasks: tuple[str, ...] = task_names("paper")
    """Tasks to plan for."""
    method: str = "paper"
    """Method of simplification: robust, paper or meshlab."""
