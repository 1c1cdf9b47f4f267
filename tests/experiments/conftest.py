"""A tiny study, run once for the tests of a module: its `command` with its `OPTIONS`."""

import pytest


@pytest.fixture(scope="module")
def results(request, tmp_path_factory, figures_saved):
    """The results of the module's study, and its figures by the names of their files."""
    folder = tmp_path_factory.mktemp("results") / "tiny"
    with figures_saved() as figures:
        assert request.module.command(*request.module.OPTIONS, "--out", folder) == 0
    return folder, figures


@pytest.fixture(scope="module")
def folder(results):
    """The folder of the module's study."""
    return results[0]
