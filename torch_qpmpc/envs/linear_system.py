"""Linear systems s+ = A s + B a + nu, with their Gymnasium and TorchRL environments.

A concrete plant defines the cost L, the noise nu and the starts. Rewards are -L(s, a).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Self

import gymnasium
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torch_qpmpc.checks import check_kind, check_tensor
from torch_qpmpc.envs.vectorised import VectorisedEnv
from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.validation import as_tensor

#: A random generator: torch's in the TorchRL environments, numpy's in the Gymnasium environments
#: and in the evaluation.
Rng = np.random.Generator | torch.Generator


def float64(*values: Any) -> Callable[[], Tensor]:
    """Return a function that makes a tensor of ``values``, the default factory of a field."""
    return lambda: torch.tensor(values, dtype=torch.float64)


def normal(rng: Rng, *shape: int) -> Tensor:
    """Draw standard normal numbers of shape ``shape``, in float64."""
    check_rng(rng)
    if isinstance(rng, torch.Generator):
        return torch.randn(shape, generator=rng, dtype=torch.float64, device=rng.device)
    return torch.as_tensor(rng.standard_normal(shape))


def uniform(rng: Rng, *shape: int) -> Tensor:
    """Draw numbers uniform in [0, 1) of shape ``shape``, in float64."""
    check_rng(rng)
    if isinstance(rng, torch.Generator):
        return torch.rand(shape, generator=rng, dtype=torch.float64, device=rng.device)
    return torch.as_tensor(rng.random(shape))


def check_rng(rng: Rng) -> None:
    """Raise `QPError` unless ``rng`` is a generator."""
    if not isinstance(rng, Rng):
        remedy = "From a seed: numpy.random.default_rng(seed)."
        raise QPError.expected("rng", repr(rng), "a NumPy or torch generator", remedy)


@dataclass(frozen=True, eq=False, kw_only=True)
class Actuated:
    """A plant's tensors, with the bounds of its action, ``(n_u,)``."""

    stream: ClassVar[int] = 0  # a seed's stream in TorchRL

    lb_a: Tensor
    ub_a: Tensor

    def to(self, device: torch.device | str | None) -> Self:
        """Return the same plant with its tensors on ``device``."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        tensors = {k: v.to(device) for k, v in values.items() if isinstance(v, Tensor)}
        return replace(self, **tensors)

    @property
    def n_u(self) -> int:
        """Entries of the action."""
        return len(self.lb_a)

    def applied(self, a: Tensor) -> Tensor:
        """Return the applied action: a ``(*batch, n_u)``, clipped to its bounds."""
        check_tensor("a", a, self.n_u)
        return a.to(self.lb_a).clamp(self.lb_a, self.ub_a)


@dataclass(frozen=True, eq=False, kw_only=True)
class LinearSystem(Actuated, ABC):
    """The physics in float64, to which methods convert their tensors.

    Args:
        A, B: dynamics ``(n_x, n_x)`` and ``(n_x, n_u)``.
        lb_s, ub_s, lb_a, ub_a: bounds of the state ``(n_x,)`` and of the action ``(n_u,)``.

    Raises:
        QPError: if a tensor has another shape or dtype, A or B is not finite, or bounds cross.

    Example:
        >>> import torch, torch_qpmpc as qm
        >>> class Integrator(qm.envs.LinearSystem):
        ...     def cost(self, s, a):
        ...         return (s.square() + a.square()).sum(-1)
        ...
        ...     def starts(self, rng, count):
        ...         return torch.ones(count, 1).double()
        ...
        ...     def draw(self, rng, count):
        ...         return torch.zeros(count, 0)
        ...
        ...     def noise(self, nu, draw):
        ...         return nu
        >>> one = torch.ones(1, 1).double()
        >>> limits = {"lb_s": -5 * one[0], "ub_s": 5 * one[0], "lb_a": -one[0], "ub_a": one[0]}
        >>> plant = Integrator(A=one, B=one, **limits)
        >>> plant.step(one, -0.5 * one, 0 * one)
        tensor([[0.5000]], dtype=torch.float64)
    """

    #: True if a step clips s+ to its bounds; if False, they are soft and observations unbounded.
    clips_states: ClassVar[bool] = True
    stream: ClassVar[int] = 0x9E3779B9  # keeps noise apart from exploration, of torch's seed

    A: Tensor
    B: Tensor
    lb_s: Tensor
    ub_s: Tensor

    def __post_init__(self) -> None:
        remedy = "Use torch.tensor(.., dtype=torch.float64)."
        n_x = len(check_tensor("A", self.A, "n_x", "n_x", batched=False, remedy=remedy))
        check_tensor("B", self.B, n_x, "n_u", batched=False, remedy=remedy)
        n_u = self.B.shape[1]
        sizes = {"A": (n_x, n_x), "lb_s": (n_x,), "ub_s": (n_x,), "lb_a": (n_u,), "ub_a": (n_u,)}
        for name, size in sizes.items():
            check_tensor(name, getattr(self, name), *size, batched=False, remedy=remedy)
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, Tensor) and value.dtype != torch.float64:
                raise QPError.expected(field.name, value.dtype, "torch.float64", remedy)
        if self.A.is_meta:
            return
        for name in ("A", "B"):
            if not getattr(self, name).isfinite().all():
                raise QPError.expected(name, "NaN or inf", "finite entries")
        for of in ("s", "a"):
            if not (getattr(self, f"lb_{of}") <= getattr(self, f"ub_{of}")).all():
                raise QPError.expected(f"lb_{of}", f"lb_{of} > ub_{of}", "lower bounds <= upper")

    @property
    def n_x(self) -> int:
        """Entries of the state."""
        return len(self.A)

    def observed(self, model: object) -> Self:
        """Return this plant: its state is measured, and needs no ``model`` of an observer."""
        return self

    @abstractmethod
    def cost(self, s: Tensor, a: Tensor) -> Tensor:
        """Return L(s, a) ``(*batch,)`` of the current s ``(*batch, n_x)``, a ``(*batch, n_u)``."""

    @abstractmethod
    def starts(self, rng: Rng, count: int) -> Tensor:
        """Draw start states ``(count, n_x)`` from the generator ``rng``."""

    @abstractmethod
    def draw(self, rng: Rng, count: int) -> Tensor:
        """Draw numbers ``(count, n_noise)`` from ``rng``, for one step of ``count`` episodes."""

    @abstractmethod
    def noise(self, nu: Tensor, draw: Tensor) -> Tensor:
        """Return the next nu ``(*batch, n_x)`` from the last one and a ``draw`` of :meth:`draw`."""

    def mean_noise(self) -> Tensor:
        """Return the mean of nu ``(n_x,)``; 0 unless overridden."""
        return torch.zeros_like(self.lb_s)

    def true_model(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return A, B and the offset, which is the mean of the noise."""
        return self.A, self.B, self.mean_noise()

    def violation(self, s: Tensor) -> Tensor:
        """Return how far s ``(*batch, n_x)`` is outside its bounds, summed, ``(*batch,)``."""
        s = check_tensor("s", s, len(self.A)).to(self.A)
        return ((self.lb_s - s).relu() + (s - self.ub_s).relu()).sum(-1)

    def step(self, s: Tensor, a: Tensor, nu: Tensor) -> Tensor:
        """Return s+ = A s + B a + nu, with a clipped and, if `clips_states`, s+ too.

        s ``(*batch, n_x)``, a ``(*batch, n_u)`` and nu ``(*batch, n_x)`` broadcast.
        """
        check_tensor("s", s, len(self.A))
        check_tensor("nu", nu, len(self.A))
        following = s.to(self.A) @ self.A.mT + self.applied(a) @ self.B.mT + nu.to(self.A)
        return following.clamp(self.lb_s, self.ub_s) if self.clips_states else following

    def vectorised(self, num_envs: int, max_steps: int, seed: int) -> LinearSystemEnv:
        """Make a TorchRL environment of ``num_envs`` episodes of ``max_steps`` steps.

        ``seed`` seeds starts and noise.
        """
        return LinearSystemEnv(self, num_envs, max_steps, seed=seed)


class LinearSystemGymEnv(gymnasium.Env):
    """A Gymnasium environment of ``plant``, truncated by its registration, never terminated.

    Raises:
        QPError: if ``plant`` is no `LinearSystem`.
    """

    metadata = {"render_modes": []}  # noqa: RUF012 (Gymnasium's own convention)

    def __init__(self, plant: LinearSystem) -> None:
        check_kind("plant", plant, LinearSystem)
        self.plant = p = plant
        lb_s, ub_s, lb_a, ub_a = (b.float().numpy() for b in (p.lb_s, p.ub_s, p.lb_a, p.ub_a))
        low, high = (lb_s, ub_s) if p.clips_states else (-np.inf, np.inf)
        self.observation_space = gymnasium.spaces.Box(low, high, lb_s.shape)
        self.action_space = gymnasium.spaces.Box(lb_a, ub_a)
        self._s = self._nu = torch.zeros_like(p.lb_s)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode; return its observation, float32 ``(n_x,)``, and no information."""
        super().reset(seed=seed)
        self._s = self.plant.starts(self.np_random, 1)[0]
        self._nu = torch.zeros_like(self._s)
        return self._s.numpy().astype(np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Apply ``action`` ``(n_u,)``, clipped; return the observation, the reward and the flags.

        Raises:
            QPError: the action does not fit or is not finite.
        """
        a, remedy = as_tensor("action", action), "Pass one action, not a batch."
        check_tensor("action", a, self.plant.n_u, batched=False, remedy=remedy)
        reward = -self.plant.cost(self._s, a).item()
        self._nu = self.plant.noise(self._nu, self.plant.draw(self.np_random, 1)[0])
        self._s = self.plant.step(self._s, a, self._nu)
        return self._s.numpy().astype(np.float32), reward, False, False, {}


class LinearSystemEnv(VectorisedEnv):
    """A TorchRL environment of ``num_envs`` episodes of a `LinearSystem`, as in `VectorisedEnv`.

    The hidden entries are ``state``, ``step_count`` and ``noise``, the last nu ``(num_envs, n_x)``.

    Example:
        >>> from torch_qpmpc.envs import PointMass
        >>> LinearSystemEnv(PointMass(), num_envs=2, seed=0).rollout(3)["observation"].shape
        torch.Size([2, 3, 4])
    """

    kind: ClassVar[type] = LinearSystem

    def _entries(self) -> tuple[dict[str, Any], dict[str, Any]]:
        p, nu = self.plant, self._reals(self.plant.n_x)
        s = self._box(p.lb_s, p.ub_s) if p.clips_states else nu
        return {"observation": s}, {"state": nu, "noise": nu}

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        s = self.plant.starts(self.rng, self.batch_size[0])
        return self._observed(s, torch.zeros_like(s), self._zero_count())

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        s, a = tensordict["state"], tensordict["action"]
        draw = self.plant.draw(self.rng, self.batch_size[0])
        nu = self.plant.noise(tensordict["noise"], draw)
        out = self._observed(self.plant.step(s, a, nu), nu, tensordict["step_count"] + 1)
        return out.set("reward", -self.plant.cost(s, a).unsqueeze(-1).to(self.dtype))

    def _observed(self, s: Tensor, nu: Tensor, step_count: Tensor) -> TensorDict:
        s = s.to(self.dtype)
        return self._pack(step_count, observation=s, state=s.clone(), noise=nu.to(self.dtype))
