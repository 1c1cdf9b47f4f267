"""Hints: what reading a file warns of, told as lines."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def told_hints() -> Iterator[None]:
    """A context whose warnings are printed as hints, also if it ends in an error.

    A hint may say why what follows is refused.
    """
    from rich.console import Console

    with warnings.catch_warnings(record=True) as hints:
        warnings.simplefilter("always")
        try:
            yield
        finally:
            for hint in hints:
                Console(stderr=True).print(f"hint: {hint.message}", markup=False, soft_wrap=True)
