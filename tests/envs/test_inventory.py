"""The inventory: dynamics, cost, demand and the optimal base stock, by hand and by simulation."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from torch_qpmpc.envs import Inventory
from torch_qpmpc.envs.closed_loop import plant_loop
from torch_qpmpc.errors import QPError


def test_an_order_arrives_after_two_steps():
    p, none = Inventory(), torch.zeros(1, 1).double()
    x = torch.tensor([[2.0, 0.0]]).double()
    demand = torch.tensor([[3.0]]).double()
    x = p.step(x, torch.tensor([[4.0]]).double(), demand)
    assert x.tolist() == [[-1, 4]]
    assert p.violation(x, demand).tolist() == [1]
    x = p.step(x, none, demand)
    assert x.tolist() == [[0, 0]]
    assert torch.equal(p.output(x, demand), x)


def test_the_cost_of_a_stock_and_of_a_backlog_by_hand():
    p = Inventory(holding=2.0, backlog=7.0)
    x = torch.tensor([[3.0, 9.0], [-0.5, 9.0]]).double()
    assert p.cost(x, x[:, :1], x[:, :1]).tolist() == [6, 3.5]


def test_demand_and_starts_have_their_distributions():
    p = Inventory(mean=4.0, log_std=0.5)
    for rng in (np.random.default_rng(0), torch.Generator().manual_seed(0)):
        d = p.signals(rng, 400, 100)
        assert d.mean().item() == pytest.approx(4.0, rel=0.01)
        assert d.log().std().item() == pytest.approx(0.5, rel=0.01)
        assert p.starts(rng, 2).tolist() == [[4, 4], [4, 4]]


def test_the_model_is_that_of_the_mean():
    p = Inventory()
    A, B, offset = p.true_model()
    x, u = torch.tensor([3.0, 2.0]).double(), torch.tensor([4.0]).double()
    d = p.signals(np.random.default_rng(0), 1, 20_000)[0]
    mean = p.step(x.expand(20_000, 2), u.expand(20_000, 1), d).mean(0)
    torch.testing.assert_close(mean, A @ x + B @ u + offset, atol=0.05, rtol=0)


def test_the_base_stock_of_an_unlimited_supply_is_the_quantile_of_two_demands():
    p = Inventory(ub_a=torch.tensor([1e6]).double())
    demand = p.signals(np.random.default_rng(5), 200_000, 2).sum((1, 2))
    assert p.base_stock() == pytest.approx(float(demand.quantile(0.9)), rel=0.01)


@pytest.mark.parametrize("capacity", [6.5, 30.0])
def test_no_other_base_stock_costs_less(capacity):
    p = Inventory(ub_a=torch.tensor([capacity]).double())

    def cost(S: float) -> float:
        loop = plant_loop(lambda p: S - p.sum(-1, keepdim=True), p, steps=400, starts=100)
        return loop.costs[100:].mean().item()

    best = p.base_stock()
    assert cost(best) < min(cost(0.85 * best), cost(1.15 * best))
    assert cost(best) < 1.01 * min(cost(0.95 * best), cost(1.05 * best))


@pytest.mark.parametrize("name", ["mean", "log_std", "holding", "backlog"])
def test_a_number_that_is_not_positive_is_refused(name):
    with pytest.raises(QPError, match=f"{name}: got 0, expected a finite number > 0"):
        Inventory(**dict[str, Any]({name: 0}))


def test_a_capacity_below_the_demand_is_refused():
    with pytest.raises(QPError, match=r"ub_a: got 4.0, expected more than mean = 5.0"):
        Inventory(ub_a=torch.tensor([4.0]).double())
