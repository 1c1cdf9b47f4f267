"""The public face `import jaxsimp as js`: what it offers, how it is typed, and what it costs."""

import ast
import importlib
import os
import pkgutil
import subprocess
import sys
from importlib import metadata
from inspect import ismodule
from pathlib import Path

import pytest

import jaxsimp as js

ROOT = Path(__file__).parents[1]
FACE = Path(js.__file__)
HEAVY = ("jax", "numpy", "scipy", "mujoco", "matplotlib", "numba", "trimesh", "igl", "tyro", "rich")
PACKAGES = [
    module.name for module in pkgutil.walk_packages([str(FACE.parent)], "jaxsimp.") if module.ispkg
]


def in_a_process(code: str) -> str:
    """What this code prints in a process of its own, in which nothing of jaxsimp is loaded."""
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    return done.stdout


def shown_to_type_checkers() -> dict[str, str]:
    """Names in the TYPE_CHECKING block of the face, each with the module that it is from."""
    (block,) = (
        node
        for node in ast.parse(FACE.read_text()).body
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
    )
    imports = [node for node in block.body if isinstance(node, ast.ImportFrom)]
    return {alias.name: node.module for node in imports for alias in node.names}


def test_table_block_and_all_name_the_same():
    table = {name: f"jaxsimp.{room}" for room, names in js._ROOMS.items() for name in names.split()}
    rooms = {room: "jaxsimp" for room in js._ROOMS if "." not in room}
    assert shown_to_type_checkers() == table | rooms
    assert set(js.__all__) == table.keys() | rooms.keys() | {"__version__"}
    assert len(js.__all__) == len(set(js.__all__))
    assert sum(len(names.split()) for names in js._ROOMS.values()) == len(table)


@pytest.mark.parametrize("name", js.__all__)
def test_a_name_is_what_its_room_has(name):
    value = getattr(js, name)
    if name == "__version__":
        assert value == metadata.version("jaxsimp")
    elif name in js._ROOMS:
        assert value is sys.modules[f"jaxsimp.{name}"]
    else:
        room = importlib.import_module(f"jaxsimp.{js._ROOM_OF[name]}")
        assert value is getattr(room, name)
        assert name in getattr(room, "__all__", vars(room))


def test_dir_lists_the_face_before_anything_is_loaded():
    assert in_a_process("import jaxsimp; print(*dir(jaxsimp))").split() == sorted(js.__all__)


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="module 'jaxsimp' has no attribute 'simplfy'"):
        js.simplfy  # noqa: B018, as the access is what is tested
    with pytest.raises(ImportError, match="simplfy"):
        exec("from jaxsimp import simplfy")


def test_files_that_are_not_installed_have_an_unknown_version(monkeypatch):
    def missing(name):
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "version", missing)
    assert js._version() == "0+unknown"


def test_importing_jaxsimp_imports_no_library():
    code = f"import sys, jaxsimp; print([name for name in {HEAVY} if name in sys.modules])"
    assert in_a_process(code) == "[]\n"
    assert in_a_process(code.replace("print", "jaxsimp.rope; print")) != "[]\n"


# --- names and modules of one name ---------------------------------------------------------------


def test_importing_every_module_shadows_no_name_of_the_face():
    names = [name for name in js.__all__ if name not in js._ROOMS]
    code = f"""
import importlib, jaxsimp, pkgutil
for module in pkgutil.walk_packages(jaxsimp.__path__, "jaxsimp."):
    if not module.name.endswith("__main__"):
        importlib.import_module(module.name)
print([name for name in {names} if isinstance(getattr(jaxsimp, name), type(jaxsimp))])
"""
    assert in_a_process(code) == "[]\n"


@pytest.mark.parametrize("name", ["jaxsimp", *PACKAGES])
def test_no_room_has_a_module_of_the_name_of_something_else(name):
    room = importlib.import_module(name)
    modules = {module.name for module in pkgutil.iter_modules(room.__path__)}
    shared = [each for each in getattr(room, "__all__", ()) if each in modules]
    assert [each for each in shared if not ismodule(getattr(room, each))] == []


@pytest.mark.parametrize("name", PACKAGES)
def test_what_a_room_names_is_there(name):
    room = importlib.import_module(name)
    assert [each for each in getattr(room, "__all__", ()) if not hasattr(room, each)] == []


# --- types ---------------------------------------------------------------------------------------

USER = '''
"""A user's file."""

import jaxsimp as js
from jaxsimp import KeyPoints, simplify
from jaxsimp.bodies import Body

body: Body = js.cloth((9, 9))
fold = js.goals.Fold
points: KeyPoints = js.simplify(body, js.goals.flat(body))
line: KeyPoints = simplify(js.rope(), js.goals.letter(js.rope(), "V"), workspace=js.Workspace())
version: str = js.__version__
reveal_type(js.simplify)
reveal_type(js.rollout)
reveal_type(js.viz.plot_costs)
'''
WRONG = """
js.simplfy(body)
js.simplify(body, tolerance="thin")
length: int = js.rope()
"""


def test_a_users_file_has_types(tmp_path):
    (tmp_path / "user.py").write_text(USER + WRONG)
    done = subprocess.run(
        [
            *(sys.executable, "-m", "mypy", "--strict", "--follow-imports=silent"),
            # Reading the types of other libraries takes nine tenths of the time.
            *("--no-site-packages", "--ignore-missing-imports"),
            *("--config-file=", f"--cache-dir={tmp_path}", "user.py"),
        ],
        cwd=tmp_path,
        env=os.environ | {"MYPYPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    told = done.stdout
    revealed = [line for line in told.splitlines() if "Revealed type" in line]
    assert len(revealed) == 3, told + done.stderr
    assert "KeyPoints" in revealed[0]
    assert "Simulation" in revealed[1]
    assert "Mapping" in revealed[2]
    first_wrong = len(USER.splitlines()) + 2
    errors = [line for line in told.splitlines() if ": error: " in line]
    lines = [int(line.split(":")[1]) for line in errors]
    assert set(lines) == {first_wrong, first_wrong + 1, first_wrong + 2}, told
    assert 'has no attribute "simplfy"' in told
