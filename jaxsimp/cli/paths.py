"""Checks of the paths that a command writes to."""

from pathlib import Path

from jaxsimp.checks import require_path


def require_writable(path: Path, option: str) -> None:
    """Raise a `ValueError` unless a path may be that of a new file.

    Args:
        path: path of the file.
        option: option that gives it, as "--json".
    """
    require_path(path, f"give another {option}")
    if path.is_dir():
        raise ValueError(f"{path} is a folder; give a file with {option}")
    if not path.parent.is_dir():
        raise ValueError(f"{path.parent} is no folder; make it, or give another {option}")
