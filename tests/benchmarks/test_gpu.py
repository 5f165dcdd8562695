"""The torch backend on a GPU, against DAQP on one core; skipped without a GPU."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import pytest
import torch

from tests.benchmarks.problems import PAPER, make_mpc, nudge, transitions
from tests.benchmarks.reference import WRONG, relative_error

pytest.importorskip("pytest_benchmark", reason="benchmarks need pip install '.[bench]'")

ROUNDS = 5


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.parametrize("batch", [4_096, 65_536])
def test_gpu(benchmark: Any, interleaved: Callable[..., Any], batch: int) -> None:
    """V of a whole batch, theta moved before each round, data at rest on the device."""
    states = transitions(PAPER.n_x, PAPER.n_u, batch).s
    on_core, on_gpu = (make_mpc(PAPER, dense=True, solver=name) for name in ("daqp", "torch"))
    on_gpu, there = on_gpu.cuda(), states.cuda()

    @torch.no_grad()
    def solve() -> torch.Tensor:
        value = on_gpu.value(there)
        torch.cuda.synchronize()
        return value

    values = interleaved(solve, rounds=ROUNDS, before=lambda: nudge(on_gpu))
    torch.set_num_threads(1)
    began = time.perf_counter()
    with torch.no_grad():
        expected = on_core.value(states)
    error = relative_error(values.cpu(), expected)
    benchmark.extra_info |= {
        "row": torch.cuda.get_device_name(),
        "batch": batch,
        "daqp_seconds": time.perf_counter() - began,
        "value_error": float(error.max()),
        "wrong": int((error > WRONG).sum()),
        "solved": batch,
    }
    assert error.max() < 1e-5
