"""DDPG and TD3 with the QP as actor: TorchRL's losses, and the networks beside the QP.

The policy gradient goes through the solution's gradient, dpi/dtheta (`sensitivity`). A critic is a
QP of its own, or a network, as is usual; the actor may be a network, too, to compare with.
"""

from __future__ import annotations

from typing import Any, cast

import torch
from torch import Tensor, nn
from torchrl.modules import MLP

from torch_qpmpc.mpc.module import QPMPC


class BoundedPolicy(nn.Module):
    """A network whose actions tanh keeps between their bounds, for any float dtype."""

    low: Tensor
    high: Tensor

    def __init__(self, n_x: int, low: Tensor, high: Tensor, width: int) -> None:
        super().__init__()
        self.net = MLP(n_x, len(low), num_cells=[width, width], activation_class=nn.ReLU)
        self.register_buffer("low", low.float())
        self.register_buffer("high", high.float())

    def forward(self, s: Tensor) -> Tensor:
        """s ``(*batch, n_x)`` to ``(*batch, n_u)``."""
        share = (self.net(s.to(self.low)).tanh() + 1) / 2
        return (self.low + share * (self.high - self.low)).to(s.dtype)


class Clip(torch.autograd.Function):
    """a between its bounds; a gradient that would drive it further out is dropped, others pass.

    A clamp's own gradient is zero outside, from where nothing would come back.
    """

    @staticmethod
    def forward(ctx: Any, a: Tensor, low: Tensor, high: Tensor) -> Tensor:
        ctx.save_for_backward(a < low, a > high)
        return a.clamp(low, high)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, None]:
        (below, above), (grad,) = ctx.saved_tensors, grads
        # A descent moves a against its gradient.
        further_out = (below & (grad > 0)) | (above & (grad < 0))
        return grad.masked_fill(further_out, 0.0), None, None


def clipped(a: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """a ``(*batch, n_u)`` between its bounds ``(n_u,)``, with the gradient of `Clip`."""
    return cast("Tensor", Clip.apply(a, low.to(a), high.to(a)))


class ClippedPolicy(nn.Module):
    """pi(s) of a QP, clipped as plants do it: with soft action rows it may exceed the bounds."""

    low: Tensor
    high: Tensor

    def __init__(self, mpc: QPMPC, low: Tensor, high: Tensor) -> None:
        super().__init__()
        self.module = mpc
        self.register_buffer("low", low)
        self.register_buffer("high", high)

    def forward(self, s: Tensor) -> Tensor:
        """s ``(*batch, n_x)`` to ``(*batch, n_u)``."""
        return clipped(self.module.policy(s), self.low, self.high)


class ActionValue(nn.Module):
    """A network for -Q(s, a), in units of ``scale``."""

    def __init__(self, n_x: int, n_u: int, width: int, scale: float) -> None:
        super().__init__()
        self.scale = scale
        self.net = MLP(n_x + n_u, 1, num_cells=[width, width], activation_class=nn.ReLU)

    def forward(self, s: Tensor, a: Tensor) -> Tensor:
        """``(*batch, n_x)`` and ``(*batch, n_u)`` to ``(*batch, 1)``."""
        return self.scale * self.net(torch.cat((s, a), -1))
