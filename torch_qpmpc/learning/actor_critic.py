"""Policies and critics for TorchRL's losses of DDPG and TD3.

The policy gradient contains the gradient of the QP's solution, dpi/dtheta. The critic is a second
QP or a network; the actor may be a network, too, for comparison.
"""

from __future__ import annotations

from typing import Any, cast

import torch
from torch import Tensor, nn
from torchrl.modules import MLP

from torch_qpmpc.mpc.module import QPMPC


class BoundedPolicy(nn.Module):
    """A network policy, with ``width`` units in each layer and actions bounded by tanh.

    Its parameters are float32; it accepts inputs of any float dtype, and returns actions of it.
    """

    low: Tensor
    high: Tensor

    def __init__(self, n_p: int, low: Tensor, high: Tensor, width: int) -> None:
        super().__init__()
        self.net = MLP(n_p, len(low), num_cells=[width, width], activation_class=nn.ReLU)
        self.register_buffer("low", low.float())
        self.register_buffer("high", high.float())

    def forward(self, *known: Tensor) -> Tensor:
        """Map the parts of p, n_p entries in all, to actions ``(*batch, n_u)``."""
        p = torch.cat(known, -1)
        share = (self.net(p.to(self.low)).tanh() + 1) / 2
        return (self.low + share * (self.high - self.low)).to(p.dtype)


class Clip(torch.autograd.Function):
    """A clamp with a gradient that can bring an action back from outside its bounds.

    Outside the bounds, only gradients whose descent would move the action further out are zeroed. A
    plain clamp zeroes all of them, so that an action outside would stay there.
    """

    @staticmethod
    def forward(ctx: Any, a: Tensor, low: Tensor, high: Tensor) -> Tensor:
        ctx.save_for_backward(a < low, a > high)
        return a.clamp(low, high)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, None]:
        (below, above), (grad,) = ctx.saved_tensors, grads
        # Descent moves a against its gradient.
        further_out = (below & (grad > 0)) | (above & (grad < 0))
        return grad.masked_fill(further_out, 0.0), None, None


def clipped(a: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Clip a ``(*batch, n_u)`` to its bounds ``(n_u,)``, with the gradient of `Clip`."""
    return cast("Tensor", Clip.apply(a, low.to(a), high.to(a)))


class ClippedPolicy(nn.Module):
    """A QP's policy pi(p), clipped to the action bounds, which soft rows let it exceed."""

    low: Tensor
    high: Tensor

    def __init__(self, mpc: QPMPC, low: Tensor, high: Tensor) -> None:
        super().__init__()
        self.module = mpc
        self.register_buffer("low", low)
        self.register_buffer("high", high)

    def forward(self, *known: Tensor) -> Tensor:
        """Map the parts of p, n_p entries in all, to actions ``(*batch, n_u)``."""
        return clipped(self.module.policy(torch.cat(known, -1)), self.low, self.high)


class ActionValue(nn.Module):
    """A network for -Q(p, a), with ``width`` units in each layer and an output in ``scale``s."""

    def __init__(self, n_p: int, n_u: int, width: int, scale: float) -> None:
        super().__init__()
        self.scale = scale
        self.net = MLP(n_p + n_u, 1, num_cells=[width, width], activation_class=nn.ReLU)

    def forward(self, *inputs: Tensor) -> Tensor:
        """Map the parts of p and the action, n_p + n_u entries in all, to ``(*batch, 1)``."""
        return self.scale * self.net(torch.cat(inputs, -1))
