"""Tasks of the tests."""

import runpy
from collections.abc import Iterator
from pathlib import Path

import pytest

from torch_qpmpc.experiment.tasks import TASKS


@pytest.fixture(autouse=True)
def _quick(rough_fits: None) -> None:
    """Fit roughly in all tests of runs."""


@pytest.fixture
def store_task() -> Iterator[None]:
    runpy.run_path(str(Path(__file__).parents[1] / "store_task.py"))
    yield
    del TASKS["store"]
