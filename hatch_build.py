"""Build hook: a wheel or a source distribution carries the commit that it is built from."""

import runpy
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class CommitHook(BuildHookInterface):
    """Replaces the template of jaxsimp/records/COMMIT in what is built, not in the sources."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Add the file with the commit; an editable installation asks its clone instead."""
        if version == "editable":
            return
        root = Path(self.root)
        commit = runpy.run_path(str(root / "jaxsimp" / "records" / "commit.py"))
        self.folder = tempfile.TemporaryDirectory()
        stamp = Path(self.folder.name, "COMMIT")
        stamp.write_text(commit["own_commit"](root) + "\n")
        build_data["force_include"][str(stamp)] = commit["STAMP"].as_posix()

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Remove the file."""
        if version != "editable":
            self.folder.cleanup()
