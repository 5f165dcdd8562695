"""A small plant with previews, hidden states and noise: a store that is filled by price."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, field

import torch
from torch import Tensor

from torch_qpmpc.envs import Plant
from torch_qpmpc.envs.linear_system import Rng, float64, normal, uniform


@dataclass(frozen=True, eq=False)
class Store(Plant):
    """A level l and a pump v, of which only l is measured, with prices and demands known ahead.

    v+ = 0.5 v + 0.5 u,    l+ = l + v - demand + noise,    y = l + noise

    w is [price, demand, noise of the level, noise of the output].
    """

    std: float = 0.01
    _: KW_ONLY
    lb_a: Tensor = field(default_factory=float64(0))
    ub_a: Tensor = field(default_factory=float64(1))
    n_y: int = 1
    n_d: int = 2
    horizon: int = 3
    past: int = 2

    def signals(self, rng: Rng, count: int, length: int) -> Tensor:
        known, noise = uniform(rng, count, length, 2), normal(rng, count, length, 2)
        return torch.cat((known, self.std * noise), -1)

    def starts(self, rng: Rng, count: int) -> Tensor:
        level = 1 + uniform(rng, count, 1)
        return torch.cat((level, torch.zeros_like(level)), -1)

    def output(self, x: Tensor, w: Tensor) -> Tensor:
        return x[..., :1] + w[..., 3:]

    def cost(self, x: Tensor, u: Tensor, w: Tensor) -> Tensor:
        return w[..., 0] * u[..., 0] + self.violation(x, w)

    def step(self, x: Tensor, u: Tensor, w: Tensor) -> Tensor:
        level, pump = x[..., 0], x[..., 1]
        level = level + pump - w[..., 1] + w[..., 2]
        return torch.stack((level, 0.5 * (pump + u[..., 0])), -1)

    def violation(self, x: Tensor, w: Tensor) -> Tensor:
        return (1 - x[..., 0]).relu() + (x[..., 0] - 2).relu()
