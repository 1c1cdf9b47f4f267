"""Notebooks run from top to bottom, at a small size; their own checks fail them."""

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.py"))


def execute(text: str, monkeypatch):
    """The notebook of a py:percent text after a run, as Jupyter would have run it."""
    jupytext = pytest.importorskip("jupytext")
    nbclient = pytest.importorskip("nbclient")
    monkeypatch.setenv("JAXSIMP_NOTEBOOK_SIZE", "small")
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    monkeypatch.setenv("PYTHONPATH", path.rstrip(os.pathsep))
    notebook = jupytext.reads(text, fmt="py:percent")
    client = nbclient.NotebookClient(notebook, timeout=300, kernel_name="python3")
    return client.execute(cwd=str(ROOT / "notebooks"))


def test_there_are_notebooks():
    assert NOTEBOOKS


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_and_shows_a_figure(path, monkeypatch):
    notebook = execute(path.read_text(), monkeypatch)
    kinds = [cell.cell_type for cell in notebook.cells]
    assert kinds[0] == "markdown"
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    words = [output["text"] for output in outputs if output.get("name") == "stderr"]
    assert all("jaxsimp: compiling " in text and text.count("\n") == 1 for text in words)


def test_a_notebook_whose_check_fails_fails_the_test(monkeypatch):
    nbclient = pytest.importorskip("nbclient")
    with pytest.raises(nbclient.exceptions.CellExecutionError, match="not recovered"):
        execute("# %%\nassert False, 'not recovered'\n", monkeypatch)
