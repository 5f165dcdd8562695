"""Windows of past outputs and actions, [y_{k+1-L}, u_{k+1-L}, .., y_{k-1}, u_{k-1}, y_k]."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs import Transform

from torch_qpmpc.checks import check_whole
from torch_qpmpc.errors import QPError


def first_window(y: Tensor, past: int, fill: Tensor) -> Tensor:
    """Return the window at a start: y ``(*batch, n_y)``, repeated, with the action ``fill``.

    Args:
        y: the first output.
        past: L, the number of outputs.
        fill: the action between them, ``(n_u,)``.

    Returns:
        ``(*batch, (L - 1) (n_y + n_u) + n_y)``.
    """
    pair = torch.cat((y, fill.to(y).expand(*y.shape[:-1], -1)), -1)
    return torch.cat((*[pair] * (past - 1), y), -1)


def next_window(window: Tensor, u: Tensor, y: Tensor) -> Tensor:
    """Return the window one step later: without its first pair, with u and y at the end."""
    return torch.cat((window, u.to(window), y), -1)[..., u.shape[-1] + y.shape[-1] :]


class PastWindow(Transform):
    """A TorchRL transform that turns an output y into a window of past outputs and actions.

    After it, the observation is [y_{k+1-L}, u_{k+1-L}, .., y_{k-1}, u_{k-1}, y_k]. At a reset the
    first output is repeated, where `WindowObservation` waits. The transform has no state: each
    window is made of the last one, the action and the new output. The actions are those that the
    transformed environment receives.

    Args:
        past: L, the number of outputs in the window, at least 1.
        fill: the action between the outputs at a reset, one number or ``(n_u,)``.
        observation_key, action_key: the keys of output and action.

    Raises:
        QPError: if an argument or the environment does not fit.

    Example:
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), PastWindow(3))
        >>> env.rollout(5)["observation"].shape  # 3 outputs of 3 entries, and 2 actions of 1
        torch.Size([5, 11])
    """

    def __init__(
        self,
        past: int,
        *,
        fill: Any = 0.0,
        observation_key: NestedKey = "observation",
        action_key: NestedKey = "action",
    ) -> None:
        check_whole("past", past, 1)
        super().__init__(in_keys=[observation_key], out_keys=[observation_key])
        self.past = past
        try:
            self.fill = torch.as_tensor(fill, dtype=torch.float64)
        except (TypeError, ValueError, RuntimeError) as error:
            raise QPError.expected("fill", repr(fill), "a number or (n_u,) of them") from error
        self.observation_key, self.action_key = observation_key, action_key

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        entries = (tensordict[self.observation_key], tensordict[self.action_key])
        window = next_window(*entries, next_tensordict[self.observation_key])
        return next_tensordict.set(self.observation_key, window)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        # At a partial reset, TorchRL keeps the old windows of the other episodes.
        y = tensordict_reset[self.observation_key]
        n_u, shape = self._n_u(), tuple(self.fill.shape)
        if shape not in ((), (n_u,)):
            raise QPError.expected("fill", f"shape {shape}", f"shape ({n_u},)")
        window = first_window(y, self.past, self.fill.expand(n_u))
        return tensordict_reset.set(self.observation_key, window)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Replace the observation's spec by that of the window, which is unbounded."""
        observation_spec[self.observation_key] = self._window(observation_spec)
        return observation_spec

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        """Add the window to the inputs of a step, so that batched environments pass it on."""
        state_spec = input_spec["full_state_spec"]
        if state_spec is None:
            state_spec = Composite(shape=input_spec.shape)
        assert self.parent is not None
        state_spec[self.observation_key] = self._window(self.parent.full_observation_spec)
        input_spec["full_state_spec"] = state_spec
        return input_spec

    def _window(self, observation_spec: Composite) -> Unbounded:
        name = str(unravel_key(self.observation_key))
        y = observation_spec.get(self.observation_key, None)
        if y is None:
            present = ", ".join(map(str, observation_spec.keys(True, True)))
            raise QPError.expected("observation_key", name, f"one of {present}")
        if not y.dtype.is_floating_point or not y.shape:
            got = f"{name} of {y.dtype} and shape {tuple(y.shape)}"
            raise QPError.expected("observation_key", got, "a vector of real numbers")
        size = self.past * y.shape[-1] + (self.past - 1) * self._n_u()
        return Unbounded(torch.Size([*y.shape[:-1], size]), dtype=y.dtype, device=y.device)

    def _n_u(self) -> int:
        parent = self.parent
        if parent is None:
            raise QPError.expected("PastWindow", "no environment", "one", "Use a TransformedEnv.")
        return parent.full_action_spec[self.action_key].shape[-1]
