from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

import train
from tests.runs import SMALL, make_config
from torch_qpmpc.qp.solvers import BACKENDS

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


@pytest.fixture(scope="session")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two sweeps of small finished runs; seed 4 starts without a gap worth closing."""
    folder = tmp_path_factory.mktemp("runs")
    runs = [("small", "gaussian", case, seed) for case in ("fixed", "free") for seed in (1, 4)]
    for sweep, noise, case, seed in [*runs, ("small", "brownian", "free", 1)]:
        settings = (f"constraint={case}", f"noise={noise}", f"seed={seed}", "task.eval_steps=50")
        place = folder / sweep / f"{noise}-{case}-seed{seed}"
        train.train(make_config(*SMALL, *settings), str(place), quiet=True)
    for c_2 in (0.0, 0.5):
        settings = (f"constraint.deviation.c_2={c_2}", "task.eval_steps=50")
        train.train(make_config(*SMALL, *settings), str(folder / "weights" / f"{c_2}"), quiet=True)
    return folder
