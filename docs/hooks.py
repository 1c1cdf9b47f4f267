"""MkDocs' hooks: pages that lie outside docs/, links to them and from them, and help texts.

The README is the site's first page, and notebooks are pages. Links in all of them are as GitHub
reads them, by the place of a file in the repository; here they are turned into the site's.
`<!-- help: jaxsimp plan -->` becomes what that command prints for `--help`.
"""

import os
import posixpath
import re
import subprocess
import sys
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.plugins import event_priority
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[1]
OUTSIDE = {
    "README.md": "index.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "LICENSE": "LICENSE",
    "CITATION.cff": "CITATION.cff",
    **{
        f"notebooks/{path.name}": f"notebooks/{path.name}"
        for path in sorted((ROOT / "notebooks").glob("*.py"))
    },
}
"""Files of the repository outside docs/, and where the site has them."""
_INSIDE = {there: here for here, there in OUTSIDE.items()}
_LINK = re.compile(r"(?<=\]\()(?!\w+:|#)([^)#\s]+)")
_HELP = re.compile(r"<!-- help: (.+) -->")


@event_priority(100)  # before the plugin that makes pages of notebooks
def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add what lies outside docs/."""
    for source, target in OUTSIDE.items():
        if source == target:
            folders = str(ROOT), config.site_dir
            files.append(File(target, *folders, use_directory_urls=config.use_directory_urls))
        else:
            files.append(File.generated(config, target, abs_src_path=str(ROOT / source)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turn links between files of the repository into links between pages; add help texts."""
    here = page.file.src_uri
    folder = posixpath.dirname(_INSIDE.get(here, f"docs/{here}"))

    def link(found: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(folder, found[1]))
        there = OUTSIDE.get(target, target.removeprefix("docs/"))
        return posixpath.relpath(there, posixpath.dirname(here) or ".")

    return _HELP.sub(_help, _LINK.sub(link, markdown))


def _help(found: re.Match[str]) -> str:
    """The section of a command."""
    words = found[1].split()
    told = subprocess.run(
        [sys.executable, "-m", *words, "--help"],
        cwd=ROOT,
        env={**os.environ, "COLUMNS": "80", "NO_COLOR": "1"},
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    name = found[1] if words[0] == "jaxsimp" else f"python -m {found[1]}"
    return f"## {name}\n\n```text\n{told.strip()}\n```\n"
