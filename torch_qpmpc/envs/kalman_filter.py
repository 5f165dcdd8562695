"""A Kalman filter as a TorchRL transform: its observation is the estimate of a model's state."""

from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs import Transform

from torch_qpmpc.checks import check_kind, check_tensor
from torch_qpmpc.errors import QPError
from torch_qpmpc.identification.innovations import Innovations

#: The steps of an episode whose gains differ from the last one's, at most.
STEPS = 1000
#: The key of the last estimate, whatever later transforms make of the observation.
KEPT = "filter_estimate"


class KalmanFilter(Transform):
    """A TorchRL transform that turns an output y into the estimate of a model's state.

    The estimate before the first output is the model's ``x0``; an output that is NaN corrects
    nothing. The transform has no state: each estimate follows from the last one, the action and the
    new output. The entry ``filter_step`` counts the outputs of an episode, by which gains vary; if
    outputs may be ``missing``, gains follow from ``filter_covariance`` in its place.

    Args:
        model: the model.
        missing: True if outputs are often NaN, as of slow sensors: the estimates then keep their
            covariance ``(n, n)``, which `Innovations.P0` begins. Else the gains go on as if no
            output were missing, which is right for a few.
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
    P0: Tensor

    def __init__(
        self,
        model: Innovations,
        *,
        missing: bool = False,
        observation_key: NestedKey = "observation",
        estimate_key: NestedKey | None = None,
    ) -> None:
        check_kind("model", model, Innovations, "Of an identification it is its model.")
        self.observation_key = observation_key
        self.estimate_key = observation_key if estimate_key is None else estimate_key
        super().__init__(in_keys=[observation_key], out_keys=[self.estimate_key])
        self.missing, self._model = missing, model
        self.memory_key = "filter_covariance" if missing else "filter_step"
        for name in ("A", "B", "E", "offset", "C", "x0", "P0"):
            self.register_buffer(name, torch.as_tensor(getattr(model, name)))
        gains = np.concatenate((model.settling(STEPS)[0], model.L[None]))
        self.register_buffer("gains", torch.as_tensor(gains))

    def gain(self, P: Tensor, seen: Tensor) -> tuple[Tensor, Tensor]:
        """Return the gains for outputs that are ``seen`` ``(*batch, n_y)`` and the next P.

        P is ``(*batch, n, n)``, as in `Innovations.course`.
        """
        batch, n = seen.shape[:-1], len(self.A)
        before, rows = P.reshape(-1, n, n).double(), seen.reshape(-1, 1, seen.shape[-1])
        pairs = zip(before.numpy(force=True), rows.numpy(force=True), strict=True)
        runs = [self._model.course(own, one) for one, own in pairs]
        K, after = (np.stack(x) for x in zip(*((run.K[0], run.after) for run in runs), strict=True))
        K, after = torch.as_tensor(K).to(P), torch.as_tensor(after).to(P)
        return K.reshape(*batch, n, -1), after.reshape(P.shape)

    def first(self, y: Tensor) -> Tensor:
        """Return the estimates ``(*batch, n)`` after the first outputs.

        Args:
            y: ``(*batch, n_y)``.
        """
        return self._begun(y)[0]

    def following(self, x: Tensor, u: Tensor, d: Tensor, y: Tensor, step: Tensor | int) -> Tensor:
        """Return the estimates one step after x, with the applied u, the known d and the new y.

        Args:
            x, u, d, y: ``(*batch, n)``, ``(*batch, n_u)``, ``(*batch, n_d)`` and ``(*batch, n_y)``.
            step: the number of y's step in its episode, ``(*batch,)`` or ``()``.
        """
        return self._corrected(self._predicted(x, u, d), y, torch.as_tensor(step))[0]

    def _predicted(self, x: Tensor, u: Tensor, d: Tensor) -> Tensor:
        x, u, d = x.to(self.A), u.to(self.A), d.to(self.A)
        return x @ self.A.mT + u @ self.B.mT + d @ self.E.mT + self.offset

    def _corrected(self, x: Tensor, y: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Return the estimates after y, and what they follow from next: a step, or P."""
        seen = ~y.isnan()
        error = torch.where(seen, y.to(x) - x @ self.C.mT, 0.0).unsqueeze(-1)
        if memory.is_floating_point():
            K, after = self.gain(memory, seen)
        else:
            K, after = self.gains[memory.clamp(max=len(self.gains) - 1)], memory + 1
        return x + (K @ error).squeeze(-1), after

    def _begun(self, y: Tensor) -> tuple[Tensor, Tensor]:
        batch = check_tensor("y", y, len(self.C)).shape[:-1]
        memory = self.P0 if self.missing else torch.zeros((), dtype=torch.int64, device=y.device)
        memory = memory.expand(torch.Size([*batch, *memory.shape])).clone()
        return self._corrected(self.x0.expand(*batch, -1), y, memory)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        y, memory = next_tensordict[self.observation_key], tensordict[self.memory_key]
        memory = memory if self.missing else memory.squeeze(-1)
        x, u, n_d = tensordict[KEPT], tensordict["action"], self.E.shape[-1]
        d = tensordict["preview"][..., :n_d] if n_d else x[..., :0]
        return self._kept(next_tensordict, y, *self._corrected(self._predicted(x, u, d), y, memory))

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        # At a partial reset, TorchRL keeps the old estimates of the other episodes.
        y = tensordict_reset[self.observation_key]
        return self._kept(tensordict_reset, y, *self._begun(y))

    def _kept(self, data: TensorDictBase, y: Tensor, x: Tensor, memory: Tensor) -> TensorDictBase:
        memory = memory if self.missing else memory.unsqueeze(-1)
        data.set(self.estimate_key, x.to(y)).set(KEPT, x.to(y, copy=True))
        return data.set(self.memory_key, memory)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Set the estimate's spec, which is unbounded, and that of the count."""
        for key, spec in self._specs(observation_spec).items():
            observation_spec[key] = spec
        return observation_spec

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        """Add the estimate to the inputs of a step, so that batched environments pass it on."""
        assert self.parent is not None
        for key, spec in self._specs(self.parent.full_observation_spec).items():
            input_spec["full_state_spec", key] = spec
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
        x = Unbounded(torch.Size([*y.shape[:-1], len(self.A)]), dtype=y.dtype, device=y.device)
        memory, dtype = ([len(self.A)] * 2, self.A.dtype) if self.missing else ([1], torch.int64)
        memory = Unbounded(torch.Size([*y.shape[:-1], *memory]), dtype=dtype, device=y.device)
        return {self.estimate_key: x, KEPT: x.clone(), self.memory_key: memory}
