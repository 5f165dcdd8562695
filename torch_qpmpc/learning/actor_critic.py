"""Policies and critics for TorchRL's losses of DDPG, TD3 and SAC.

The policy gradient contains the gradient of the QP's solution, dpi/dtheta. The critic is a second
QP or a network; the actor may be a network, too, for comparison.
"""

from __future__ import annotations

import math
from typing import Any, cast

import torch
from tensordict.nn import NormalParamExtractor
from torch import Tensor, nn
from torchrl.modules import MLP

from torch_qpmpc.mpc.module import QPMPC


class Standardised(nn.Module):
    """A module whose inputs are centred and scaled: ``module((x - centre) / spread)``."""

    centre: Tensor
    spread: Tensor

    def __init__(self, centre: Tensor, spread: Tensor, module: nn.Module | None = None) -> None:
        super().__init__()
        self.module = nn.Identity() if module is None else module
        self.register_buffer("centre", centre)
        self.register_buffer("spread", spread)

    def forward(self, *parts: Tensor) -> Tensor | tuple[Tensor, ...]:
        """Map the parts of the input, side by side, to the module's outputs."""
        x = torch.cat(parts, -1)
        return self.module((x - self.centre.to(x)) / self.spread.to(x))


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


class Squashable(nn.Module):
    """The location and scale of a TanhNormal distribution round an action within its bounds.

    The distribution's mode is the action, up to a share of `REACH` of the way to each bound. The
    scale is a parameter, which starts at ``std``, relative to half the distance of the bounds.
    """

    #: The tanh of the largest location.
    REACH = 0.99

    low: Tensor
    high: Tensor

    def __init__(self, low: Tensor, high: Tensor, std: float) -> None:
        super().__init__()
        self.log_scale = nn.Parameter(torch.full((len(low),), math.log(std)))
        self.register_buffer("low", low)
        self.register_buffer("high", high)

    def forward(self, a: Tensor) -> tuple[Tensor, Tensor]:
        """Map actions ``(*batch, n_u)`` to locations and scales."""
        low, high = self.low.to(a), self.high.to(a)
        share = (2 * a - (low + high)) / (high - low)
        ends = torch.full_like(low, self.REACH)
        return clipped(share, -ends, ends).atanh(), self.log_scale.exp().to(a).expand_as(a)


class GaussianPolicy(nn.Module):
    """A network for location and scale, with ``width`` units in each layer.

    It accepts inputs of any float dtype, and returns outputs of it.
    """

    def __init__(self, n_p: int, n_u: int, width: int) -> None:
        super().__init__()
        self.net = MLP(n_p, 2 * n_u, num_cells=[width, width], activation_class=nn.ReLU)
        floor: Any = 0.1  # TensorDict annotates Number, of which float is none
        self.split = NormalParamExtractor("biased_softplus_1.0", scale_lb=floor)

    def forward(self, *known: Tensor) -> tuple[Tensor, Tensor]:
        """Map the parts of p, n_p entries in all, to a location and a scale ``(*batch, n_u)``."""
        p = torch.cat(known, -1)
        last: Any = self.net[-1]
        location, scale = self.split(self.net(p.to(last.bias.dtype)))
        return location.to(p.dtype), scale.to(p.dtype)


class ActionValue(nn.Module):
    """A network for -Q(p, a), with ``width`` units in each layer and an output in ``scale``s."""

    def __init__(self, n_p: int, n_u: int, width: int, scale: float) -> None:
        super().__init__()
        self.scale = scale
        self.net = MLP(n_p + n_u, 1, num_cells=[width, width], activation_class=nn.ReLU)

    def forward(self, *inputs: Tensor) -> Tensor:
        """Map the parts of p and the action, n_p + n_u entries in all, to ``(*batch, 1)``."""
        last: Any = self.net[-1]
        return self.scale * self.net(torch.cat(inputs, -1).to(last.bias.dtype))
