"""The wheel and the source distribution: what is in them, their metadata, and that they run."""

import os
import shutil
import subprocess
import sys
import tarfile
import zipfile
from email.message import Message
from email.parser import Parser
from pathlib import Path, PurePosixPath

import pytest

from jaxsimp.records.commit import STAMP, own_commit

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> Path:
    """A folder with the source distribution, and the wheel that is built from it."""
    folder = tmp_path_factory.mktemp("built")
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(folder), str(ROOT)]
    subprocess.run(command, check=True, capture_output=True, text=True)
    return folder


@pytest.fixture(scope="module")
def wheel(built) -> zipfile.ZipFile:
    (path,) = built.glob("*.whl")
    return zipfile.ZipFile(path)


@pytest.fixture(scope="module")
def metadata(wheel) -> Message:
    (name,) = (name for name in wheel.namelist() if name.endswith(".dist-info/METADATA"))
    return Parser().parsestr(wheel.read(name).decode())


def sources(folder: str) -> set[str]:
    """Files of the repository below a folder, without caches."""
    paths = (ROOT / folder).rglob("*")
    kept = [path for path in paths if path.is_file() and "__pycache__" not in path.parts]
    return {path.relative_to(ROOT).as_posix() for path in kept}


def test_the_wheel_has_the_package_and_nothing_else(wheel):
    names = set(wheel.namelist())
    information = {name for name in names if name.split("/")[0].endswith(".dist-info")}
    assert names - information == sources("jaxsimp")
    assert "jaxsimp/py.typed" in names
    assert {PurePosixPath(name).name for name in information} == {
        "METADATA",
        "RECORD",
        "WHEEL",
        "entry_points.txt",
        "LICENSE",
    }


def test_the_source_distribution_has_what_a_developer_needs(built):
    (path,) = built.glob("*.tar.gz")
    with tarfile.open(path) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    for folder in ("jaxsimp", "experiments", "tests", "docs"):
        assert sources(folder) <= names
    assert {"README.md", "LICENSE", "CITATION.cff", "pyproject.toml"} <= names
    assert not [name for name in names if name.startswith((".ci", "results", ".venv", "dist/"))]
    assert not [name for name in names if name.endswith((".pyc", ".nbi", ".nbc"))]


def test_what_is_built_carries_its_commit_into_any_repository(built, wheel, tmp_path):
    template = (ROOT / STAMP).read_bytes()
    (path,) = built.glob("*.tar.gz")
    with tarfile.open(path) as archive:
        archive.extractall(tmp_path, filter="data")
    unpacked = tmp_path / path.name.removesuffix(".tar.gz")
    wheel.extractall(tmp_path / "site")
    for folder in (tmp_path, tmp_path / "site", unpacked):
        subprocess.run(["git", "init", "-q", str(folder)], check=True)
    for folder in (tmp_path / "site", unpacked):
        assert own_commit(folder) == own_commit(ROOT)
    assert (ROOT / STAMP).read_bytes() == template  # nothing is left in the sources


def test_what_is_built_outside_a_repository_says_so(tmp_path):
    kept = ("pyproject.toml", "hatch_build.py", "README.md", "LICENSE", "jaxsimp/__init__.py")
    for name in (*kept, str(STAMP), "jaxsimp/records/commit.py"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    (tmp_path / STAMP).write_text("$Format:%H$")
    command = [sys.executable, "-m", "build", "--no-isolation", "--wheel", str(tmp_path)]
    subprocess.run(command, check=True, capture_output=True, text=True)
    (path,) = (tmp_path / "dist").glob("*.whl")
    assert zipfile.ZipFile(path).read(STAMP.as_posix()) == b"unknown\n"


def test_the_metadata_says_what_runs_it(metadata):
    assert metadata["Name"] == "jaxsimp"
    assert metadata["License-Expression"] == "Apache-2.0"
    version = f"{sys.version_info.major}.{sys.version_info.minor}"
    classifiers = metadata.get_all("Classifier")
    assert f"Programming Language :: Python :: {version}" in classifiers
    assert "Typing :: Typed" in classifiers
    assert metadata["Requires-Python"] == ">=3.11"


def test_the_installed_wheel_has_a_command(wheel, metadata, tmp_path):
    wheel.extractall(tmp_path / "site")
    code = """
import sys
from importlib.metadata import entry_points
import jaxsimp
print(jaxsimp.__file__)
(command,) = entry_points(group="console_scripts", name="jaxsimp")
sys.exit(command.load()(["--version"]))
"""
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(tmp_path / "site")},
        capture_output=True,
        text=True,
    )
    version = metadata["Version"]
    assert done.stdout == f"{tmp_path}/site/jaxsimp/__init__.py\njaxsimp {version}\n"
    assert (done.returncode, done.stderr) == (0, "")
