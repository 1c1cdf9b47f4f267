"""The doors, by room."""

from functools import cache
from importlib import import_module

from tests.fuzz.core import Door

ROOMS = (
    "bodies",
    "goals",
    "simplification",
    "dynamics",
    "tasks",
    "engines",
    "planning",
    "calibration",
    "viz",
    "records",
    "plan_files",
    "commands",
)
"""Modules of this package, each with a tuple `DOORS`."""


@cache
def all_doors() -> dict[str, Door]:
    """The doors by name, in the order of the rooms."""
    found = [door for room in ROOMS for door in import_module(f"{__name__}.{room}").DOORS]
    doors = {door.name: door for door in found}
    assert len(doors) == len(found), "two doors have the same name"
    return doors
