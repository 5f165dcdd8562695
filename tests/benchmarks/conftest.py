import importlib.util
from collections.abc import Callable, Iterator
from importlib.metadata import version
from typing import Any

import pytest
import torch

from tests.benchmarks.interleaved import Interleaved

#: Packages that are timed, or that times depend on.
PACKAGES = (
    *("torch", "numpy", "proxsuite", "daqp"),
    *("qpth", "cvxpylayers", "diffcp", "clarabel", "qpsolvers", "piqp", "moreau"),
)


@pytest.fixture(autouse=True)
def thread_count() -> Iterator[None]:
    """Restore torch's thread count after a benchmark."""
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.fixture
def interleaved(benchmark: Any) -> Callable[..., Any]:
    """Return `Interleaved.run` on pytest-benchmark's fixture."""
    return Interleaved(benchmark).run


@pytest.hookimpl(optionalhook=True)
def pytest_benchmark_update_machine_info(config: pytest.Config, machine_info: dict) -> None:
    """Put the packages' versions into the results."""
    machine_info["versions"] = {
        name: version(name) for name in PACKAGES if importlib.util.find_spec(name) is not None
    }
