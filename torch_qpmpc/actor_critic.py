"""DDPG and TD3 with the QP as actor: TorchRL's losses, and the networks beside the QP.

The policy gradient goes through the solution's gradient, dpi/dtheta (`sensitivity`). A critic is a
QP of its own, or a network, as is usual; the actor may be a network, too, to compare with.
"""

from __future__ import annotations

import copy
from typing import Any, cast

import torch
from omegaconf import DictConfig
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.modules import MLP
from torchrl.objectives import DDPGLoss, LossModule, TD3Loss

from torch_qpmpc.arguments import COST
from torch_qpmpc.mpc import QPMPC
from torch_qpmpc.operators import QPActorValueOperator

#: Relative standard deviation of the differences between the critics of one ensemble at the start.
SPREAD = 0.01


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
        return cast("Tensor", Clip.apply(self.module.policy(s), self.low.to(s), self.high.to(s)))


class ActionValue(nn.Module):
    """A network for -Q(s, a), in units of ``scale``."""

    def __init__(self, n_x: int, n_u: int, width: int, scale: float) -> None:
        super().__init__()
        self.scale = scale
        self.net = MLP(n_x + n_u, 1, num_cells=[width, width], activation_class=nn.ReLU)

    def forward(self, s: Tensor, a: Tensor) -> Tensor:
        """``(*batch, n_x)`` and ``(*batch, n_u)`` to ``(*batch, 1)``."""
        return self.scale * self.net(torch.cat((s, a), -1))


def make_actor(cfg: DictConfig, mpc: QPMPC, low: Tensor, high: Tensor) -> TensorDictModule:
    """Observation to action, for actions between ``low`` and ``high`` ``(n_u,)``."""
    if cfg.algo.actor == "qp":
        return TensorDictModule(ClippedPolicy(mpc, low, high), ["observation"], ["action"])
    network = BoundedPolicy(mpc.n_x, low, high, cfg.algo.width)
    return TensorDictModule(network, ["observation"], ["action"])


def make_critic(cfg: DictConfig, mpc: QPMPC) -> Any:
    """(observation, action) to state_action_value, a module that TorchRL's losses take."""
    if cfg.algo.critic == "qp":
        critic = copy.deepcopy(mpc)
        with torch.no_grad():
            for parameter in critic.parameters():
                parameter.mul_(1 + SPREAD * torch.randn_like(parameter))
        return QPActorValueOperator(critic)
    # What rewards of one sum up to: outputs of another order of magnitude would be learned slowly.
    scale = sum(cfg.task.gamma**k for k in range(cfg.task.episode_steps))
    network = ActionValue(mpc.n_x, mpc.n_u, cfg.algo.width, scale)
    return TensorDictModule(network, ["observation", "action"], ["state_action_value"])


def make_actor_critic_loss(
    cfg: DictConfig, mpc: QPMPC, low: Tensor, high: Tensor
) -> DDPGLoss | TD3Loss:
    """TorchRL's loss for ``cfg.algo``, with target networks; ``mpc`` is the actor's QP."""
    actor = make_actor(cfg, mpc, low, high)
    if cfg.algo.name == "ddpg":
        return DDPGLoss(actor, make_critic(cfg, mpc), delay_actor=True, delay_value=True)
    bounds: Any = (low.float(), high.float())  # its annotation is tuple[float]
    return TD3Loss(
        actor,
        [make_critic(cfg, mpc) for _ in range(2)],
        bounds=bounds,
        policy_noise=cfg.algo.policy_noise,
        noise_clip=cfg.algo.noise_clip,
        loss_function="l2",
    )


def actor_groups(cfg: DictConfig, mpc: QPMPC, loss_module: LossModule) -> list[dict[str, Any]]:
    """Parameter groups of the actor, at ``cfg.algo.actor_rate`` of the rates of such a critic."""
    share, rates = cfg.algo.actor_rate, cfg.optimizer
    if cfg.algo.actor == "qp":
        return mpc.parameter_groups(
            {"cost": share * rates.lr_cost, "constraints": share * rates.lr_constraints}
        )
    params: Any = loss_module.actor_network_params
    leaves = [leaf for leaf in params.parameters() if leaf.requires_grad]
    return [{"params": leaves, "lr": share * cfg.algo.lr_network, "name": "actor"}]


def critic_groups(cfg: DictConfig, loss_module: LossModule) -> list[dict[str, Any]]:
    """Parameter groups of the critics: a QP's at the optimiser's two rates, a network's at its own.

    An ensemble's parameters are stacked, so that no QPMPC has them as its own.
    """
    name = "value_network" if isinstance(loss_module, DDPGLoss) else "qvalue_network"
    groups = []
    for path, leaf in getattr(loss_module, f"{name}_params").flatten_keys(".").items():
        if not leaf.requires_grad:
            continue
        rate = cfg.algo.lr_network
        if cfg.algo.critic == "qp":
            of_cost = any(part in path.split(".") for part in COST)
            rate = cfg.optimizer.lr_cost if of_cost else cfg.optimizer.lr_constraints
        groups.append({"params": [leaf], "lr": rate, "name": f"critic.{path}"})
    return groups
