"""DDPG, TD3 and SAC from the configuration: TorchRL's losses, actors, critics, learning rates."""

from __future__ import annotations

import copy
from functools import partial
from typing import Any, cast

import torch
from omegaconf import DictConfig
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor
from torchrl.data import Bounded
from torchrl.modules import ProbabilisticActor, TanhNormal
from torchrl.objectives import DDPGLoss, LossModule, SACLoss, TD3Loss

from torch_qpmpc.envs import GymnasiumPlant
from torch_qpmpc.experiment.tasks import AnyPlant
from torch_qpmpc.learning.actor_critic import (
    ActionValue,
    BoundedPolicy,
    ClippedPolicy,
    GaussianPolicy,
    Squashable,
    Standardised,
    clipped,
)
from torch_qpmpc.learning.operators import (
    POLICY_ACTIVE_SET,
    QPActorValueOperator,
    known_keys,
    preview_key,
)
from torch_qpmpc.learning.theta_network import ThetaNetwork
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.mpc.validation import COST

#: Relative standard deviation of a QP critic's initial parameters around the actor's.
SPREAD = 0.01
#: Initial standard deviation of SAC's QP actors, relative to half the distance of the bounds.
INITIAL_STD = 0.3
#: TD3's updates of the critics for one of the actor.
POLICY_DELAY = 2
#: Steps with random actions from which the mean and deviation of a network's inputs are taken.
TYPICAL_STEPS = 50


def typical_inputs(cfg: DictConfig, mpc: QPMPC, physics: AnyPlant) -> tuple[Tensor, Tensor]:
    """Return the mean and the deviation of p ``(n_p,)`` under random actions."""
    env = physics.vectorised(cfg.num_envs, cfg.task.episode_steps, seed=cfg.seed)
    steps = env.rollout(TYPICAL_STEPS, break_when_any_done=False)
    env.close()
    p = torch.cat([steps[key].flatten(0, -2) for key in known_keys(mpc)], -1)
    deviation = p.std(0)
    return p.mean(0), torch.where(deviation > 1e-6, deviation, 1.0)


def make_actor(cfg: DictConfig, mpc: QPMPC, physics: AnyPlant) -> Any:
    """Make the deterministic actor, which writes an action within the plant's bounds."""
    low, high, keys, out = physics.lb_a, physics.ub_a, known_keys(mpc), cast("Any", ["action"])
    if cfg.algo.actor == "qp":
        return TensorDictModule(ClippedPolicy(mpc, low, high), keys, out)
    centre, spread = typical_inputs(cfg, mpc, physics)
    if cfg.algo.actor == "mlp":
        policy = BoundedPolicy(mpc.n_p, low, high, cfg.algo.width)
        return TensorDictModule(Standardised(centre, spread, policy), keys, out)
    inputs: Any = TensorDictModule(Standardised(centre, spread), keys, ["standardised"])
    sizes = {"q": cfg.algo.theta.q, "b": cfg.algo.theta.b}
    options = {"width": cfg.algo.width, "in_keys": ["standardised"]}
    network: Any = ThetaNetwork(mpc, sizes, **options)
    operator = QPActorValueOperator(
        mpc, preview_key=preview_key(mpc), theta_keys=network.theta_keys
    )
    policy: Any = operator.get_policy_operator()
    clip: Any = TensorDictModule(partial(clipped, low=low, high=high), out, out)
    return TensorDictSequential(inputs, network, policy, clip, selected_out_keys=out)


def make_stochastic_actor(cfg: DictConfig, mpc: QPMPC, physics: AnyPlant) -> Any:
    """Make SAC's actor, which draws actions within the plant's bounds."""
    low, high, keys = physics.lb_a, physics.ub_a, known_keys(mpc)
    names: Any = ["loc", "scale"]
    if cfg.algo.actor == "mlp":
        policy = GaussianPolicy(mpc.n_p, mpc.n_u, cfg.algo.width)
        standardised = Standardised(*typical_inputs(cfg, mpc, physics), policy)
        module: Any = TensorDictModule(standardised, keys, names)
    else:
        squash: Any = TensorDictModule(Squashable(low, high, INITIAL_STD), ["action"], names)
        module = TensorDictSequential(
            make_actor(cfg, mpc, physics), squash, selected_out_keys=names
        )
    bounds = {"low": low, "high": high, "tanh_loc": False}
    return ProbabilisticActor(
        module, in_keys=names, distribution_class=TanhNormal, distribution_kwargs=bounds
    )


def make_closed_loop_actor(
    cfg: DictConfig, mpc: QPMPC, loss_module: LossModule, physics: AnyPlant
) -> TensorDictModuleBase:
    """Make the actor for the closed loop; a QP is warm-started from the previous step."""
    if cfg.algo.actor != "qp" or cfg.algo.name == "sac":
        actor = cast("Any", loss_module.actor_network)
        return TensorDictSequential(actor, selected_out_keys=["action"])
    operator = QPActorValueOperator(mpc, preview_key=preview_key(mpc))
    policy: Any = operator.get_policy_operator(POLICY_ACTIVE_SET)
    bounds = {"low": physics.lb_a, "high": physics.ub_a}
    clip: Any = TensorDictModule(partial(clipped, **bounds), ["action"], ["action"])
    return TensorDictSequential(policy, clip)


def make_critic(cfg: DictConfig, mpc: QPMPC, physics: AnyPlant) -> Any:
    """Make the critic for TorchRL's losses, which writes state_action_value."""
    if cfg.algo.critic == "qp":
        critic = copy.deepcopy(mpc)
        with torch.no_grad():
            for parameter in critic.parameters():
                parameter.mul_(1 + SPREAD * torch.randn_like(parameter))
        return QPActorValueOperator(critic, preview_key=preview_key(mpc))
    # The network's output scale is the return of unit rewards; a wrong scale slows learning.
    steps = cfg.task.episode_steps or cast("GymnasiumPlant", physics).max_steps
    scale = sum(cfg.task.gamma**k for k in range(steps))
    network = ActionValue(mpc.n_p, mpc.n_u, cfg.algo.width, scale)
    bounds = torch.stack((physics.lb_a, physics.ub_a))
    of_action = bounds.mean(0), (bounds[1] - bounds[0]) / 2
    of_p = typical_inputs(cfg, mpc, physics)
    centre, spread = (torch.cat(pair) for pair in zip(of_p, of_action, strict=True))
    standardised = Standardised(centre, spread, network)
    return TensorDictModule(standardised, [*known_keys(mpc), "action"], ["state_action_value"])


def make_actor_critic_loss(cfg: DictConfig, mpc: QPMPC, physics: AnyPlant) -> LossModule:
    """Make TorchRL's loss for ``cfg.algo``, with target networks; ``mpc`` is the actor's QP."""
    low, high = physics.lb_a, physics.ub_a
    if cfg.algo.name == "ddpg":
        actor, critic = make_actor(cfg, mpc, physics), make_critic(cfg, mpc, physics)
        return DDPGLoss(actor, critic, delay_actor=True, delay_value=True)
    if cfg.algo.name == "sac":
        actor = make_stochastic_actor(cfg, mpc, physics)
        critics = [make_critic(cfg, mpc, physics) for _ in range(2)]
        return SACLoss(actor, critics, action_spec=Bounded(low, high), loss_function="l2")
    bounds: Any = (low.float(), high.float())  # TD3Loss annotates tuple[float]
    return TD3Loss(
        make_actor(cfg, mpc, physics),
        [make_critic(cfg, mpc, physics) for _ in range(2)],
        bounds=bounds,
        loss_function="l2",
    )


def actor_groups(cfg: DictConfig, mpc: QPMPC, loss_module: LossModule) -> list[dict[str, Any]]:
    """Make the actor's parameter groups, with ``cfg.algo.actor_rate`` times a critic's rates.

    SAC's temperature has a network's rate.
    """
    share, rates, groups = cfg.algo.actor_rate, cfg.optimizer, []
    params: Any = loss_module.actor_network_params
    leaves = [leaf for leaf in params.parameters() if leaf.requires_grad]
    if cfg.algo.actor != "mlp":
        own = {"cost": share * rates.lr_cost, "constraints": share * rates.lr_constraints}
        groups = mpc.parameter_groups(own)
        of_qp = {id(leaf) for group in groups for leaf in group["params"]}
        leaves = [leaf for leaf in leaves if id(leaf) not in of_qp]
    if leaves:
        groups.append({"params": leaves, "lr": share * cfg.algo.lr_network, "name": "actor"})
    if cfg.algo.name == "sac":
        temperature: Any = loss_module.log_alpha
        groups.append({"params": [temperature], "lr": cfg.algo.lr_network, "name": "alpha"})
    return groups


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
