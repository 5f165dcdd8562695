"""DDPG and TD3 from the configuration: TorchRL's losses, actors, critics and learning rates."""

from __future__ import annotations

import copy
from functools import partial
from typing import Any, cast

import torch
from omegaconf import DictConfig
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor
from torchrl.objectives import DDPGLoss, LossModule, TD3Loss

from torch_qpmpc.learning.actor_critic import ActionValue, BoundedPolicy, ClippedPolicy, clipped
from torch_qpmpc.learning.operators import (
    POLICY_ACTIVE_SET,
    QPActorValueOperator,
    known_keys,
    preview_key,
)
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.mpc.validation import COST

#: Relative standard deviation of a QP critic's initial parameters around the actor's.
SPREAD = 0.01


def make_actor(cfg: DictConfig, mpc: QPMPC, low: Tensor, high: Tensor) -> TensorDictModule:
    """Make the actor, for bounds ``low`` and ``high`` ``(n_u,)`` of the action."""
    qp = cfg.algo.actor == "qp"
    policy = (
        ClippedPolicy(mpc, low, high) if qp else BoundedPolicy(mpc.n_p, low, high, cfg.algo.width)
    )
    return TensorDictModule(policy, known_keys(mpc), ["action"])


def make_closed_loop_actor(
    cfg: DictConfig, mpc: QPMPC, loss_module: LossModule, low: Tensor, high: Tensor
) -> TensorDictModuleBase:
    """Make the actor for the closed loop; a QP is warm-started from the previous step."""
    if cfg.algo.actor == "mlp":
        return cast("TensorDictModuleBase", loss_module.actor_network)
    operator = QPActorValueOperator(mpc, preview_key=preview_key(mpc))
    policy: Any = operator.get_policy_operator(POLICY_ACTIVE_SET)
    clip: Any = TensorDictModule(partial(clipped, low=low, high=high), ["action"], ["action"])
    return TensorDictSequential(policy, clip)


def make_critic(cfg: DictConfig, mpc: QPMPC) -> Any:
    """Make the critic for TorchRL's losses, which writes state_action_value."""
    if cfg.algo.critic == "qp":
        critic = copy.deepcopy(mpc)
        with torch.no_grad():
            for parameter in critic.parameters():
                parameter.mul_(1 + SPREAD * torch.randn_like(parameter))
        return QPActorValueOperator(critic, preview_key=preview_key(mpc))
    # The network's output scale is the return of unit rewards; a wrong scale slows learning.
    scale = sum(cfg.task.gamma**k for k in range(cfg.task.episode_steps))
    network = ActionValue(mpc.n_p, mpc.n_u, cfg.algo.width, scale)
    return TensorDictModule(network, [*known_keys(mpc), "action"], ["state_action_value"])


def make_actor_critic_loss(
    cfg: DictConfig, mpc: QPMPC, low: Tensor, high: Tensor
) -> DDPGLoss | TD3Loss:
    """Make TorchRL's loss for ``cfg.algo``, with target networks; ``mpc`` is the actor's QP."""
    actor = make_actor(cfg, mpc, low, high)
    if cfg.algo.name == "ddpg":
        return DDPGLoss(actor, make_critic(cfg, mpc), delay_actor=True, delay_value=True)
    bounds: Any = (low.float(), high.float())  # TD3Loss annotates tuple[float]
    return TD3Loss(
        actor,
        [make_critic(cfg, mpc) for _ in range(2)],
        bounds=bounds,
        policy_noise=cfg.algo.policy_noise,
        noise_clip=cfg.algo.noise_clip,
        loss_function="l2",
    )


def actor_groups(cfg: DictConfig, mpc: QPMPC, loss_module: LossModule) -> list[dict[str, Any]]:
    """Make the actor's parameter groups, with ``cfg.algo.actor_rate`` times a critic's rates."""
    share, rates = cfg.algo.actor_rate, cfg.optimizer
    if cfg.algo.actor == "qp":
        return mpc.parameter_groups(
            {"cost": share * rates.lr_cost, "constraints": share * rates.lr_constraints}
        )
    params: Any = loss_module.actor_network_params
    leaves = [leaf for leaf in params.parameters() if leaf.requires_grad]
    return [{"params": leaves, "lr": share * cfg.algo.lr_network, "name": "actor"}]


def critic_groups(cfg: DictConfig, loss_module: LossModule) -> list[dict[str, Any]]:
    """Make the critics' parameter groups: two rates for a QP, ``lr_network`` for a network.

    TorchRL stacks an ensemble's parameters, so `QPMPC.parameter_groups` does not apply.
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
