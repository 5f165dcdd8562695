"""A stock of one product, whose orders arrive two steps later, under random demand.

    x+ = x + o - d,    o+ = u,    L(x) = holding max(x, 0) + backlog max(-x, 0)

x is the stock, negative if demand waits, o the order that arrives next, and u the new order. The
demand d is log-normal and independent in time. The mean of x+ is that of a known linear model, but
a plan for the mean demand keeps no safety stock.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from torch_qpmpc.checks import check_number
from torch_qpmpc.envs.linear_system import Rng, float64, normal
from torch_qpmpc.envs.plant import Plant

#: Steps of the demand of which `Inventory.base_stock` takes a quantile, in parallel and in time.
EPISODES, WARM_UP, STEPS = 1000, 200, 200


@dataclass(frozen=True, eq=False, kw_only=True)
class Inventory(Plant):
    """The physics in float64; a state is [x, o], and is measured.

    Args:
        horizon, past: N and L, as in `Plant`.
        lb_a, ub_a: bounds of the order ``(1,)``; the upper one is the supplier's capacity.
        mean: mean demand of a step.
        log_std: standard deviation of the demand's logarithm.
        holding, backlog: cost of a step for each unit in stock, and for each that is missing.

    Raises:
        QPError: if a number is not positive or not finite, or the capacity is at most the mean
            demand.

    Example:
        >>> import torch
        >>> plant = Inventory()
        >>> state, order, demand = (torch.tensor(x).double() for x in ([2.0, 4.0], [5.0], [7.0]))
        >>> plant.step(state, order, demand)
        tensor([-1.,  5.], dtype=torch.float64)
    """

    n_y: int = field(default=2, init=False)
    n_d: int = field(default=0, init=False)
    lb_a: Tensor = field(default_factory=float64(0))
    ub_a: Tensor = field(default_factory=float64(30))
    mean: float = 5.0
    log_std: float = 0.6
    holding: float = 1.0
    backlog: float = 9.0

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("mean", "log_std", "holding", "backlog"):
            value = getattr(self, name)
            check_number(name, value, lambda x: 0 < x < math.inf, "a finite number > 0")
        capacity = float(self.ub_a)
        check_number("ub_a", capacity, lambda x: x > self.mean, f"more than mean = {self.mean}")

    def signals(self, rng: Rng, count: int, length: int) -> Tensor:
        """Draw the demand, ``(count, length, 1)``."""
        z = normal(rng, count, length, 1)
        return self.mean * torch.exp(self.log_std * z - self.log_std**2 / 2)

    def starts(self, rng: Rng, count: int) -> Tensor:
        """Return the mean demand in stock and on order, ``(count, 2)``; nothing is drawn."""
        return self.lb_a.new_full((count, 2), self.mean)

    def cost(self, x: Tensor, u: Tensor, w: Tensor) -> Tensor:
        stock = x[..., 0]
        return self.holding * stock.relu() + self.backlog * (-stock).relu()

    def output_cost(self, y: Tensor, u: Tensor, d: Tensor) -> Tensor:
        return self.cost(y, u, d)

    def step(self, x: Tensor, u: Tensor, w: Tensor) -> Tensor:
        return torch.cat((x.sum(-1, keepdim=True) - w, u), -1)

    def violation(self, x: Tensor, w: Tensor) -> Tensor:
        """Return the demand that waits, ``(*batch,)``."""
        return (-x[..., 0]).relu()

    def true_model(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return A, B and the offset, the model of the mean."""
        as_A = self.lb_a.new_tensor
        return as_A([[1, 1], [0, 0]]), as_A([[0], [1]]), as_A([-self.mean, 0])

    def base_stock(self) -> float:
        """Return the level of stock and orders up to which it is optimal to order, S.

        With a capacity c the orders up to S leave a shortfall V+ = max(V + d - c, 0), whatever S
        is, and the stock two steps later is S - V - d - d'. The mean cost is least if S is the
        quantile ``backlog / (backlog + holding)`` of V + d + d' (Federgruen and Zipkin, "An
        inventory model with limited production capacity and uncertain demands", Mathematics of
        Operations Research 1986), here of a simulation.
        """
        demand = self.signals(np.random.default_rng(0), EPISODES, WARM_UP + STEPS + 2)[..., 0]
        capacity, short, levels = float(self.ub_a), torch.zeros(EPISODES).to(demand), []
        for k in range(WARM_UP + STEPS):
            if k >= WARM_UP:
                levels.append(short + demand[:, k] + demand[:, k + 1])
            short = (short + demand[:, k] - capacity).relu()
        return float(np.quantile(torch.cat(levels), self.backlog / (self.backlog + self.holding)))
