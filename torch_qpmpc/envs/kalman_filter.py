"""A Kalman filter as a TorchRL transform: its observation is the estimate of a model's state."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs import Transform

from torch_qpmpc.errors import QPError
from torch_qpmpc.identification.innovations import Innovations

#: The steps of an episode whose gains differ from the last one's, at most.
STEPS = 1000


class KalmanFilter(Transform):
    """A TorchRL transform that turns an output y into the estimate of a model's state.

    The estimate before the first output is the model's ``x0``; an output that is NaN corrects
    nothing. The transform has no state: each estimate follows from the last one, the action and the
    new output. The entry ``filter_step`` counts the steps of an episode, by which the gain varies.

    Args:
        model: the model.
        observation_key: the key of the output.
        estimate_key: the key of the estimate, by default that of the output, which it replaces.

    Raises:
        QPError: the environment's output or action does not have the model's size.

    Example:
        >>> import numpy as np
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> from torch_qpmpc.identification.innovations import Innovations
        >>> A, zero = np.eye(3), np.zeros(3)
        >>> model = Innovations(A, np.ones((3, 1)), np.zeros((3, 0)), zero, A, A, A, zero, A)
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), KalmanFilter(model))
        >>> env.rollout(5)["observation"].shape
        torch.Size([5, 3])
    """

    A: Tensor
    B: Tensor
    E: Tensor
    offset: Tensor
    C: Tensor
    x0: Tensor
    gains: Tensor

    def __init__(
        self,
        model: Innovations,
        *,
        observation_key: NestedKey = "observation",
        estimate_key: NestedKey | None = None,
    ) -> None:
        self.observation_key = observation_key
        self.estimate_key = observation_key if estimate_key is None else estimate_key
        super().__init__(in_keys=[observation_key], out_keys=[self.estimate_key])
        for name in ("A", "B", "E", "offset", "C", "x0"):
            self.register_buffer(name, torch.as_tensor(getattr(model, name)))
        gains = np.concatenate((model.gains(STEPS), model.L[None]))
        self.register_buffer("gains", torch.as_tensor(gains))

    def first(self, y: Tensor) -> Tensor:
        """Return the estimates ``(*batch, n)`` after the first outputs.

        Args:
            y: ``(*batch, n_y)``.
        """
        return self._corrected(self.x0.expand(*y.shape[:-1], -1), y, torch.tensor(0))

    def following(self, x: Tensor, u: Tensor, d: Tensor, y: Tensor, step: Tensor | int) -> Tensor:
        """Return the estimates one step after x, with the applied u, the known d and the new y.

        Args:
            x, u, d, y: ``(*batch, n)``, ``(*batch, n_u)``, ``(*batch, n_d)`` and ``(*batch, n_y)``.
            step: the number of y's step in its episode, ``(*batch,)`` or ``()``.
        """
        x, u, d = x.to(self.A), u.to(self.A), d.to(self.A)
        x = x @ self.A.mT + u @ self.B.mT + d @ self.E.mT + self.offset
        return self._corrected(x, y, torch.as_tensor(step))

    def _corrected(self, x: Tensor, y: Tensor, step: Tensor) -> Tensor:
        error = y.to(x) - x @ self.C.mT
        error = torch.where(error.isnan(), 0.0, error).unsqueeze(-1)
        return x + (self.gains[step.clamp(max=len(self.gains) - 1)] @ error).squeeze(-1)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        y, step = next_tensordict[self.observation_key], tensordict["filter_step"] + 1
        x, u, n_d = tensordict[self.estimate_key], tensordict["action"], self.E.shape[-1]
        d = tensordict["preview"][..., :n_d] if n_d else x[..., :0]
        next_tensordict.set(self.estimate_key, self.following(x, u, d, y, step.squeeze(-1)).to(y))
        return next_tensordict.set("filter_step", step)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        # At a partial reset, TorchRL keeps the old estimates of the other episodes.
        y = tensordict_reset[self.observation_key]
        step = torch.zeros((*y.shape[:-1], 1), dtype=torch.int64, device=y.device)
        tensordict_reset.set(self.estimate_key, self.first(y).to(y))
        return tensordict_reset.set("filter_step", step)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Set the estimate's spec, which is unbounded, and that of the count."""
        for key, spec in self._specs(observation_spec).items():
            observation_spec[key] = spec
        return observation_spec

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        """Add the estimate to the inputs of a step, so that batched environments pass it on."""
        state_spec = input_spec["full_state_spec"]
        if state_spec is None:
            state_spec = Composite(shape=input_spec.shape)
        assert self.parent is not None
        for key, spec in self._specs(self.parent.full_observation_spec).items():
            state_spec[key] = spec
        input_spec["full_state_spec"] = state_spec
        return input_spec

    def _specs(self, observation_spec: Composite) -> dict[Any, Unbounded]:
        name = str(unravel_key(self.observation_key))
        y, parent = observation_spec.get(self.observation_key, None), self.parent
        if y is None:
            present = ", ".join(map(str, observation_spec.keys(True, True)))
            raise QPError.expected("observation_key", name, f"one of {present}")
        assert parent is not None
        n_u = parent.full_action_spec["action"].shape[-1]
        got, want = (y.shape[-1] if y.shape else 0, n_u), (len(self.C), self.B.shape[-1])
        if got != want or not y.dtype.is_floating_point:
            got = f"outputs and actions of sizes {got}, {y.dtype}"
            raise QPError.expected("the environment", got, f"real vectors of sizes {want}")
        size = torch.Size([*y.shape[:-1], len(self.A)])
        count = torch.Size([*y.shape[:-1], 1])
        return {
            self.estimate_key: Unbounded(size, dtype=y.dtype, device=y.device),
            "filter_step": Unbounded(count, dtype=torch.int64, device=y.device),
        }
