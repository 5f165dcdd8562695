"""What plants with a quadratic cost and soft bounds of outputs share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torch_qpmpc.envs.plant import Plant


@dataclass(frozen=True, eq=False, kw_only=True)
class QuadraticPlant(Plant):
    """The stage cost 1/2 v'W v + q'v + c + price violation(y), in float64.

    Args:
        W, q, c: the cost, ``(n, n)``, ``(n,)`` and ``()``.
        lb_y, ub_y: soft bounds of the output, ``(n_y,)``.
        price: the price of a unit of violation.
        labels: names of the entries of y, u and d, for figures.
    """

    W: Tensor
    q: Tensor
    c: Tensor
    lb_y: Tensor
    ub_y: Tensor
    price: float = 0.0
    labels: tuple[Sequence[str], Sequence[str], Sequence[str]] = ((), (), ())

    def output_cost(self, y: Tensor, u: Tensor, d: Tensor) -> Tensor:
        return self._cost_of(torch.cat((d, y, u.to(y)), -1), self._violation_of(y))

    def _cost_of(self, v: Tensor, violation: Tensor) -> Tensor:
        return (v @ self.W * v).sum(-1) / 2 + v @ self.q + self.c + self.price * violation

    def _violation_of(self, y: Tensor) -> Tensor:
        return ((self.lb_y - y).relu() + (y - self.ub_y).relu()).sum(-1)
