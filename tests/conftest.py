from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch

from torch_qpmpc.solvers import BACKENDS

# Test workers side by side are the parallelism; threads of each would only wait for one another.
torch.set_num_threads(1)


@pytest.fixture(params=[*BACKENDS, "qpsolvers:clarabel"])
def solver(request: pytest.FixtureRequest) -> str:
    """The name of each backend in turn."""
    return request.param


@pytest.fixture
def two_threads() -> Iterator[None]:
    """Let torch, and with it ProxQP, use two threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)
