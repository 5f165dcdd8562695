"""Gains against the regulator."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from tests.problems import random_mpc
from torch_qpmpc import QPMPC
from torch_qpmpc.analysis.policy import local_gain, spectral_radius
from torch_qpmpc.mpc.riccati import lqr_gain, stage_weight

A = torch.tensor([[1.0, 0.2], [-0.1, 1.1]], dtype=torch.float64)
B = torch.tensor([[0.0, 0.1], [0.3, 0.1]], dtype=torch.float64)


def free_regulator(horizon: int = 4, **options: Any) -> QPMPC:
    """Make an MPC scheme with inactive bounds, which equals the regulator at any horizon."""
    weight = torch.diag(torch.tensor([2.0, 1.0, 0.3, 0.5])) + 0.1
    settings: dict[str, Any] = {"gamma": 0.9, "stage_weight": weight, "solver": "daqp"}
    return QPMPC.linear_mpc(A, B, horizon, **(settings | options))


def test_gain_at_one_state_leaves_no_gradient():
    mpc = random_mpc()
    with torch.no_grad():
        K = local_gain(mpc, torch.zeros(2))
    assert K.shape == (1, 2)
    assert not K.requires_grad
    assert all(p.grad is None for p in mpc.parameters())


@pytest.mark.parametrize("horizon", [1, 4])
def test_an_mpc_scheme_with_riccati_terminal_cost_is_the_regulator(horizon):
    mpc = free_regulator(horizon)
    K = lqr_gain(A, B, stage_weight(mpc), 0.9)
    torch.testing.assert_close(local_gain(mpc, torch.zeros(2).double()), K, rtol=1e-7, atol=1e-7)
    assert spectral_radius(A, B, K) < 0.9**-0.5


def test_the_regulator_minimises_the_discounted_cost():
    """Its gain is a fixed point of policy improvement."""
    W, gamma = stage_weight(free_regulator()), 0.9
    K = lqr_gain(A, B, W, gamma)
    closed, pair = A - B @ K, torch.cat((torch.eye(2).double(), -K))
    P = torch.zeros(2, 2).double()
    for _ in range(2000):
        P = pair.mT @ W @ pair + gamma * closed.mT @ P @ closed
    next_pair = torch.cat((A, B), dim=-1)
    of_pairs = W + gamma * next_pair.mT @ P @ next_pair
    improved = torch.linalg.solve(of_pairs[2:, 2:], of_pairs[2:, :2])
    torch.testing.assert_close(improved, K, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("hessian", ["diagonal", "block", "full"])
def test_stage_weight_is_that_of_the_first_pair(hessian):
    weight = torch.tensor([2.0, 1.0, 0.3, 0.5])
    mpc = QPMPC.from_model(A, B, 3, hessian=hessian, stage_weight=weight, learn=("H", "C"))
    torch.testing.assert_close(stage_weight(mpc), torch.diag(weight).double())


def test_spectral_radius():
    diagonal = torch.diag(torch.tensor([0.5, -1.2])).double()
    nothing = torch.zeros(2, 2).double()
    assert spectral_radius(diagonal, B, nothing).item() == pytest.approx(1.2)
    rotation = torch.tensor([[0.0, -0.9], [0.9, 0.0]]).double()
    both = spectral_radius(torch.stack((diagonal, rotation)), B, nothing)
    assert both.tolist() == pytest.approx([1.2, 0.9])
