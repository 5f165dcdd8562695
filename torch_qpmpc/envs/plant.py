"""Plants with signals that are known in advance, such as prices and forecasts, or hidden.

    x+ = f(x, u, w),    y = h(x, w),    cost L(x, u, w)

x is the state, which may be hidden, y the measured output, and w the signals of a step: the known
ones d come first, then those that no controller sees, such as noise.
`PlantEnv` is a plant's TorchRL environment.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase, TransformedEnv

from torch_qpmpc.checks import check_whole
from torch_qpmpc.envs.kalman_filter import KalmanFilter
from torch_qpmpc.envs.linear_system import Actuated, Rng
from torch_qpmpc.envs.vectorised import VectorisedEnv
from torch_qpmpc.identification.innovations import Innovations

#: The number of different episodes of signals.
EPISODES = 1024


@dataclass(frozen=True, eq=False, kw_only=True)
class Plant(Actuated, ABC):
    """A plant in float64, and what its controller is shown.

    Args:
        lb_a, ub_a: bounds of the action, ``(n_u,)``.
        n_y, n_d: the numbers of outputs and of known signals.
        horizon: N; the controller sees the known signals d_k, .., d_{k+N}.
        observer: a model whose estimated state the controller sees in place of the output; None
            for the output.

    Raises:
        QPError: if a number is out of range.
    """

    n_y: int
    n_d: int = 0
    horizon: int = 1
    observer: Innovations | None = None

    def __post_init__(self) -> None:
        for name, least in (("n_y", 1), ("n_d", 0), ("horizon", 1)):
            check_whole(name, getattr(self, name), least)

    @property
    def n_x(self) -> int:
        """Entries of the output, or of the model's state, that a controller sees."""
        return self.n_y if self.observer is None else len(self.observer.A)

    @property
    def n_preview(self) -> int:
        """Entries of the known signals d_k, .., d_{k+N}."""
        return (self.horizon + 1) * self.n_d

    def observed(self, model: Innovations | None) -> Self:
        """Return this plant with the estimate of the state of ``model`` in place of the output."""
        return replace(self, observer=model)

    @abstractmethod
    def signals(self, rng: Rng, count: int, length: int) -> Tensor:
        """Draw the signals w of ``count`` episodes, ``(count, length, n_w)``, from ``rng``."""

    @abstractmethod
    def starts(self, rng: Rng, count: int) -> Tensor:
        """Draw start states ``(count, n_x)`` from ``rng``."""

    def output(self, x: Tensor, w: Tensor) -> Tensor:
        """Return y ``(*batch, n_y)`` from x ``(*batch, n_x)`` and w ``(*batch, n_w)``; here x."""
        return x

    @abstractmethod
    def cost(self, x: Tensor, u: Tensor, w: Tensor) -> Tensor:
        """Return L(x, u, w) ``(*batch,)``, of the applied u ``(*batch, n_u)``."""

    @abstractmethod
    def step(self, x: Tensor, u: Tensor, w: Tensor) -> Tensor:
        """Return x+ = f(x, u, w) ``(*batch, n_x)``, for the applied u."""

    def vectorised(self, num_envs: int, max_steps: int, seed: int) -> EnvBase:
        """Make a TorchRL environment of ``num_envs`` episodes of ``max_steps`` steps.

        Its observation is the output or, with an ``observer``, the estimate of its state. ``seed``
        seeds signals and starts.
        """
        env = PlantEnv(self, num_envs, max_steps, seed=seed)
        return env if self.observer is None else TransformedEnv(env, KalmanFilter(self.observer))


class PlantEnv(VectorisedEnv):
    """A TorchRL environment of ``num_envs`` episodes of a `Plant`, as in `VectorisedEnv`.

    It emits the output y as ``observation`` ``(num_envs, n_y)``, and the known signals d_k, ..,
    d_{k+N} as ``preview`` ``(num_envs, (N + 1) n_d)`` if there are any. The seed draws the signals
    of `EPISODES` episodes; each reset chooses one of them at random.
    """

    kind: ClassVar[type] = Plant

    def _entries(self) -> tuple[dict[str, Any], dict[str, Any]]:
        p = self.plant
        n_x = p.starts(torch.Generator(device=self.rng.device), 1).shape[-1]
        observed = {"observation": self._reals(p.n_y)}
        if p.n_d:
            observed["preview"] = self._reals(p.n_preview)
        hidden = {"state": self._reals(n_x, torch.float64), "episode": self._reals(1, torch.int64)}
        return observed, hidden

    def _set_seed(self, seed: int | None) -> None:
        super()._set_seed(seed)
        length = self.max_steps + self.plant.horizon + 1
        self._signals = self.plant.signals(self.rng, EPISODES, length)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        x = self.plant.starts(self.rng, self.batch_size[0])
        count = self._zero_count()
        episode = torch.randint(EPISODES, count.shape, generator=self.rng, device=count.device)
        return self._observed(x, episode, count)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        x, u = tensordict["state"], self.plant.applied(tensordict["action"])
        episode, count = tensordict["episode"], tensordict["step_count"]
        w = self._signals[episode, count].squeeze(-2)
        out = self._observed(self.plant.step(x, u, w), episode, count + 1)
        return out.set("reward", -self.plant.cost(x, u, w).unsqueeze(-1).to(self.dtype))

    def _observed(self, x: Tensor, episode: Tensor, count: Tensor) -> TensorDict:
        p = self.plant
        w = self._signals[episode, count + torch.arange(p.horizon + 1, device=count.device)]
        shown = {"observation": p.output(x, w[:, 0])}
        if p.n_d:
            shown["preview"] = w[..., : p.n_d].flatten(-2)
        shown = {name: value.to(self.dtype) for name, value in shown.items()}
        return self._pack(count, state=x, episode=episode, **shown)
