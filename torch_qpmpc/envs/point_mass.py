"""The paper's point mass (section "Point-Mass"), with its Gymnasium environment.

s+ = A s + B a + nu,    s = [x, y, vx, vy],    a = [F_x, F_y],    L(s, a) = s'Ws
"""

from dataclasses import KW_ONLY, dataclass, field
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from torch_qpmpc.checks import NONNEGATIVE, check_choice, check_number, check_seed, check_tensor
from torch_qpmpc.envs.linear_system import (
    LinearSystem,
    LinearSystemGymEnv,
    Rng,
    float64,
    normal,
    uniform,
)

#: Standard deviation of the noise by kind, which the paper does not specify.
NOISE_STD = {"gaussian": 0.01, "brownian": 0.002}


@dataclass(frozen=True, eq=False)
class PointMass(LinearSystem):
    """The physics in float64, to which methods convert their tensors.

    Args:
        noise_kind: ``"gaussian"`` (independent in time) or ``"brownian"`` (a random walk over the
            episode, from 0 at its start).
        noise_std: standard deviation per state of the Gaussian noise, or of the random walk's
            increments; None for :data:`NOISE_STD`.
        start_position, start_velocity: episodes start uniformly within plus or minus these.
        A, B, W: dynamics ``(4, 4)``, ``(4, 2)`` and weight of the cost ``(4, 4)``.
        lb_s, ub_s, lb_a, ub_a: bounds of the state ``(4,)`` and of the action ``(2,)``, to which
            both are clipped.

    Raises:
        QPError: if ``noise_kind`` is unknown, a tensor does not fit, or ``noise_std`` or a start
            range is negative or not finite.

    Example:
        >>> import torch
        >>> physics = PointMass(noise_std=0.0)
        >>> s, a = torch.tensor([1.0, 0.0, 0.0, 0.0]), torch.tensor([-2.0, 0.0])  # clipped to -1
        >>> physics.step(s, a, nu=torch.zeros(4)), physics.cost(s, a)
        (tensor([ 1.0000,  0.0000, -0.1000,  0.0000], dtype=torch.float64),
         tensor(3., dtype=torch.float64))
    """

    stream: ClassVar[int] = 0  # that of the published results
    noise_kind: str = "gaussian"
    noise_std: float | None = None
    start_position: float = 1.5
    start_velocity: float = 0.5
    _: KW_ONLY
    A: Tensor = field(
        default_factory=float64([1, 0, 0.1, 0], [0, 1, 0, 0.1], [0, 0, 0.9, 0], [0, 0, 0, 0.9])
    )
    B: Tensor = field(default_factory=float64([0, 0], [0, 0], [0.1, 0], [0, 0.1]))
    W: Tensor = field(
        default_factory=float64([3, 0, 0, 0], [0, 3, 0, 0], [0, 0, 0.25, 0], [0, 0, 0, 0.25])
    )
    lb_s: Tensor = field(default_factory=float64(-2, -2, -10, -10))
    ub_s: Tensor = field(default_factory=float64(2, 2, 10, 10))
    lb_a: Tensor = field(default_factory=float64(-1, -1))
    ub_a: Tensor = field(default_factory=float64(1, 1))

    def __post_init__(self) -> None:
        super().__post_init__()
        check_tensor("W", self.W, *self.A.shape, batched=False)
        for name in ("start_position", "start_velocity"):
            check_number(name, getattr(self, name), *NONNEGATIVE)
        check_choice("noise_kind", self.noise_kind, tuple(NOISE_STD))
        remedy = "Pass 0 for no noise, None for the default."
        check_number("noise_std", self.std, *NONNEGATIVE, remedy)

    @property
    def std(self) -> float:
        """The noise's standard deviation: ``noise_std``, or the default of its kind."""
        return NOISE_STD[self.noise_kind] if self.noise_std is None else self.noise_std

    @property
    def start_range(self) -> Tensor:
        """The half-widths ``(4,)`` of the start distribution."""
        p, v = self.start_position, self.start_velocity
        return self.A.new_tensor([p, p, v, v])

    def cost(self, s: Tensor, a: Tensor) -> Tensor:
        """Return L(s, a) = s'Ws ``(*batch,)`` of the current s ``(*batch, 4)``; a has no effect."""
        s = check_tensor("s", s, len(self.W)).to(self.W)
        return ((s @ self.W) * s).sum(-1)

    def starts(self, rng: Rng, count: int) -> Tensor:
        """Draw start states ``(count, 4)`` from ``rng``.

        A NumPy generator draws all positions, then all velocities; a torch generator, whole states.
        """
        if isinstance(rng, torch.Generator):
            return self.start_range * (2 * uniform(rng, count, 4) - 1)
        ranges = (self.start_position, self.start_velocity)
        return torch.cat([2 * r * uniform(rng, count, 2) - r for r in ranges], -1).to(self.A)

    def draw(self, rng: Rng, count: int) -> Tensor:
        """Draw standard normal numbers ``(count, 4)`` from ``rng``."""
        return normal(rng, count, 4)

    def noise(self, nu: Tensor, draw: Tensor) -> Tensor:
        """Return the next nu ``(*batch, 4)`` from the last one and a standard normal ``draw``."""
        step = self.std * draw.to(self.A)
        return nu.to(self.A) + step if self.noise_kind == "brownian" else step

    def corrupted(self, seed: int) -> tuple[Tensor, Tensor, Tensor]:
        """Draw by ``seed`` the wrong model that learning starts from, and the initial cost.

        Returns:
            A_hat ``(4, 4)`` and B_hat ``(4, 2)``, the true ones plus entries uniform in
            [-0.05, 0.05], and theta_1..theta_4 ``(4,)`` uniform in [0.5, 5]; drawn in this order.
        """
        check_seed(seed)
        rng = np.random.default_rng(seed)
        dA, dB = (rng.uniform(-0.05, 0.05, size=tuple(M.shape)) for M in (self.A, self.B))
        theta = rng.uniform(0.5, 5, size=4)
        as_A = self.A.new_tensor
        return self.A + as_A(dA), self.B + as_A(dB), as_A(theta)


class PointMassGymEnv(LinearSystemGymEnv):
    """``torch_qpmpc/PointMass-v0``, which never terminates and is truncated at 50 steps."""

    def __init__(self, plant: PointMass | None = None) -> None:
        super().__init__(PointMass() if plant is None else plant)
