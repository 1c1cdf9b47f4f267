"""The site of the documentation: it builds without a warning, and has the whole public face."""

import importlib.util
import os
import re
import subprocess
import sys
import zlib
from pathlib import Path
from types import SimpleNamespace

import pytest

import jaxsimp
from jaxsimp.cli.main import VERBS

pytest.importorskip("mkdocs")  # the extra `docs`
ROOT = Path(__file__).parents[1]


@pytest.mark.slow
def test_the_site_builds_and_has_all_names_commands_and_links(tmp_path):
    """One test, since the site takes a while; without notebooks, which their own tests run."""
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    environment = {**os.environ, "JAXSIMP_SITE_EXECUTES": "false"}
    built = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert built.returncode == 0, built.stderr

    # The inventory of Sphinx: four lines of text, and the names, compressed.
    packed = (tmp_path / "objects.inv").read_bytes().split(b"\n", 4)[4]
    names = {line.split()[0] for line in zlib.decompress(packed).decode().splitlines()}
    wanted = {f"jaxsimp.{name}" for name in jaxsimp.__all__ if name != "__version__"}
    assert wanted <= names, sorted(wanted - names)

    commands = (tmp_path / "reference/commands/index.html").read_text()
    for verb in VERBS:
        assert f"usage: jaxsimp {verb}" in commands
    assert "<!-- help" not in commands

    inside = re.compile(r'(?:href|src)="(?!\w+:|#|data:)([^"#?]+)')
    for page in tmp_path.rglob("index.html"):
        for link in inside.findall(page.read_text()):
            target = (page.parent / link).resolve()
            assert target.exists(), f"{page.relative_to(tmp_path)}: {link}"


def hooks():
    spec = importlib.util.spec_from_file_location("hooks", ROOT / "docs/hooks.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    ("page", "written", "on_the_site"),
    [
        (
            "index.md",
            "[a](docs/plan.md#x), ![b](docs/figures/b.png)",
            "[a](plan.md#x), ![b](figures/b.png)",
        ),
        ("plan.md", "[a](watch.md) [b](../README.md#use-it)", "[a](watch.md) [b](index.md#use-it)"),
        ("physics.md", "[a](../notebooks/calibrate.py)", "[a](notebooks/calibrate.py)"),
        ("contributing.md", "[a](docs/glossary.md) [b](LICENSE)", "[a](glossary.md) [b](LICENSE)"),
        ("reference/index.md", "[a](bodies.md) [b](../plan.md)", "[a](bodies.md) [b](../plan.md)"),
        (
            "plan.md",
            "[a](#here) [b](https://example.org/c.md)",
            "[a](#here) [b](https://example.org/c.md)",
        ),
    ],
)
def test_links_between_files_become_links_between_pages(page, written, on_the_site):
    there = SimpleNamespace(file=SimpleNamespace(src_uri=page))
    assert hooks().on_page_markdown(written, there, None, None) == on_the_site
