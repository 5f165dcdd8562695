"""``task=inventory``: orders under random demand, learned from the plan for the mean demand."""

from __future__ import annotations

from functools import partial

import torch
from omegaconf import DictConfig
from torch import Tensor

from torch_qpmpc.envs import Inventory
from torch_qpmpc.envs.closed_loop import plant_loop
from torch_qpmpc.envs.linear_system import float64
from torch_qpmpc.experiment.tasks.registry import (
    Task,
    named,
    plant_layout,
    priced,
    register,
)
from torch_qpmpc.mpc.bounds import Bounds
from torch_qpmpc.mpc.cost import Cost
from torch_qpmpc.mpc.model import Model
from torch_qpmpc.mpc.scheme import Scheme

#: Closed loops of an evaluation.
STARTS = 64
#: The largest order; the mean demand is 5.
CAPACITY = 6.5
#: Stocks, in mean demands, below which a row has a price. Of the start only 0 has the plant's.
KINKS = (-1.2, -0.6, 0.0, 0.6, 1.2, 1.8, 2.4, 3.0, 3.6)
#: The price of the other rows: all of them together cost less than holding a unit.
PRICE = 0.1
#: The curvature that makes the plan unique.
CURVATURE = 1e-3


def make_plant(cfg: DictConfig) -> Inventory:
    return Inventory(horizon=cfg.task.horizon, ub_a=float64(CAPACITY)())


def wrong_scheme(cfg: DictConfig, plant: Inventory) -> Scheme:
    """Return MPC with the true mean and the plant's cost, with rows to learn its mean by."""
    kinks = plant.mean * torch.tensor(KINKS).double()
    return _scheme(cfg, plant, kinks, [_price(plant) if x == 0 else PRICE for x in KINKS])


def true_scheme(cfg: DictConfig, plant: Inventory) -> Scheme:
    """Return the same plan with the optimal safety stock, which orders up to `base_stock`."""
    safety = plant.base_stock() - 2 * plant.mean
    return _scheme(cfg, plant, torch.tensor([safety]).double(), [_price(plant)])


def _price(plant: Inventory) -> float:
    return plant.holding + plant.backlog


def _scheme(cfg: DictConfig, plant: Inventory, kinks: Tensor, prices: list[float]) -> Scheme:
    """Make the scheme that pays ``holding`` for each unit, and prices below each of the kinks."""
    A, B, offset = plant.true_model()
    weight = A.new_full((3,), CURVATURE)
    stock = torch.zeros(len(kinks), 3).to(A)
    stock[:, 0] = 1
    free = torch.full_like(kinks, torch.inf)
    bounds = Bounds(
        action_bounds=(plant.lb_a, plant.ub_a),
        constraints=(stock, kinks, free),
        terminal_constraints=(stock[:, :2], kinks, free),
        constraint_slack=2 * prices,
    )
    layout = plant_layout(plant, cfg.task.horizon)
    q = A.new_tensor([plant.holding, 0, 0]).repeat(cfg.task.horizon + 1)[: layout.n_z]
    cost = Cost(weight, weight[:2], hessian=cfg.task.hessian, q=q)
    return Scheme(layout, Model(A, B, offset=offset), cost, priced(cfg, bounds), cfg.task.gamma)


register(
    Task(
        "inventory",
        make_plant,
        wrong_scheme,
        true_scheme,
        closed_loop=partial(plant_loop, starts=STARTS),
        nominal_scheme=wrong_scheme,
        episode=named(("stock", "on order"), ("new order",)),
        defaults=None,
    )
)
