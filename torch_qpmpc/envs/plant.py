"""Plants of which some signals are known in advance, such as prices and forecasts, or are hidden.

    x+ = f(x, u, w),    y = h(x, w),    cost L(x, u, w)

x is the state, which may be hidden, y the measured output, and w the signals of a step: the known
ones d come first, then those that no controller sees, such as noise.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torch_qpmpc.checks import check_tensor, check_whole
from torch_qpmpc.envs.linear_system import Rng, moved

if TYPE_CHECKING:
    from torchrl.envs import EnvBase


@dataclass(frozen=True, eq=False, kw_only=True)
class Plant(ABC):
    """A plant in float64, and what its controller is shown.

    Args:
        lb_a, ub_a: bounds of the action, ``(n_u,)``.
        n_y, n_d: the numbers of outputs and of known signals.
        horizon: N; the controller sees the known signals d_k, .., d_{k+N}.
        past: L; the controller sees the last L outputs and the L - 1 actions between them.

    Raises:
        QPError: if a number is out of range.
    """

    lb_a: Tensor
    ub_a: Tensor
    n_y: int
    n_d: int = 0
    horizon: int = 1
    past: int = 1

    def __post_init__(self) -> None:
        for name, least in (("n_y", 1), ("n_d", 0), ("horizon", 1), ("past", 1)):
            check_whole(name, getattr(self, name), least)

    @property
    def n_u(self) -> int:
        """Entries of the action."""
        return len(self.lb_a)

    @property
    def n_preview(self) -> int:
        """Entries of the known signals d_k, .., d_{k+N}."""
        return (self.horizon + 1) * self.n_d

    @property
    def n_p(self) -> int:
        """Entries of p, what a controller sees: the known signals, then the window."""
        return self.n_preview + self.past * self.n_y + (self.past - 1) * self.n_u

    def to(self, device: torch.device | str | None) -> Self:
        """Return the same plant with its tensors on ``device``."""
        return moved(self, device)

    @abstractmethod
    def signals(self, rng: Rng, count: int, length: int) -> Tensor:
        """Draw the signals w of ``count`` episodes, ``(count, length, n_w)``, from ``rng``."""

    @abstractmethod
    def starts(self, rng: Rng, count: int) -> Tensor:
        """Draw start states ``(count, n_x)`` from ``rng``."""

    @abstractmethod
    def output(self, x: Tensor, w: Tensor) -> Tensor:
        """Return y ``(*batch, n_y)`` from x ``(*batch, n_x)`` and w ``(*batch, n_w)``."""

    @abstractmethod
    def cost(self, x: Tensor, u: Tensor, w: Tensor) -> Tensor:
        """Return L(x, u, w) ``(*batch,)``, of the applied u ``(*batch, n_u)``."""

    @abstractmethod
    def step(self, x: Tensor, u: Tensor, w: Tensor) -> Tensor:
        """Return x+ = f(x, u, w) ``(*batch, n_x)``, for the applied u."""

    def violation(self, x: Tensor, w: Tensor) -> Tensor:
        """Return how far ``x`` is outside its bounds under ``w``, summed, ``(*batch,)``; here 0."""
        return x.new_zeros(x.shape[:-1])

    def applied(self, a: Tensor) -> Tensor:
        """Return the applied action: a ``(*batch, n_u)``, clipped to its bounds."""
        check_tensor("a", a, self.n_u)
        return a.to(self.lb_a).clamp(self.lb_a, self.ub_a)

    def true_model(self) -> tuple[Tensor, Tensor, Tensor] | None:
        """Return A, B and the offset of a linear model of the outputs; here None."""
        return None

    def violations(self, batch: TensorDictBase) -> Tensor:
        """Return the `violation` of each transition of a collected ``batch``."""
        return batch["violation"]

    def vectorised(
        self, num_envs: int, max_steps: int, seed: int, episodes: int | None = None
    ) -> EnvBase:
        """Make a TorchRL environment of ``num_envs`` episodes of ``max_steps`` steps.

        Its observation is the window of the last ``past`` outputs and the actions between them.
        ``seed`` seeds signals and starts; ``episodes`` is as in `PlantEnv`.
        """
        from torchrl.envs import TransformedEnv

        from torch_qpmpc.envs.past_window import PastWindow
        from torch_qpmpc.envs.plant_env import EPISODES, PlantEnv

        env = PlantEnv(self, num_envs, max_steps, seed=seed, episodes=episodes or EPISODES)
        return env if self.past == 1 else TransformedEnv(env, PastWindow(self.past))
