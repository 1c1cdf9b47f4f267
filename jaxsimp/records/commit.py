"""The commit of this package's own code: from its clone, or as stamped into it when it was built.

The file COMMIT beside this one is a template in a clone. `git archive` fills it in, since
.gitattributes says so, and the build of a wheel or a source distribution does: hatch_build.py runs
this file by itself, so it imports the standard library alone.
"""

import os
import subprocess
import tomllib
from pathlib import Path

UNKNOWN = "unknown"
CODE = ("jaxsimp", "experiments")
"""What results depend on: a folder of results elsewhere in the clone is no change."""
STAMP = Path("jaxsimp", "records", "COMMIT")
"""The file with the stamp, from the root of a clone, or from the folder of an installation."""


def own_commit(root: Path) -> str:
    """The commit of this package's code, with `+changes` if files differ from it.

    Another repository around the package says nothing about it, and is not asked.

    Args:
        root: folder that holds the folder `jaxsimp`.

    Returns:
        What was stamped; in a clone its HEAD; `"unknown"` for code of which neither is known.
    """
    try:
        stamp = (root / STAMP).read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError):
        stamp = ""
    if stamp and not stamp.startswith("$"):
        return stamp
    return _head(root) if _is_clone(root) else UNKNOWN


def _is_clone(root: Path) -> bool:
    """Whether a folder is the root of a clone or a worktree of this project."""
    try:
        project = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return project.get("project", {}).get("name") == "jaxsimp" and (root / ".git").exists()


def _head(root: Path) -> str:
    # The repository is named, not looked for: git then neither finds another, nor refuses one of
    # another owner, as that of a mounted folder is in a container. It writes nothing there.
    git = ["git", "-c", "core.fsmonitor=false", "--no-optional-locks"]
    git += [f"--git-dir={root / '.git'}", f"--work-tree={root}"]
    environment = {name: value for name, value in os.environ.items() if name not in ELSEWHERE}

    def answer(*command: str) -> bytes:
        asked = [*git, *command]
        done = subprocess.run(asked, env=environment, capture_output=True, check=True, timeout=60)
        return done.stdout.strip()

    try:
        head, changes = answer("rev-parse", "--verify", "HEAD"), answer("status", "-s", "--", *CODE)
    except (OSError, subprocess.SubprocessError):
        return UNKNOWN
    return head.decode() + ("+changes" if changes else "")


ELSEWHERE = {"GIT_INDEX_FILE", "GIT_OBJECT_DIRECTORY", "GIT_COMMON_DIR", "GIT_NAMESPACE"}
"""Variables by which git, when it runs a hook, has its children look at its own repository."""
