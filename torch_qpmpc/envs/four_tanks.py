"""Four tanks whose two lower levels are measured with noise, driven to a constant set point.

    x+ = A x + B u + v,    y = [x_1, x_2] + e,    L(x, u) = 35 |y - r|^2 + 1e-4 |u - u_r|^2

L is that of the noiseless outputs. The model is the linearised one of Berberich, Köhler, Müller and
Allgöwer, "Data-driven model predictive control with stability and robustness guarantees" (IEEE TAC
2021, arXiv 1906.04679).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torch_qpmpc.checks import check_number
from torch_qpmpc.envs.linear_system import Rng, float64, normal
from torch_qpmpc.envs.plant import Plant


@dataclass(frozen=True, eq=False, kw_only=True)
class FourTanks(Plant):
    """The physics in float64. The signals w are v ``(4,)`` and e ``(2,)``; both are hidden.

    Args:
        horizon, past: N and L, as in `Plant`.
        A, B: dynamics ``(4, 4)`` and ``(4, 2)``.
        r: set point of the outputs, ``(2,)``.
        lb_a, ub_a: bounds of the action, ``(2,)``.
        state_std, output_std: standard deviations of v and e, per entry.

    Raises:
        QPError: if a standard deviation is negative or not finite.

    Example:
        >>> plant = FourTanks()
        >>> x, u = plant.set_point()
        >>> plant.cost(x, u, torch.zeros(6))
        tensor(0., dtype=torch.float64)
    """

    n_y: int = field(default=2, init=False)
    n_d: int = field(default=0, init=False)
    horizon: int = 20
    past: int = 10
    A: Tensor = field(
        default_factory=float64(
            [0.921, 0, 0.041, 0], [0, 0.918, 0, 0.033], [0, 0, 0.924, 0], [0, 0, 0, 0.937]
        )
    )
    B: Tensor = field(
        default_factory=float64([0.017, 0.001], [0.001, 0.023], [0, 0.061], [0.072, 0])
    )
    r: Tensor = field(default_factory=float64(0.65, 0.77))
    lb_a: Tensor = field(default_factory=float64(-2, -2))
    ub_a: Tensor = field(default_factory=float64(2, 2))
    state_std: float = 0.01
    output_std: float = 0.1

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("state_std", "output_std"):
            std = getattr(self, name)
            check_number(name, std, lambda x: 0 <= x < math.inf, "a finite number >= 0")

    def weights(self) -> tuple[Tensor, Tensor]:
        """Return Q ``(2,)`` and R ``(2,)`` of L = (y - r)'Q(y - r) + (u - u_r)'R(u - u_r)."""
        return self.r.new_full((2,), 35.0), self.r.new_full((2,), 1e-4)

    def set_point(self) -> tuple[Tensor, Tensor]:
        """Return x_r ``(4,)`` and u_r ``(2,)``, the steady state at which y = r."""
        gain = torch.linalg.solve(torch.eye(4).to(self.A) - self.A, self.B)
        u = torch.linalg.solve(gain[:2], self.r)
        return gain @ u, u

    def measurement(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return C ``(2, 4)`` of y = C x + e, and the covariances of v and e."""
        unit = torch.eye(4).to(self.A)
        return unit[:2], self.state_std**2 * unit, self.output_std**2 * unit[:2, :2]

    def target(self, w: Tensor) -> Tensor:
        """Return x_r for signals w ``(*batch, 6)``, ``(*batch, 4)``."""
        return self.set_point()[0].expand(*w.shape[:-1], -1)

    def model(self, w: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return A, B and v ``(*batch, 4)`` of the step with signals w ``(*batch, 6)``."""
        return self.A, self.B, w[..., :4]

    def signals(self, rng: Rng, count: int, length: int) -> Tensor:
        """Draw w ``(count, length, 6)``; a greater length only adds steps at the end."""
        std = [self.state_std] * 4 + [self.output_std] * 2
        return normal(rng, length, count, 6).movedim(0, 1) * self.A.new_tensor(std)

    def starts(self, rng: Rng, count: int) -> Tensor:
        """Return ``count`` zeros ``(count, 4)``, without drawing from ``rng``."""
        return self.A.new_zeros(count, 4)

    def output(self, x: Tensor, w: Tensor) -> Tensor:
        return x[..., :2] + w[..., 4:]

    def cost(self, x: Tensor, u: Tensor, w: Tensor) -> Tensor:
        """Return L(x, u) ``(*batch,)``, which does not depend on w."""
        Q, R = self.weights()
        _, u_r = self.set_point()
        return (x[..., :2] - self.r).square() @ Q + (u - u_r).square() @ R

    def output_cost(self, y: Tensor, u: Tensor, d: Tensor) -> Tensor:
        return self.cost(y, u, d)

    def step(self, x: Tensor, u: Tensor, w: Tensor) -> Tensor:
        A, B, v = self.model(w)
        return x @ A.mT + u @ B.mT + v
