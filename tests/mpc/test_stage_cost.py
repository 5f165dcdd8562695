from typing import Any

import cvxpy as cp
import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from tests.problems import normal
from torch_qpmpc.mpc.stage_cost import StageCost, fit_stage_cost


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
    assert_close(found.W, W, rtol=1e-9, atol=1e-9)
    assert_close(cost_of(found, v), cost_of(true, v))
    assert abs(found.R2 - 1) < 1e-9
    assert torch.equal(found(v), cost_of(found, v))


@pytest.mark.filterwarnings("ignore:The fitted stage cost explains")
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


def test_a_constant_entry_and_a_constant_cost_have_no_weight():
    v = arguments()
    v[:, 1] = 7.0
    found = fit_stage_cost(v, v[:, 0].square())
    assert (found.W[1] == 0).all()
    assert found.q[1] == 0
    found = fit_stage_cost(v, torch.full((300,), 5.0).double())
    assert found.W.abs().max() < 1e-12
    assert_close(cost_of(found, v), torch.full((300,), 5.0).double())


@pytest.mark.parametrize("steps", [20, 100, 200])  # entries up to 5, 1,800 and 3e6
@pytest.mark.parametrize("weights", [(2.0, 0.2, 0.02), (2.0, 0.0, 0.02), (2.0, 0.2, 0.0)])
def test_a_log_that_an_unstable_direction_dominates_gives_the_cost(steps, weights):
    A, B = torch.tensor([[1.0, 0.1], [0.1, 0.95]]).double(), torch.tensor([0.0, 0.2]).double()
    random, rows = torch.Generator().manual_seed(0), []
    s = 2 * torch.rand(20, 2, generator=random, dtype=torch.float64) - 1
    for _ in range(steps):
        u = 2 * torch.rand(20, 1, generator=random, dtype=torch.float64) - 1
        rows.append(torch.cat((s, u), 1))
        s = s @ A.mT + u * B
    true = StageCost(torch.diag(torch.tensor(weights).double()), torch.zeros(3), torch.zeros(()))
    v = torch.cat(rows)
    found = fit_stage_cost(v, (v @ true.W * v).sum(-1) / 2)
    assert_close(found.W, true.W, rtol=1e-9, atol=1e-9)
    if steps < 200:  # noise of 1e-3 is less than the rounding of costs of 1e13
        found = fit_stage_cost(v, (v @ true.W * v).sum(-1) / 2 + 1e-3 * normal(len(v)))
        assert_close(found.W, true.W, rtol=0, atol=3e-3)


@pytest.mark.parametrize("offset", [0.0, 100.0])
@pytest.mark.parametrize("correlation", [0.0, 0.99, 0.99999])
@pytest.mark.parametrize("units", [[1e-3] * 4, [1e6] * 4, [1e-3, 1.0, 1e3, 1e6]])
def test_a_cost_without_noise_is_found_in_all_units(units, correlation, offset):
    common, own = (
        correlation**0.5 * normal(500, 1, seed=1),
        (1 - correlation) ** 0.5 * normal(500, 4),
    )
    root, q, size = normal(4, 4, seed=2), normal(4, seed=3), torch.tensor(units).double()
    x = common + own + offset
    true = StageCost(root @ root.mT, q, torch.tensor(3.0))
    found = fit_stage_cost(x * size, cost_of(true, x))
    assert_close(found.W * size * size.unsqueeze(-1), true.W, rtol=1e-6, atol=1e-6)
    assert_close(found.q * size, q, rtol=1e-6, atol=1e-6)


@pytest.mark.filterwarnings("ignore:The fitted stage cost explains")
@pytest.mark.parametrize("offset", [0.0, 300.0])
def test_columns_that_are_collinear_up_to_rounding_get_small_coefficients(offset):
    """Three phase currents in float32 sum to zero."""
    y = normal(2000, 2).float() + offset
    y = torch.cat((y, -y.sum(1, keepdim=True)), 1)
    v = torch.cat((y, 2 * torch.rand(2000, 1) - 1), 1).double()
    found = fit_stage_cost(v, (v - v.mean(0))[:, :3].abs().sum(1) + normal(2000))
    assert found.W.abs().max() < 10
    assert ((v.mean(0) @ found.W + found.q).abs() < 10).all()


@pytest.mark.parametrize("cost", [(3 * normal(300)).sin(), normal(300), normal(300)[:15]])
def test_a_poor_fit_has_a_low_R2(cost):
    assert not fit_stage_cost(arguments()[: len(cost)], cost).R2 > 0.9
