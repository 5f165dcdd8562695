"""The QP's cost of theta (eq:qpH): discounts of the stages, of x_N and of the slack weights."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.func import functional_call
from torch.testing import assert_close

from tests.problems import MIXED, normal, random_mpc
from torch_qpmpc import QPMPC, Layout, QPError

GAMMA, N = 0.7, 3
OPTIONS: dict[str, dict[str, Any]] = {
    "free": {},
    "tied": {"structure": "tied"},
    "discounted slacks": {"discount_slack": True, **MIXED},
    "projected": {"step": "projection"},
    "weights of each stage": {"stage_weight": normal(3, 3).abs()},
    "block": {"hessian": "block"},
}


def example(name: str) -> QPMPC:
    return random_mpc(4, learn=("H", "H_f", "q", "w", "C"), gamma=GAMMA, **OPTIONS[name])


@pytest.mark.parametrize("name", OPTIONS)
def test_the_cost_is_the_discounted_sum_of_the_stages(name):
    mpc = example(name)
    qp, z = mpc.quadratic_program(), normal(mpc.n_z)
    stages, x_N = z[:-2].reshape(N, 3), z[-2:]
    H = torch.diag_embed(mpc.H) if mpc.hessian == "diagonal" else mpc.H
    H_f = torch.diag(mpc.H_f) if mpc.hessian == "diagonal" else mpc.H_f
    H, q = H.expand(N, 3, 3), mpc.q
    total = GAMMA**N * (0.5 * x_N @ H_f @ x_N + q[-2:] @ x_N)
    for k, x in enumerate(stages):
        total = total + GAMMA**k * (0.5 * x @ H[k] @ x + q[3 * k : 3 * k + 3] @ x)
    assert_close(0.5 * z @ qp.H @ z + qp.q @ z, total)


@pytest.mark.parametrize("discounted", [True, False])
def test_slack_weights_are_discounted_on_request_and_hard_rows_stay_hard(discounted):
    mpc = random_mpc(4, learn=("w",), gamma=GAMMA, discount_slack=discounted, **MIXED)
    stage = torch.tensor([0, 0, 0, 1, 1, 1, 2, 2, 2, 3, 3, *(0, 0, 1, 1, 2, 2), 3])
    expected = mpc.w * (GAMMA**stage if discounted else 1)
    assert_close(mpc.quadratic_program().w, expected.masked_fill(~mpc.soft, torch.inf))
    assert (~mpc.soft).any()


@pytest.mark.parametrize("name", OPTIONS)
def test_its_gradients_pass_finite_differences(name):
    mpc = example(name)
    names, start = zip(*mpc.named_parameters(), strict=True)

    class Cost(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.mpc = mpc

        def forward(self) -> Tensor:
            qp = self.mpc.quadratic_program()
            finite = (x[x.isfinite()] for x in (qp.H, qp.q, qp.w))
            return torch.stack([normal(len(x), seed=len(x)) @ x for x in finite]).sum()

    def cost(*theta: Tensor) -> Tensor:
        return functional_call(
            Cost(), {f"mpc.{x}": y for x, y in zip(names, theta, strict=True)}, ()
        )

    assert torch.autograd.gradcheck(cost, [x.detach().clone().requires_grad_() for x in start])


# Sizes


def test_sizes_are_whole_numbers_of_any_kind():
    sizes: Any = (np.int64(2), 1, np.int32(3))
    layout = Layout(*sizes)
    assert layout == Layout(2, 1, 3)
    assert type(layout.n_x) is int


@pytest.mark.parametrize(
    ("sizes", "message"),
    [
        ({"n_x": 0}, "n_x: got 0, expected a positive integer"),
        ({"n_u": 1.5}, "n_u: got 1.5, expected a positive integer"),
        ({"horizon": "3"}, "horizon: got '3', expected a positive integer"),
        ({"past": 0}, "past: got 0, expected a positive integer"),
        ({"n_d": -1}, "n_d: got -1, expected a whole number >= 0"),
        ({"n_mixed": 1.0}, "n_mixed: got 1.0, expected a whole number >= 0"),
    ],
)
def test_bad_sizes_are_named(sizes, message):
    with pytest.raises(QPError, match=message):
        Layout(**({"n_x": 2, "n_u": 1, "horizon": 3} | sizes))
