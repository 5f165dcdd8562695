"""Four tanks that track references, which are known in advance (learning-qp's quadruple tank).

    x+ = (A + dA) x + (B + dB) u + v,    y = x
    L(x, u, r) = |x - r|^2 + 0.1 |u|^2 + price violation(x)

From Lu, Li, Zhou, Li and Mo, "MPC-inspired reinforcement learning for verifiable model-free
control" (L4DC 2024, arXiv 2312.05332). Their code, github.com/yiwenlu66/learning-qp at 4e52b4d,
has these rules (src/envs/env_creators.py and linear_system.py):

* A, B, the bounds of x and u, and the ranges of starts, references, dA and dB; u is clipped.
* The reference is constant for an episode of at most 500 steps (run.py).
* L without the violation is the cost in their tables, as a mean over steps.
* A state outside its bounds ends the episode, at a price of 100,000. Here the episode goes on, and
  each unit of violation costs ``price``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torch_qpmpc.checks import check_number, check_whole
from torch_qpmpc.envs.linear_system import Rng, float64, normal, uniform
from torch_qpmpc.envs.plant import Plant

#: Entries of w: the reference, v, the entries 11, 22, 13 and 24 of dA, and the relative dB of each
#: pump.
SIGNALS = (4, 4, 4, 2)


@dataclass(frozen=True, eq=False, kw_only=True)
class TankReferences(Plant):
    """The physics in float64. The known signals are the reference r ``(4,)``.

    Args:
        horizon, past: N and L, as in `Plant`.
        A, B: nominal dynamics ``(4, 4)`` and ``(4, 2)``.
        lb_x, ub_x: soft bounds of the state, ``(4,)``.
        lb_a, ub_a: bounds of the action, ``(2,)``.
        price: price of a unit of violation.
        noise_std: standard deviation of v, per entry; 0.1 in the original's disturbed variant.
        mismatch: scale of dA and dB, which are constant for an episode; 1 in the original's
            disturbed variant: entries of dA uniform in +-0.002, pump gains in +-2 %. What leaks
            more from an upper tank arrives in the lower one: dA_33 = -dA_13, dA_44 = -dA_24.
        hold: steps for which a reference is held.

    Raises:
        QPError: if a number is negative or not finite.

    Example:
        >>> import numpy as np
        >>> plant = TankReferences()
        >>> plant.signals(np.random.default_rng(0), 3, 10).shape
        torch.Size([3, 10, 14])
    """

    n_y: int = field(default=4, init=False)
    n_d: int = field(default=4, init=False)
    horizon: int = 16
    past: int = 1
    A: Tensor = field(
        default_factory=float64(
            [0.984, 0, 0.0422029, 0],
            [0, 0.98895, 0, 0.0326014],
            [0, 0, 0.957453, 0],
            [0, 0, 0, 0.967216],
        )
    )
    B: Tensor = field(
        default_factory=float64(
            [0.825822, 0.0101995], [0.00512673, 0.624648], [0, 0.468317], [0.307042, 0]
        )
    )
    lb_x: Tensor = field(default_factory=float64(0, 0, 0, 0))
    ub_x: Tensor = field(default_factory=float64(20, 20, 20, 20))
    lb_a: Tensor = field(default_factory=float64(0, 0))
    ub_a: Tensor = field(default_factory=float64(8, 8))
    price: float = 1000.0
    noise_std: float = 0.0
    mismatch: float = 0.0
    hold: int = 500

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("price", "noise_std", "mismatch"):
            value = getattr(self, name)
            check_number(name, value, lambda x: 0 <= x < math.inf, "a finite number >= 0")
        check_whole("hold", self.hold, 1)

    def weights(self) -> tuple[Tensor, Tensor]:
        """Return Q ``(4,)`` and R ``(2,)`` of L = (x - r)'Q(x - r) + u'Ru + price violation(x)."""
        return self.A.new_ones(4), self.A.new_full((2,), 0.1)

    def target(self, w: Tensor) -> Tensor:
        """Return the reference for signals w ``(*batch, 14)``, ``(*batch, 4)``."""
        return w[..., :4]

    def model(self, w: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return A + dA, B + dB and v of the step with signals w ``(*batch, 14)``.

        They have shapes ``(*batch, 4, 4)``, ``(*batch, 4, 2)`` and ``(*batch, 4)``.
        """
        _, v, dA, gains = w.split(SIGNALS, -1)
        A = self.A.expand(*w.shape[:-1], 4, 4).clone()
        for entry, (row, column) in enumerate(((0, 0), (1, 1), (0, 2), (1, 3))):
            A[..., row, column] += dA[..., entry]
        A[..., 2, 2] -= dA[..., 2]
        A[..., 3, 3] -= dA[..., 3]
        return A, self.B * (1 + gains.unsqueeze(-2)), v

    def signals(self, rng: Rng, count: int, length: int) -> Tensor:
        blocks = -(-length // self.hold)
        r = 20 * uniform(rng, count, blocks, 4).repeat_interleave(self.hold, 1)[:, :length]
        limits = self.mismatch * self.A.new_tensor([0.002] * 4 + [0.02] * 2)
        constant = (limits * (2 * uniform(rng, count, 1, 6) - 1)).expand(-1, length, -1)
        v = self.noise_std * normal(rng, count, length, 4)
        return torch.cat((r, v, constant), -1)

    def starts(self, rng: Rng, count: int) -> Tensor:
        """Draw start states ``(count, 4)`` uniform in [0, 16], from where no bound need be hit."""
        return 16 * uniform(rng, count, 4)

    def cost(self, x: Tensor, u: Tensor, w: Tensor) -> Tensor:
        Q, R = self.weights()
        tracking = (x - self.target(w)).square() @ Q + u.square() @ R
        return tracking + self.price * self.violation(x, w)

    def output_cost(self, y: Tensor, u: Tensor, d: Tensor) -> Tensor:
        return self.cost(y, u, d)

    def step(self, x: Tensor, u: Tensor, w: Tensor) -> Tensor:
        A, B, v = self.model(w)
        return (A @ x.unsqueeze(-1) + B @ u.unsqueeze(-1)).squeeze(-1) + v

    def violation(self, x: Tensor, w: Tensor) -> Tensor:
        return ((self.lb_x - x).relu() + (x - self.ub_x).relu()).sum(-1)
