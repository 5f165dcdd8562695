"""DDPG and TD3 from the configuration: TorchRL's losses, actors and critics, and their rates."""

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
from torch_qpmpc.learning.operators import POLICY_ACTIVE_SET, QPActorValueOperator
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.mpc.validation import COST

#: Relative standard deviation of the differences between the critics of one ensemble at the start.
SPREAD = 0.01


def make_actor(cfg: DictConfig, mpc: QPMPC, low: Tensor, high: Tensor) -> TensorDictModule:
    """Observation to action, for actions between ``low`` and ``high`` ``(n_u,)``."""
    if cfg.algo.actor == "qp":
        return TensorDictModule(ClippedPolicy(mpc, low, high), ["observation"], ["action"])
    network = BoundedPolicy(mpc.n_x, low, high, cfg.algo.width)
    return TensorDictModule(network, ["observation"], ["action"])


def make_acting(
    cfg: DictConfig, mpc: QPMPC, loss_module: LossModule, low: Tensor, high: Tensor
) -> TensorDictModuleBase:
    """The loss's actor as it acts in closed loop: a QP's starts each step from the one before."""
    if cfg.algo.actor == "mlp":
        return cast("TensorDictModuleBase", loss_module.actor_network)
    policy: Any = QPActorValueOperator(mpc).get_policy_operator(POLICY_ACTIVE_SET)
    clip: Any = TensorDictModule(partial(clipped, low=low, high=high), ["action"], ["action"])
    return TensorDictSequential(policy, clip)


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
