"""Compile the kernels once for all workers; give the fixtures to the processes that run tests."""

import gc
import subprocess
import sys
from typing import Any

import pytest

from tests import kernels

#: What imports and the collection of tests make stays: no garbage is looked for among it.
gc.disable()

COMPILING = pytest.StashKey[subprocess.Popen[bytes]]()


def pytest_configure(config: pytest.Config) -> None:
    """Compile the kernels while xdist's workers start, instead of once in each worker.

    Idle workers steal tests, because by default long ones may run last on one worker.
    """
    if not config.getoption("numprocesses", None) or hasattr(config, "workerinput"):
        config.pluginmanager.import_plugin("tests.fixtures")
        return
    config.option.dist = "worksteal"
    if not kernels.up_to_date():
        command = [sys.executable, "-m", "tests.kernels"]
        config.stash[COMPILING] = subprocess.Popen(command, cwd=config.rootpath)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_node_collection_finished(node: Any) -> None:
    """Wait for the kernels before the first test."""
    if (compiling := node.config.stash.get(COMPILING, None)) is not None:
        compiling.wait()
