"""Goals: the final position of every particle of a body.

A goal is an array of positions, shape (N, 3), metres, z up, the table at z = 0. The functions
here make goals of ropes, cloths and garments; `check_goal` checks any other goal, and `load_goal`
reads and checks a goal in a file.
"""

from jaxsimp.goals.check import as_goal, check_goal
from jaxsimp.goals.files import load_body, load_goal
from jaxsimp.goals.folds import (
    Fold,
    fold,
    fold_sequence,
    leg_over_leg,
    rectangle_folds,
    sleeves_in,
)
from jaxsimp.goals.shapes import (
    Positions,
    crossed_triangle,
    flat,
    letter,
    lift_crossings,
    polyline,
    straight,
    turn,
)

__all__ = [
    "Fold",
    "Positions",
    "as_goal",
    "check_goal",
    "crossed_triangle",
    "flat",
    "fold",
    "fold_sequence",
    "leg_over_leg",
    "letter",
    "lift_crossings",
    "load_body",
    "load_goal",
    "polyline",
    "rectangle_folds",
    "sleeves_in",
    "straight",
    "turn",
]
