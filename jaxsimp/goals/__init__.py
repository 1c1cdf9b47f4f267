"""Goals: the final position of every particle of a body.

A goal is an array of positions, shape (N, 3), metres, z up, the table at z = 0. The functions
here make goals of ropes, cloths and garments; `check_goal` checks any other goal, `load_goal`
reads and checks a goal in a file, and `register` finds the particles in one of other points;
`find_folds` and `subgoals` find the folds of a folded goal.
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
from jaxsimp.goals.placement import flat_at
from jaxsimp.goals.registration import Registration, register
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
from jaxsimp.goals.unfolding import Subgoal, find_folds, same_folds, subgoals, unfolded

__all__ = [
    "Fold",
    "Positions",
    "Registration",
    "Subgoal",
    "as_goal",
    "check_goal",
    "crossed_triangle",
    "find_folds",
    "flat",
    "flat_at",
    "fold",
    "fold_sequence",
    "leg_over_leg",
    "letter",
    "lift_crossings",
    "load_body",
    "load_goal",
    "polyline",
    "rectangle_folds",
    "register",
    "same_folds",
    "sleeves_in",
    "straight",
    "subgoals",
    "turn",
    "unfolded",
]
