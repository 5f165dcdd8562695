from __future__ import annotations

from typing import Any

import cvxpy as cp
import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from torch_qpmpc.mpc.stage_cost import StageCost, fit_stage_cost


def normal(*size: int, seed: int = 0) -> Tensor:
    random = torch.Generator().manual_seed(seed)
    return torch.randn(size, generator=random, dtype=torch.float64)


def arguments(n: int = 4) -> Tensor:
    return normal(300, n) * torch.tensor([1.0, 10.0, 0.1, 2.0])[:n] + 2


def cost_of(found: StageCost, v: Tensor) -> Tensor:
    return (v @ found.W * v).sum(-1) / 2 + v @ found.q + found.c


@pytest.mark.parametrize("n_free", [0, 2])
def test_a_convex_cost_is_found(n_free):
    root = normal(4, 4, seed=1)
    W = root @ root.mT
    if n_free:  # prices, for example, of any sign
        W[:n_free] = normal(n_free, 4, seed=2)
        W[:, :n_free] = W[:n_free].mT
        W[:n_free, :n_free] = torch.diag(torch.tensor([-1.0, 2.0])[:n_free])
    true, v = StageCost(W, normal(4, seed=3), torch.tensor(3.0)), arguments()
    found = fit_stage_cost(v, cost_of(true, v), n_free)
    assert_close(found.W, W, rtol=1e-3, atol=1e-3)
    assert_close(cost_of(found, v), cost_of(true, v), rtol=1e-4, atol=1e-2)


@pytest.mark.parametrize("diagonal", [False, True])
def test_another_cost_gets_the_best_convex_one(diagonal):
    v = arguments()
    x = (v - v.mean(0)) / v.std(0)
    cost = x[:, 0] * x[:, 1] - x[:, 2].square() + x[:, 3].square() + 0.3 * x[:, 3]
    found = fit_stage_cost(v, cost, diagonal=diagonal)
    assert torch.linalg.eigvalsh(found.W).min() >= -1e-12 * found.W.abs().max()
    assert_close(found.W, found.W.mT)
    W, q, c = cp.Variable((4, 4), PSD=True), cp.Variable(4), cp.Variable()
    products = np.einsum("mi,mj->mij", x, x).reshape(len(x), -1)
    error = products @ cp.vec(W, order="C") / 2 + x.numpy() @ q + c - cost.numpy()
    zeros: Any = [cp.diag(cp.diag(W)) == W] if diagonal else []
    problem = cp.Problem(cp.Minimize(cp.sum_squares(error)), zeros)
    problem.solve(solver="CLARABEL")
    ours = (cost_of(found, v) - cost).square().sum().item()
    assert ours == pytest.approx(problem.value, rel=1e-4)


def test_entries_on_a_circle_have_a_finite_weight():
    """The weight of cos^2 + sin^2 = 1 is not unique."""
    angle, speed = 3 * normal(400), normal(400, seed=1)
    v = torch.stack((angle.cos(), angle.sin(), speed), dim=-1)
    cost = 2 - 2 * v[:, 0] + 0.1 * speed.square()
    found = fit_stage_cost(v, cost)
    assert_close(cost_of(found, v), cost, rtol=1e-3, atol=1e-3)
    assert found.W.abs().max() < 10


def test_a_constant_entry_and_a_constant_cost_have_no_weight():
    v = arguments()
    v[:, 1] = 7.0
    found = fit_stage_cost(v, v[:, 0].square())
    assert (found.W[1] == 0).all()
    assert found.q[1] == 0
    found = fit_stage_cost(v, torch.full((300,), 5.0).double())
    assert found.W.abs().max() < 1e-12
    assert_close(cost_of(found, v), torch.full((300,), 5.0).double())
