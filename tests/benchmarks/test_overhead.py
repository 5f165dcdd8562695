"""The share of a gradient's time outside the solver's calls, and the policy's speed."""

from __future__ import annotations

import time
from collections.abc import Callable
from statistics import median
from typing import Any

import pytest
import torch

from tests.benchmarks.contenders import cold, warm
from tests.benchmarks.problems import PAPER, make_mpc, nudge, transitions
from torch_qpmpc.qp.pipeline.batch import Programs
from torch_qpmpc.qp.solvers import BACKENDS

pytest.importorskip("pytest_benchmark", reason="benchmarks need pip install '.[bench]'")

STARTS = {"": cold, ", warm": warm}
#: Approximate seconds of a measurement, long enough to average a shared machine's load.
SECONDS = 5.0


def rounds_of(timed: Callable[[], object]) -> int:
    """Return the number of rounds that take about `SECONDS`, between 50 and 1,000."""
    timed()  # the first one may compile
    began = time.perf_counter()
    timed()
    return min(1000, max(50, round(SECONDS / (time.perf_counter() - began))))


@pytest.mark.parametrize("batch", [32, 256])
@pytest.mark.parametrize("start", STARTS, ids=["cold", "warm"])
@pytest.mark.parametrize("solver", BACKENDS)
def test_share_outside_the_solver(
    benchmark: Any,
    interleaved: Callable[..., Any],
    monkeypatch: pytest.MonkeyPatch,
    solver: str,
    start: str,
    batch: int,
) -> None:
    """A backend's call includes its Python loop around the solver's own code."""
    inside, shares = [], []

    def timed(solve: Callable[..., Any]) -> Callable[..., Any]:
        def timed_solve(*arguments: Any) -> Any:
            began = time.perf_counter()
            answer = solve(*arguments)
            inside.append(time.perf_counter() - began)
            return answer

        return timed_solve

    monkeypatch.setattr(Programs, "recalled", timed(Programs.recalled))
    monkeypatch.setitem(BACKENDS, solver, timed(BACKENDS[solver]))
    gradient = STARTS[start](
        make_mpc(PAPER, dense=True, solver=solver),
        transitions(PAPER.n_x, PAPER.n_u, 256).first(batch),
    )

    def step() -> int:
        inside.clear()
        began = time.perf_counter()
        gradient.step()
        shares.append(1 - sum(inside) / (time.perf_counter() - began))
        return len(inside)

    rounds = rounds_of(step)
    calls = interleaved(step, rounds=rounds, warmup=2, before=lambda: nudge(gradient.mpc))
    benchmark.extra_info |= {
        "row": solver + start,
        "batch": batch,
        "outside": median(shares[-rounds:]),
    }
    assert calls >= 2  # for V and for Q: nothing else is timed


@pytest.mark.parametrize("solver", BACKENDS)
def test_decisions(benchmark: Any, interleaved: Callable[..., Any], solver: str) -> None:
    """Time the collection loop's policy on batches of 32 with constant theta."""
    mpc = make_mpc(PAPER, dense=True, solver=solver)
    states = transitions(PAPER.n_x, PAPER.n_u, 32).s

    @torch.no_grad()
    def decide() -> torch.Tensor:
        return mpc.policy(states)

    actions = interleaved(decide, rounds=rounds_of(decide), warmup=5)
    benchmark.extra_info |= {"row": solver, "batch": 32}
    for i in (0, 31):
        alone = mpc.policy(states[i : i + 1])
        assert torch.allclose(actions[i], alone[0], atol=1e-5)
