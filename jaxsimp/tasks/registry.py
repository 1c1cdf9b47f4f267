"""The registry of tasks: factories that take the resolution, by name."""

import copy
from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps

from jaxsimp.checks import require_count, require_flag
from jaxsimp.tasks.task import Task

LEAST_RESOLUTION, MOST_RESOLUTION = 5, 10_000
"""Smallest and largest number of particles along a side."""

TaskFactory = Callable[[int], Task]


@dataclass(frozen=True)
class _Entry:
    """A registered task: the arguments of `register` and its factory."""

    factory: TaskFactory
    full: int
    quick: int
    group: str


_REGISTRY: dict[str, _Entry] = {}


def register(
    *, full: int, quick: int, group: str = "others"
) -> Callable[[TaskFactory], TaskFactory]:
    """Add a task to the registry, under the name of the function that makes it.

    The decorated function gives its tasks this name and their resolution.

    Args:
        full: resolution for studies.
        quick: resolution for tests and smoke runs.
        group: name of a group of tasks: "paper", "goals", "obstacles" or "folded" here.

    Raises:
        ValueError: if the name is taken, or a resolution is out of its range.
    """
    for name, resolution in (("full", full), ("quick", quick)):
        require_count(name, resolution, LEAST_RESOLUTION, MOST_RESOLUTION)

    def add(factory: TaskFactory) -> TaskFactory:
        name = factory.__name__
        if name in _REGISTRY:
            raise ValueError(f"task {name!r} is registered already; choose another name")

        @wraps(factory)
        def named(resolution: int) -> Task:
            return _named(factory(resolution), name, resolution)

        _REGISTRY[name] = _Entry(named, full, quick, group)
        return named

    return add


def _named(task: Task, name: str, resolution: int) -> Task:
    """The task with a name and a resolution, without a second check."""
    named = copy.copy(task)
    object.__setattr__(named, "name", name)
    object.__setattr__(named, "resolution", resolution)
    return named


def task_names(group: str | None = None) -> tuple[str, ...]:
    """Names of the registered tasks of a group, or of all.

    Raises:
        ValueError: if the group is no text.
    """
    if group is not None and not isinstance(group, str):
        raise ValueError(f"group is {group!r}; give the name of one, as 'paper', or None")
    return tuple(name for name, entry in _REGISTRY.items() if group in (None, entry.group))


def make_task(name: str, resolution: int | None = None, *, quick: bool = False) -> Task:
    """A registered task.

    Args:
        name: one of `task_names()`.
        resolution: number of particles along the rope or along a side of the cloth; a garment has
            the square of this number. By default that of the full or the quick scale.
        quick: whether the default resolution is that of the quick scale.

    Raises:
        ValueError: if there is no such task, or the resolution is out of its range.
    """
    if not isinstance(name, str) or name not in _REGISTRY:
        raise ValueError(f"unknown task {name!r}; choose from {', '.join(_REGISTRY)}")
    require_flag("quick", quick)
    entry = _REGISTRY[name]
    if resolution is None:
        resolution = entry.quick if quick else entry.full
    return entry.factory(require_count("resolution", resolution, LEAST_RESOLUTION, MOST_RESOLUTION))
