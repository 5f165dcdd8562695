"""The rivals of nonlinear MPC, and the tables."""

from types import SimpleNamespace

import pandas as pd
import pytest
import torch
from torch.testing import assert_close

from tests.benchmarks.nonlinear import MANY, PLANTS, CrossEntropy, gaps, on_plant, rivals
from tests.benchmarks.plants import swing

BOUNDS = SimpleNamespace(lb_a=-torch.ones(1).double(), ub_a=torch.ones(1).double())


def test_the_cross_entropy_method_finds_the_plan_of_least_cost():
    p = torch.tensor([[0.3], [-2.0]]).double()
    policy = CrossEntropy(
        lambda p, u: (u - p[:, None, None]).square().sum((2, 3)), BOUNDS, 2, MANY, 0
    )
    for _ in range(3):
        found = policy(p)
    assert_close(found, torch.tensor([[0.3], [-1.0]]).double(), rtol=0, atol=0.02)


def test_plans_on_the_plant_begin_with_the_observed_state():
    angle = torch.tensor(3.0).double()
    y = torch.stack((torch.tensor(0.5), torch.tensor(0.1), angle.cos(), angle.sin(), angle / 3))
    plans = torch.tensor([[[2.0], [-1.0]]]).double()
    s, first = swing((0.5, 0.1, 3.0, 1.0), 2.0)
    J = on_plant(PLANTS["Cart-pole"], y[None].double(), plans[None])
    assert J.item() == pytest.approx(first + swing(s, -1.0)[1], rel=1e-6)


def test_tables_have_every_seed_and_the_share_of_the_gap():
    def row(plant, design, seed, J, transitions=0, chosen=""):
        own = {"plant": plant, "design": design, "seed": seed, "J": J, "chosen": chosen}
        return own | {"seconds": 1e-3, "transitions": transitions, "steps": float("nan")}

    rows = [row("Pendulum", "TD3", seed, 100.0 + seed, 20_000) for seed in (1, 2, 3)]
    rows += [row("Pendulum", "TD3", 1, 90.0, 100_000)]
    rows += [row("Unicycle", "optimum", 1, 2.0), row("Unicycle", "zero action", 1, 12.0)]
    rows += [row("Unicycle", "`start=data`", seed, 2.0 + seed, 2_000, "one") for seed in (1, 2, 3)]
    text = rivals(pd.DataFrame(rows))
    assert "| TD3 | 101.0/102.0/103.0 | 1.00 |  |  | 20,000 |" in text
    assert "| TD3 | 90.00 | 1.00 |  |  | 100,000 |" in text
    expected = "| Unicycle | 2.000 | 12.00 | 3.000/4.000/5.000 | 0.2 | one/one/one |"
    assert expected in gaps(pd.DataFrame(rows))
