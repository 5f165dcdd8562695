"""A double integrator whose actuator multiplies its action by noise.

    x+ = A x + B u (1 + xi) + e,    y = x,    L(x, u) = 1/2 [x; u]' W [x; u]

xi and e are normal and independent in time, with mean 0: the mean of x+ is that of a known linear
model, but a large action makes the next state uncertain. Without active bounds the optimal policy
is linear (Wonham, "Optimal stationary control of a linear system with state-dependent noise", SIAM
J. Control 1967; de Koning, "Infinite horizon optimal control of linear discrete time systems with
stochastic parameters", Automatica 1982); see `noisy_stage_weight`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
import torch.nn.functional as F
from torch import Tensor

from torch_qpmpc.checks import check_number, check_whole
from torch_qpmpc.envs.linear_system import Rng, float64, normal, uniform
from torch_qpmpc.envs.plant import Plant


@dataclass(frozen=True, eq=False, kw_only=True)
class ActuatorNoise(Plant):
    """The physics in float64; x is the position and the velocity.

    Args:
        horizon, past: N and L, as in `Plant`.
        A, B: dynamics ``(2, 2)`` and ``(2, 1)`` with steps of 0.2.
        W: weight of the cost, ``(3, 3)``.
        lb_a, ub_a: bounds of the action ``(1,)``, to which it is clipped before the noise.
        actuator_std: standard deviation of xi.
        noise_std: standard deviation of e, per entry.

    Raises:
        QPError: if a standard deviation is negative or not finite.

    Example:
        >>> import torch
        >>> plant = ActuatorNoise()
        >>> x, u, w = torch.zeros(2).double(), torch.ones(1).double(), torch.zeros(3).double()
        >>> plant.step(x, u, w)
        tensor([0.0200, 0.2000], dtype=torch.float64)
    """

    n_y: int = field(default=2, init=False)
    n_d: int = field(default=0, init=False)
    A: Tensor = field(default_factory=float64([1, 0.2], [0, 1]))
    B: Tensor = field(default_factory=float64([0.02], [0.2]))
    W: Tensor = field(default_factory=float64([1, 0, 0], [0, 0.1, 0], [0, 0, 0.01]))
    lb_a: Tensor = field(default_factory=float64(-10))
    ub_a: Tensor = field(default_factory=float64(10))
    actuator_std: float = 1.2
    noise_std: float = 0.02

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("actuator_std", "noise_std"):
            value = getattr(self, name)
            check_number(name, value, lambda x: 0 <= x < math.inf, "a finite number >= 0")

    def signals(self, rng: Rng, count: int, length: int) -> Tensor:
        """Draw xi and e, ``(count, length, 3)``."""
        std = self.A.new_tensor([self.actuator_std, self.noise_std, self.noise_std])
        return std * normal(rng, count, length, 3)

    def starts(self, rng: Rng, count: int) -> Tensor:
        """Draw start states ``(count, 2)`` uniform in [-1, 1]."""
        return 2 * uniform(rng, count, 2) - 1

    def cost(self, x: Tensor, u: Tensor, w: Tensor) -> Tensor:
        v = torch.cat((x, u), -1)
        return 0.5 * ((v @ self.W) * v).sum(-1)

    def output_cost(self, y: Tensor, u: Tensor, d: Tensor) -> Tensor:
        return self.cost(y, u, d)

    def step(self, x: Tensor, u: Tensor, w: Tensor) -> Tensor:
        return x @ self.A.mT + (1 + w[..., :1]) * u @ self.B.mT + w[..., 1:]

    def true_model(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return A, B and a zero offset, the model of the mean."""
        return self.A, self.B, self.A.new_zeros(2)


@dataclass(frozen=True, eq=False, kw_only=True)
class HiddenVelocity(ActuatorNoise):
    """The integrator of which only the position is measured, by an Euler step of 0.2.

        p+ = p + 0.2 v,    v+ = v + 0.2 u (1 + xi) + e,    y = p

    Two positions show the last step's velocity, but what the noise has done since is seen a step
    later. No more can be known than the window [p_{k-1}, u_{k-1}, p_k], and its mean is that of a
    linear model: the optimal policy is linear in it; see `noisy_stage_weight` with a delay of 1.
    The velocity has no cost, and is zero at a start.

    Args:
        horizon: N, at least 2, as an action moves the position two steps later.
        A, B, W, lb_a, ub_a, actuator_std: as in `ActuatorNoise`.
        noise_std: standard deviation of e, of the velocity.

    Raises:
        QPError: as in `ActuatorNoise`, or the horizon is 1.
    """

    n_y: int = field(default=1, init=False)
    past: int = field(default=2, init=False)
    horizon: int = 2
    B: Tensor = field(default_factory=float64([0], [0.2]))
    W: Tensor = field(default_factory=float64([1, 0, 0], [0, 0, 0], [0, 0, 0.01]))

    def __post_init__(self) -> None:
        super().__post_init__()
        check_whole("horizon", self.horizon, 2)

    def signals(self, rng: Rng, count: int, length: int) -> Tensor:
        """Draw xi and e, ``(count, length, 3)``, without noise of the position."""
        return super().signals(rng, count, length) * self.A.new_tensor([1, 0, 1])

    def starts(self, rng: Rng, count: int) -> Tensor:
        """Draw start states ``(count, 2)`` at rest, with positions uniform in [-1, 1]."""
        return super().starts(rng, count) * self.A.new_tensor([1, 0])

    def output(self, x: Tensor, w: Tensor) -> Tensor:
        return x[..., :1]

    def output_cost(self, y: Tensor, u: Tensor, d: Tensor) -> Tensor:
        return self.cost(F.pad(y, (0, 1)), u, d)

    def true_model(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return [A_1, A_2], [B_1, B_2] and a zero offset, the model of the position's mean."""
        push = self.A[:1, 1:] @ self.B[1:]
        return self.A.new_tensor([[2, -1]]), F.pad(push, (1, 0)), self.A.new_zeros(1)
