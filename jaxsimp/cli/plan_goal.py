"""The body and the goal that options of `jaxsimp plan` name."""

import warnings
from typing import TYPE_CHECKING

import jaxsimp
from jaxsimp.checks import require_choice, require_count

if TYPE_CHECKING:
    from jaxsimp.bodies import Body
    from jaxsimp.cli.plan import Options
    from jaxsimp.goals import Positions

CLOTH_FOLDS = ("side", "diagonal", "quarter", "letter", "four_corners")
GARMENT_FOLDS = {"sleeves_in": "t_shirt", "leg_over_leg": "trousers"}
"""Folds about landmarks of a garment, and the garment, which is made from dimensions."""


def check_goal(options: "Options") -> None:
    """Check the options of body and goal before any computation.

    Raises:
        ValueError: if not exactly one goal is given, or options contradict one another.
    """
    from jaxsimp.bodies.size import MOST_PARTICLES

    given = [each for each in (options.goal, options.fold, options.letter) if each is not None]
    if len(given) != 1:
        raise ValueError(
            f"{len(given)} goals are given to plan for; give one: a file, --fold or --letter"
        )
    if options.fold is not None:
        require_choice("fold", options.fold, (*CLOTH_FOLDS, *GARMENT_FOLDS))
    if options.fold in GARMENT_FOLDS and (options.body or options.press):
        raise ValueError(
            f"--fold {options.fold} folds a {GARMENT_FOLDS[options.fold]} made from dimensions, "
            f"whose seams are known, and takes neither --body nor --press; for a mesh of your own "
            f"give another fold, or the goal as a file"
        )
    if (options.press or options.particles) and not (options.body or options.fold):
        raise ValueError(
            "--press and --particles change a body; give its file with --body, or a goal with "
            "--fold"
        )
    if options.particles is not None:
        require_count("particles", options.particles, 3, MOST_PARTICLES)


def body_and_goal(options: "Options") -> "tuple[Body, Positions]":
    """The body and its goal.

    Raises:
        ValueError: if a file is invalid, or the body cannot have the goal.
    """
    from jaxsimp import goals

    if options.fold in GARMENT_FOLDS:
        make, folds_of = (
            getattr(jaxsimp, GARMENT_FOLDS[options.fold]),
            getattr(goals, options.fold),
        )
        garment = make(**({"num_particles": options.particles} if options.particles else {}))
        return garment.body, goals.fold_sequence(garment.body, folds_of(garment))
    given = _body(options)
    if options.goal:
        scale, up = options.scale, options.up
        return goals.load_goal(options.goal, given, scale=scale, up=up or "z")
    if options.letter:
        body = given or jaxsimp.rope()
        return body, goals.letter(body, options.letter)
    body = given or jaxsimp.cloth()
    return body, goals.fold_sequence(body, goals.rectangle_folds(body, str(options.fold)))


def _body(options: "Options") -> "Body | None":
    """The body of the file, or the cloth of a named fold, meshed anew and pressed if asked for."""
    from jaxsimp import goals

    body = jaxsimp.cloth() if options.fold and options.particles else None
    if options.body:
        with warnings.catch_warnings():
            if options.particles:  # which replaces them
                warnings.filterwarnings("ignore", message=".* has narrow triangles")
            body = goals.load_body(options.body, scale=options.scale, up=options.up)
    if body is None:
        return None
    if options.particles:
        points, faces = jaxsimp.bodies.remesh(body.rest, body.faces, options.particles)
        body = jaxsimp.from_mesh(points, faces)
    return _pressed(body, has_pinch=options.pinch is not None) if options.press else body


def _pressed(body: "Body", *, has_pinch: bool) -> "Body":
    """The body laid flat; warns if it lies in layers and a picker holds one particle."""
    import numpy as np

    body = jaxsimp.press(body)
    if np.ptp(body.rest[:, 2]) > body.material.thickness / 2 and not has_pinch:
        radius = 1.5 * float(np.median(body.rest_length[body.families == 0]))
        warnings.warn(
            f"the {body.name} lies in layers, and a picker holds a particle of one of them; "
            f"--pinch {radius:.2g} 3 holds all layers under the finger",
            stacklevel=2,
        )
    return body
