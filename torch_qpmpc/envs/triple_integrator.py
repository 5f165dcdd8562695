"""A chain of three integrators with a tight bound of its input, exactly known.

    x+ = A x + B u,    L(x, u) = 1/2 [x; u]' W [x; u],    |u| <= u_max

x is the position, the velocity and the acceleration. From many starts the input is at its bound for
more steps than a short horizon sees, and whoever brakes too late never settles.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from torch_qpmpc.envs.linear_system import Rng, float64, uniform
from torch_qpmpc.envs.plant import Plant

#: The largest absolute entries of a start.
REACH = (2.0, 1.0, 0.5)


@dataclass(frozen=True, eq=False, kw_only=True)
class TripleIntegrator(Plant):
    """The physics in float64.

    Args:
        horizon, past: N and L, as in `Plant`.
        A, B: dynamics ``(3, 3)`` and ``(3, 1)`` with steps of 0.2.
        W: weight of the cost, ``(4, 4)``.
        lb_a, ub_a: bounds of the action ``(1,)``, to which it is clipped.

    Example:
        >>> import torch
        >>> plant = TripleIntegrator()
        >>> x, u = torch.zeros(3).double(), torch.ones(1).double()
        >>> plant.step(x, u, x[:0])
        tensor([0.0013, 0.0200, 0.2000], dtype=torch.float64)
    """

    n_y: int = field(default=3, init=False)
    n_d: int = field(default=0, init=False)
    A: Tensor = field(default_factory=float64([1, 0.2, 0.02], [0, 1, 0.2], [0, 0, 1]))
    B: Tensor = field(default_factory=float64([0.2**3 / 6], [0.02], [0.2]))
    W: Tensor = field(
        default_factory=float64([1, 0, 0, 0], [0, 0.1, 0, 0], [0, 0, 0.01, 0], [0, 0, 0, 0.01])
    )
    lb_a: Tensor = field(default_factory=float64(-1))
    ub_a: Tensor = field(default_factory=float64(1))

    def signals(self, rng: Rng, count: int, length: int) -> Tensor:
        """Return no signals, ``(count, length, 0)``."""
        return self.A.new_zeros(count, length, 0)

    def starts(self, rng: Rng, count: int) -> Tensor:
        """Draw start states ``(count, 3)`` uniform within `REACH`."""
        return (2 * uniform(rng, count, 3) - 1) * self.A.new_tensor(REACH)

    def cost(self, x: Tensor, u: Tensor, w: Tensor) -> Tensor:
        v = torch.cat((x, u), -1)
        return 0.5 * ((v @ self.W) * v).sum(-1)

    def output_cost(self, y: Tensor, u: Tensor, d: Tensor) -> Tensor:
        return self.cost(y, u, d)

    def step(self, x: Tensor, u: Tensor, w: Tensor) -> Tensor:
        return x @ self.A.mT + u @ self.B.mT

    def true_model(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return A, B and a zero offset."""
        return self.A, self.B, self.A.new_zeros(3)
