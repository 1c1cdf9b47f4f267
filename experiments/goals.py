"""The study of harder goals: `python -m experiments.run goals`."""

from dataclasses import dataclass
from typing import ClassVar

from experiments.plan_options import PlanOptions
from jaxsimp.tasks import task_names


@dataclass(frozen=True)
class GoalsOptions(PlanOptions):
    """Plans for harder goals, as for the paper's: letters, folds in sequence, garments.

    Stop it with Ctrl-C or kill it at any time: the same command resumes it.
    """

    NAME: ClassVar[str] = "goals"
    SUCCESS_SCORE: ClassVar[float] = 0.8

    tasks: tuple[str, ...] = task_names("goals")
    """Tasks to plan for."""
    pick_encodings: tuple[str, ...] = ("joint",)
    """CEM's encoding of the choice of particles."""
