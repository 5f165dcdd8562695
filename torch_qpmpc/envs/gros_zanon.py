"""Gros and Zanon's linear system.

    s+ = A s + B a + [e, 0],    e uniform in (-0.1, 0),    s_0 = [0, 0.15]

From "Data-driven economic NMPC using reinforcement learning" (IEEE TAC 2020, arXiv 1904.04152). The
package mpcrl uses it in its example of on-policy Q-learning.
"""

from dataclasses import KW_ONLY, dataclass, field
from typing import ClassVar

import torch
from torch import Tensor

from torch_qpmpc.checks import NONNEGATIVE, check_number, check_tensor
from torch_qpmpc.envs.linear_system import LinearSystem, Rng, float64, uniform


@dataclass(frozen=True, eq=False)
class GrosZanonLTI(LinearSystem):
    """The physics in float64, to which methods convert their tensors.

    The cost is least at the origin, a corner of the state bounds, and the noise pushes the state
    out of them.

    Args:
        w: weight of the violation in the cost.
        A, B: dynamics ``(2, 2)`` and ``(2, 1)``.
        lb_s, ub_s: soft bounds of the state ``(2,)``, to which it is not clipped.
        lb_a, ub_a: bounds of the action ``(1,)``, to which it is clipped.

    Raises:
        QPError: if ``w`` is negative or not finite, or a tensor does not fit.
    """

    clips_states: ClassVar[bool] = False
    stream: ClassVar[int] = 0  # that of the published results

    w: float = 100.0
    _: KW_ONLY
    A: Tensor = field(default_factory=float64([0.9, 0.35], [0, 1.1]))
    B: Tensor = field(default_factory=float64([0.0813], [0.2]))
    lb_s: Tensor = field(default_factory=float64(0, -1))
    ub_s: Tensor = field(default_factory=float64(1, 1))
    lb_a: Tensor = field(default_factory=float64(-1))
    ub_a: Tensor = field(default_factory=float64(1))

    def __post_init__(self) -> None:
        super().__post_init__()
        remedy = "Pass 0 for a cost without the violation."
        check_number("w", self.w, *NONNEGATIVE, remedy)

    def cost(self, s: Tensor, a: Tensor) -> Tensor:
        """Return L(s, a) = 1/2 (|s|^2 + 1/2 a^2 + w violation(s)) ``(*batch,)``, with a clipped."""
        x, u = check_tensor("s", s, len(self.A)).to(self.A), self.applied(a)
        squares = x.square().sum(-1) + u.square().sum(-1) / 2
        return (squares + self.w * self.violation(s)) / 2

    def starts(self, rng: Rng, count: int) -> Tensor:
        """Return ``count`` copies of s_0, ``(count, 2)``, without drawing from ``rng``."""
        return self.A.new_tensor([[0, 0.15]]).repeat(count, 1)

    def draw(self, rng: Rng, count: int) -> Tensor:
        """Draw numbers uniform in [0, 1) from ``rng``, ``(count, 1)``, one per episode."""
        return uniform(rng, count, 1)

    def noise(self, nu: Tensor, draw: Tensor) -> Tensor:
        """Return [e, 0] ``(*batch, 2)``, with e = 0.1 ``draw`` - 0.1, uniform in [-0.1, 0)."""
        e = -0.1 + 0.1 * draw.to(self.A)
        return torch.cat((e, torch.zeros_like(e)), -1)

    def mean_noise(self) -> Tensor:
        """Return [-0.05, 0]."""
        return self.noise(torch.zeros_like(self.lb_s), self.A.new_tensor([0.5]))
