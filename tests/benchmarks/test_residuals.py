"""One Q-learning gradient of 256 transitions, each with its own theta, beside a shared theta's."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch

from tests.benchmarks.problems import GAMMA, PAPER, make_mpc, nudge, transitions

pytest.importorskip("pytest_benchmark", reason="benchmarks need pip install '.[bench]'")

BATCH = 256
#: Bound of the residuals, small enough that hard rows stay feasible.
SIZE = 1e-3


@pytest.mark.parametrize("warm", [False, True], ids=["cold", "warm"])
@pytest.mark.parametrize("parts", [("q", "b", "c"), ("H",), ("C",)], ids="-".join)
def test_gradient_with_residuals(
    benchmark: Any, interleaved: Callable[..., Any], parts: tuple[str, ...], warm: bool
) -> None:
    mpc, data = make_mpc(PAPER, dense=True, solver="daqp"), transitions(4, 2, BATCH)
    generator = torch.Generator().manual_seed(0)

    def residuals() -> dict[str, torch.Tensor]:
        shapes = {name: mpc.coordinates()[name].shape for name in parts}
        return {
            name: (SIZE * torch.rand(BATCH, *shape, generator=generator)).requires_grad_()
            for name, shape in shapes.items()
        }

    pair, starts = (residuals(), residuals()), {}

    def gradient(own: tuple[Any, Any]) -> None:
        mpc.zero_grad()
        (q_start, v_start), (at, following) = starts.get(own[0] is None, (None, None)), own
        qp = mpc.quadratic_program(at)
        now = mpc.solve(data.s, data.a, q_start, qp)
        with torch.no_grad():
            qp = mpc.quadratic_program(following)
            after = mpc.solve(data.following, warm_start=v_start, qp=qp)
        (data.cost + GAMMA * after.value - now.value).square().mean().backward()
        if warm:
            starts[own[0] is None] = now.active, after.active

    interleaved(
        lambda: gradient(pair),
        rounds=40 if parts[0] == "q" else 5,
        warmup=2,
        before=lambda: nudge(mpc),
        reference=lambda: gradient((None, None)),
    )
    benchmark.extra_info |= {"row": f"residuals of {', '.join(parts)}", "warm": warm}
