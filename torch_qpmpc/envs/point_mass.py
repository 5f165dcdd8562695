"""The paper's point mass (section "Point-Mass"), once, and its Gymnasium and TorchRL environments.

    s+ = A s + B a + nu,    s = [x, y, vx, vy],    a = [F_x, F_y],    L(s, a) = s'Ws

Both environments return the reward -L(s, a): the paper minimises a cost, they maximise.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from typing import Any

import gymnasium
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from torch_qpmpc.errors import QPError

#: Standard deviation of the noise by kind; the paper leaves it open.
NOISE_STD = {"gaussian": 0.01, "brownian": 0.002}


def _float64(*values: Any) -> Callable[[], Tensor]:
    return lambda: torch.tensor(values, dtype=torch.float64)


@dataclass(frozen=True, eq=False)
class PointMass:
    """The physics, in float64; every tensor that a method gets is converted to that.

    Args:
        noise_kind: ``"gaussian"`` (independent in time) or ``"brownian"`` (a random walk over the
            episode, from 0 at its start).
        noise_std: standard deviation per state of the Gaussian noise, or of the random walk's
            increments; ``None`` for :data:`NOISE_STD`.
        start_position, start_velocity: an episode starts uniformly within plus or minus these.
        A, B, W: dynamics ``(4, 4)``, ``(4, 2)`` and weight of the cost ``(4, 4)``.
        lb_s, ub_s, lb_a, ub_a: bounds of the state ``(4,)`` and of the action ``(2,)``.

    Raises:
        QPError: unknown ``noise_kind``, or negative or not finite ``noise_std``.
    """

    noise_kind: str = "gaussian"
    noise_std: float | None = None
    start_position: float = 1.5
    start_velocity: float = 0.5
    A: Tensor = field(
        default_factory=_float64([1, 0, 0.1, 0], [0, 1, 0, 0.1], [0, 0, 0.9, 0], [0, 0, 0, 0.9])
    )
    B: Tensor = field(default_factory=_float64([0, 0], [0, 0], [0.1, 0], [0, 0.1]))
    W: Tensor = field(
        default_factory=_float64([3, 0, 0, 0], [0, 3, 0, 0], [0, 0, 0.25, 0], [0, 0, 0, 0.25])
    )
    lb_s: Tensor = field(default_factory=_float64(-2, -2, -10, -10))
    ub_s: Tensor = field(default_factory=_float64(2, 2, 10, 10))
    lb_a: Tensor = field(default_factory=_float64(-1, -1))
    ub_a: Tensor = field(default_factory=_float64(1, 1))

    def __post_init__(self) -> None:
        if self.noise_kind not in NOISE_STD:
            kinds = " or ".join(map(repr, NOISE_STD))
            raise QPError.expected("noise_kind", repr(self.noise_kind), kinds, "Choose one.")
        if not 0 <= self.std < math.inf:
            remedy = "Pass 0 for no noise, None for the default."
            raise QPError.expected("noise_std", self.noise_std, "a finite number >= 0", remedy)

    @property
    def std(self) -> float:
        """The standard deviation in force."""
        return NOISE_STD[self.noise_kind] if self.noise_std is None else self.noise_std

    @property
    def start_range(self) -> Tensor:
        """Half-widths ``(4,)`` of the start distribution."""
        p, v = self.start_position, self.start_velocity
        return self.A.new_tensor([p, p, v, v])

    def to(self, device: torch.device | str | None) -> PointMass:
        """The same physics with its tensors on ``device``."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        tensors = {k: v.to(device) for k, v in values.items() if isinstance(v, Tensor)}
        return replace(self, **tensors)

    def cost(self, s: Tensor, a: Tensor) -> Tensor:
        """L(s, a) = s'Ws ``(*batch,)`` of the current s ``(*batch, 4)``; a does not enter."""
        s = s.to(self.W)
        return ((s @ self.W) * s).sum(-1)

    def noise(self, nu: Tensor, normal: Tensor) -> Tensor:
        """The next nu ``(*batch, 4)`` from the last one and a standard normal draw."""
        step = self.std * normal.to(self.A)
        return nu.to(self.A) + step if self.noise_kind == "brownian" else step

    def step(self, s: Tensor, a: Tensor, nu: Tensor) -> Tensor:
        """s+ = A s + B a + nu ``(*batch, 4)``; a, then s+, are clipped to their bounds."""
        a = a.to(self.A).clamp(self.lb_a, self.ub_a)
        following = s.to(self.A) @ self.A.mT + a @ self.B.mT + nu.to(self.A)
        return following.clamp(self.lb_s, self.ub_s)

    def starts(self, rng: np.random.Generator, count: int) -> Tensor:
        """Start states ``(count, 4)``: draws the positions, then the velocities."""
        ranges = (self.start_position, self.start_velocity)
        draws = [rng.uniform(-r, r, size=(count, 2)) for r in ranges]
        return torch.as_tensor(np.hstack(draws)).to(self.A)

    def corrupted(self, seed: int) -> tuple[Tensor, Tensor, Tensor]:
        """The wrong model that learning starts from, and the first cost parameters.

        Returns:
            A_hat ``(4, 4)`` and B_hat ``(4, 2)``, the true ones plus entries uniform in
            [-0.05, 0.05], and theta_1..theta_4 ``(4,)`` uniform in [0.5, 5]; drawn in this order.
        """
        rng = np.random.default_rng(seed)
        dA, dB = (rng.uniform(-0.05, 0.05, size=tuple(M.shape)) for M in (self.A, self.B))
        theta = rng.uniform(0.5, 5, size=4)
        as_A = self.A.new_tensor
        return self.A + as_A(dA), self.B + as_A(dB), as_A(theta)


class PointMassGymEnv(gymnasium.Env):
    """``torch_qpmpc/PointMass-v0``: never terminates, its registration truncates it at 50 steps."""

    metadata = {"render_modes": []}  # noqa: RUF012 (Gymnasium's own convention)

    def __init__(self, physics: PointMass | None = None) -> None:
        self.physics = p = PointMass() if physics is None else physics
        lb_s, ub_s, lb_a, ub_a = (b.float().numpy() for b in (p.lb_s, p.ub_s, p.lb_a, p.ub_a))
        self.observation_space = gymnasium.spaces.Box(lb_s, ub_s)
        self.action_space = gymnasium.spaces.Box(lb_a, ub_a)
        self._s = self._nu = torch.zeros_like(p.lb_s)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self._s = self.physics.starts(self.np_random, 1)[0]
        self._nu = torch.zeros_like(self._s)
        return self._s.numpy().astype(np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        a = torch.as_tensor(action)
        reward = -self.physics.cost(self._s, a).item()
        normal = torch.as_tensor(self.np_random.standard_normal(self._s.shape))
        self._nu = self.physics.noise(self._nu, normal)
        self._s = self.physics.step(self._s, a, self._nu)
        return self._s.numpy().astype(np.float32), reward, False, False, {}


class PointMassEnv(EnvBase):
    """``num_envs`` point masses in one vectorised TorchRL environment, without a Python loop.

    The environment holds no state but its generator. What a step needs beside the observation
    travels in the TensorDict: ``noise``, the last nu ``(num_envs, 4)``, and ``step_count``
    ``(num_envs, 1)``. So TorchRL's own merging by mask at a partial reset restarts exactly those
    episodes' random walks and clocks. A policy must not read ``noise``.

    It truncates itself at ``max_steps`` (no ``StepCounter`` needed), so that the collector sees the
    end of an episode, resets it and changes its trajectory id; it never terminates.

    Args:
        num_envs: number of episodes run side by side, the batch size.
        physics: ``None`` for ``PointMass()``.
        max_steps: steps of an episode.
        dtype: of observation, action and reward; the physics stays in float64.
        device: of the TensorDicts and of the generator; ``None`` for the CPU.
        seed: of the generator; ``None`` draws one from torch's global generator.

    Raises:
        QPError: ``num_envs`` or ``max_steps`` below 1.
    """

    def __init__(
        self,
        num_envs: int = 8,
        physics: PointMass | None = None,
        max_steps: int = 50,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str | None = None,
        seed: int | None = None,
    ) -> None:
        for name, value in (("num_envs", num_envs), ("max_steps", max_steps)):
            if value < 1:
                raise QPError.expected(name, value, "an integer >= 1", "Ask for at least one.")
        super().__init__(device=device, batch_size=torch.Size([num_envs]))
        self.physics = p = (PointMass() if physics is None else physics).to(self.device)
        self.max_steps = max_steps
        self.rng = torch.Generator(device=p.A.device)
        one, kind = torch.Size([num_envs, 1]), {"dtype": dtype, "device": self.device}

        def box(low: Tensor, high: Tensor) -> Bounded:
            low, high = (b.to(dtype).expand(num_envs, -1).clone() for b in (low, high))
            return Bounded(low, high, dtype=dtype, device=self.device)

        def composite(**specs: Any) -> Composite:
            return Composite(specs, shape=self.batch_size, device=self.device)

        s = box(p.lb_s, p.ub_s)
        nu = Unbounded(s.shape, **kind)
        count = Unbounded(one, dtype=torch.int64, device=self.device)
        flag = Categorical(2, shape=one, dtype=torch.bool, device=self.device)
        # The hidden entries are inputs of a step (state) and outputs of it (observation).
        self.state_spec = composite(noise=nu, step_count=count)
        self.observation_spec = composite(observation=s, noise=nu.clone(), step_count=count.clone())
        self.action_spec = box(p.lb_a, p.ub_a)
        self.reward_spec = Unbounded(one, **kind)
        self.done_spec = composite(done=flag, terminated=flag.clone(), truncated=flag.clone())
        self.set_seed(int(torch.randint(2**31, ())) if seed is None else seed)

    def get_rng_state(self) -> Tensor:
        """State of the generator, a uint8 tensor for a checkpoint."""
        return self.rng.get_state()

    def set_rng_state(self, state: Tensor) -> None:
        """Continue the random stream from what :meth:`get_rng_state` returned."""
        self.rng.set_state(state.cpu())

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self.rng.manual_seed(seed)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        # Fresh values for every environment: where only some are reset, TorchRL keeps the others'.
        shape = (*self.batch_size, self.physics.A.shape[0])
        uniform = torch.rand(shape, generator=self.rng, dtype=torch.float64, device=self.rng.device)
        s = self.physics.start_range * (2 * uniform - 1)
        count = torch.zeros((*self.batch_size, 1), dtype=torch.int64, device=s.device)
        return self._pack(s, torch.zeros_like(s), count)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        s, a = tensordict["observation"], tensordict["action"]
        kind: dict[str, Any] = {"dtype": torch.float64, "device": self.rng.device}
        normal = torch.randn(s.shape, generator=self.rng, **kind)
        nu = self.physics.noise(tensordict["noise"], normal)
        out = self._pack(self.physics.step(s, a, nu), nu, tensordict["step_count"] + 1)
        return out.set("reward", -self.physics.cost(s, a).unsqueeze(-1).to(out["observation"]))

    def _pack(self, s: Tensor, nu: Tensor, step_count: Tensor) -> TensorDict:
        dtype = self.observation_spec["observation"].dtype
        truncated = step_count >= self.max_steps
        return TensorDict(
            {
                "observation": s.to(dtype),
                "noise": nu.to(dtype),
                "step_count": step_count,
                "done": truncated,
                "terminated": torch.zeros_like(truncated),
                "truncated": truncated.clone(),
            },
            batch_size=self.batch_size,
            device=self.device,
        )
