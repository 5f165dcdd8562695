"""A stock of one product, whose orders arrive two steps later, under random demand.

    x+ = x + o - d,    o+ = u,    cost = holding max(x, 0) + backlog max(-x, 0)

x is the stock, negative if demand waits, o the order that arrives next, u the new order, of at most
6.5, and d a log-normal demand with mean 5. A known linear model predicts the mean of x+, but a
plan for the mean demand keeps no safety stock. The rows of the QP give V kinks at nine stocks, so
that its prices can follow the expected cost.

    python train.py task.file=docs/examples/inventory.py
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from torch_qpmpc import Bounds, Cost, Model, Scheme
from torch_qpmpc.envs.linear_system import float64, normal
from torch_qpmpc.envs.plant import Plant
from torch_qpmpc.experiment.tasks import Task, plant_layout, priced, register

STARTS = 64  # closed loops of an evaluation
KINKS = (-1.2, -0.6, 0.0, 0.6, 1.2, 1.8, 2.4, 3.0, 3.6)  # in mean demands; 0 has the plant's price
PRICE = 0.1  # of the other rows: all of them together cost less than holding a unit
CURVATURE = 1e-3  # makes the plan unique
EPISODES, WARM_UP, STEPS = 1000, 200, 200  # of the simulation in `Inventory.base_stock`


@dataclass(frozen=True, eq=False, kw_only=True)
class Inventory(Plant):
    """The state [x, o] is measured; the signal w is the demand."""

    n_y: int = 2
    lb_a: Tensor = field(default_factory=float64(0))
    ub_a: Tensor = field(default_factory=float64(6.5))
    mean: float = 5.0
    log_std: float = 0.6
    holding: float = 1.0
    backlog: float = 9.0

    def signals(self, rng, count, length):
        z = normal(rng, count, length, 1)
        return self.mean * torch.exp(self.log_std * z - self.log_std**2 / 2)

    def starts(self, rng, count):
        return self.lb_a.new_full((count, 2), self.mean)

    def cost(self, x, u, w):
        return self.holding * x[..., 0].relu() + self.backlog * (-x[..., 0]).relu()

    def step(self, x, u, w):
        return torch.cat((x.sum(-1, keepdim=True) - w, u), -1)

    def base_stock(self):
        """Return the level of stock and orders up to which it is optimal to order.

        A quantile of the demand of two steps and of the shortfall that the capacity leaves
        (Federgruen and Zipkin, Mathematics of Operations Research 1986), by simulation.
        """
        demand = self.signals(np.random.default_rng(0), EPISODES, WARM_UP + STEPS + 2)[..., 0]
        capacity, short, levels = float(self.ub_a), torch.zeros(EPISODES).to(demand), []
        for k in range(WARM_UP + STEPS):
            if k >= WARM_UP:
                levels.append(short + demand[:, k] + demand[:, k + 1])
            short = (short + demand[:, k] - capacity).relu()
        return float(np.quantile(torch.cat(levels), self.backlog / (self.backlog + self.holding)))


def wrong_scheme(cfg, plant):
    """Return MPC with the true mean and the plant's cost, with rows to learn its mean by."""
    own = plant.holding + plant.backlog
    kinks = plant.mean * torch.tensor(KINKS).double()
    return scheme(cfg, plant, kinks, [own if x == 0 else PRICE for x in KINKS])


def true_scheme(cfg, plant):
    """Return the same plan with the optimal safety stock, which orders up to the base stock."""
    safety = torch.tensor([plant.base_stock() - 2 * plant.mean]).double()
    return scheme(cfg, plant, safety, [plant.holding + plant.backlog])


def scheme(cfg, plant, kinks, prices):
    """Make the scheme that pays ``holding`` for each unit, and prices below each of the kinks."""
    A, B = torch.tensor([[1.0, 1.0], [0.0, 0.0]]).double(), torch.tensor([[0.0], [1.0]]).double()
    weight, stock, free = A.new_full((3,), CURVATURE), A.new_zeros(len(kinks), 3), kinks + torch.inf
    stock[:, 0] = 1
    bounds = Bounds(
        action_bounds=(plant.lb_a, plant.ub_a),
        constraints=(stock, kinks, free),
        terminal_constraints=(stock[:, :2], kinks, free),
        constraint_slack=2 * prices,
    )
    layout = plant_layout(plant, cfg.task.horizon)
    q = A.new_tensor([plant.holding, 0, 0]).repeat(cfg.task.horizon + 1)[: layout.n_z]
    cost = Cost(weight, weight[:2], hessian=cfg.task.hessian, q=q)
    model = Model(A, B, offset=A.new_tensor([-plant.mean, 0]))
    return Scheme(layout, model, cost, priced(cfg, bounds), cfg.task.gamma)


def episode(plant, d):
    return {"outputs": ["stock", "on order"], "actions": ["new order"]}


# daqp refines the vertices of the start in double-double precision, which takes longer.
OPTIONS = {"solver": "torch", "steps_per_update": 4, "warmup_steps": 40, "updates": 60}
OPTIONS |= {"batch_size": 1024, "eval_interval": 20, "exploration_std": 3.0, "gate": False}
# The prices start near zero, where the root of a price hardly moves.
OPTIONS |= {"step": "projection", "td_error_clip": None}
OPTIONS |= {"defaults": [{"override /constraint": "fixed"}]}
TASK = {"horizon": 3, "gamma": 0.95, "episode_steps": 100, "eval_steps": 100}
TASK |= {"hessian": "diagonal", "learn_cost": ["H", "H_f", "c", "w"], "discount_slack": True}
register(
    Task(
        "inventory",
        lambda cfg: Inventory(horizon=cfg.task.horizon),
        wrong_scheme,
        true_scheme,
        starts=STARTS,
        nominal_scheme=wrong_scheme,
        episode=episode,
        defaults={**OPTIONS, "task": TASK},
    )
)
