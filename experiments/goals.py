"""The study of harder goals: `python -m experiments.run goals`."""

from dataclasses import dataclass
from typing import ClassVar, Literal

from experiments.plan_options import PlanOptions
from jaxsimp.tasks import task_names


@dataclass(frozen=True)
class GoalsOptions(PlanOptions):
    """Harder goals, planned as the paper's are: letters, folds in sequence, garments.

    Stop it with Ctrl-C or kill it at any time: the same command goes on where it was.
    """

    NAME: ClassVar[str] = "goals"
    SUCCESS_SCORE: ClassVar[float] = 0.8

    tasks: tuple[str, ...] = task_names("goals")
    """Tasks to plan for."""
    pick_encodings: tuple[str, ...] = ("joint",)
    """How CEM encodes what is grasped."""
    budget: Literal["default", "paper", "goals"] = "goals"
    """Search settings: those that end in minutes, the paper's own, or more for several folds."""
