from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch

from tests.benchmarks.interleaved import Interleaved


@pytest.fixture(autouse=True)
def thread_count() -> Iterator[None]:
    """What a benchmark does to torch's thread count ends with it."""
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.fixture
def interleaved(benchmark: Any) -> Callable[..., Any]:
    """`Interleaved.run` on pytest-benchmark's fixture."""
    return Interleaved(benchmark).run
