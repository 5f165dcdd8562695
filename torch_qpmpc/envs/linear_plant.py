"""Linear plants whose outputs are measured with noise, with a quadratic cost.

x+ = A x + B u + v,    y = C x + e
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torch_qpmpc.envs.linear_system import Rng, normal, uniform
from torch_qpmpc.envs.quadratic_plant import QuadraticPlant


@dataclass(frozen=True, eq=False, kw_only=True)
class LinearPlant(QuadraticPlant):
    """The physics in float64. The signals w are v ``(n,)`` and e ``(n_y,)``; both are hidden.

        L(x, u) = 1/2 z'W z + q'z + c + price violation(x),    z = [C x; u]

    Starts are the smallest states whose outputs are drawn from a box, or are nearest to that draw.

    Args:
        A, B, C: ``(n, n)``, ``(n, n_u)`` and ``(n_y, n)``.
        V: the factor of v, which is V times normal numbers, ``(n, k)``.
        std: standard deviations of e, ``(n_y,)``.
        W, q, c: the cost, ``(n_y + n_u, n_y + n_u)``, ``(n_y + n_u,)`` and ``()``.
        lb_y, ub_y: soft bounds of C x, ``(n_y,)``.
        first: lower and upper bounds of the outputs of starts, ``(2, n_y)``.
        price: the price of a unit of violation.
        labels: names of the entries of y, u and d, for figures.

    Example:
        >>> one = torch.ones(1, 1).double()
        >>> box = {"lb_a": -one[0], "ub_a": one[0], "lb_y": -one[0], "ub_y": one[0]}
        >>> cost = {"W": torch.eye(2).double(), "q": torch.zeros(2).double(), "c": 0 * one[0, 0]}
        >>> noise = {"V": 0 * one, "std": 0 * one[0], "first": torch.stack((0 * one[0], one[0]))}
        >>> plant = LinearPlant(A=0.9 * one, B=one, C=one, n_y=1, **box, **cost, **noise)
        >>> plant.step(one[0], one[0], torch.zeros(2))
        tensor([1.9000], dtype=torch.float64)
    """

    A: Tensor
    B: Tensor
    C: Tensor
    V: Tensor
    std: Tensor
    first: Tensor

    def signals(self, rng: Rng, count: int, length: int) -> Tensor:
        """Draw w = [v, e], ``(count, length, n + n_y)``."""
        v = normal(rng, count, length, self.V.shape[1]) @ self.V.mT
        return torch.cat((v, self.std * normal(rng, count, length, self.n_y)), -1)

    def starts(self, rng: Rng, count: int) -> Tensor:
        low, high = self.first
        return (low + (high - low) * uniform(rng, count, self.n_y)) @ torch.linalg.pinv(self.C).mT

    def output(self, x: Tensor, w: Tensor) -> Tensor:
        return x @ self.C.mT + w[..., -self.n_y :]

    def cost(self, x: Tensor, u: Tensor, w: Tensor) -> Tensor:
        """Return L(x, u) ``(*batch,)``, which does not depend on w."""
        z = torch.cat((x @ self.C.mT, u.to(x)), -1)
        return self._cost_of(z, self.violation(x, w))

    def step(self, x: Tensor, u: Tensor, w: Tensor) -> Tensor:
        return x @ self.A.mT + u.to(x) @ self.B.mT + w[..., : -self.n_y]

    def violation(self, x: Tensor, w: Tensor) -> Tensor:
        return self._violation_of(x @ self.C.mT)
