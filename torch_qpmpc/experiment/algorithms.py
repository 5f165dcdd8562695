"""The parts that train.py puts together, each made from the configuration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from omegaconf import DictConfig
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch.optim.lr_scheduler import LambdaLR
from torchrl.objectives import LossModule, SoftUpdate

from torch_qpmpc.envs import GymnasiumPlant, LinearSystem
from torch_qpmpc.envs.closed_loop import ClosedLoop
from torch_qpmpc.experiment.actor_critic import (
    actor_groups,
    critic_groups,
    make_acting,
    make_actor_critic_loss,
)
from torch_qpmpc.experiment.tasks import find_task
from torch_qpmpc.learning.gauss_newton import GaussNewton
from torch_qpmpc.learning.operators import POLICY_ACTIVE_SET, QPActorValueOperator
from torch_qpmpc.learning.penalties import DeviationPenalty, SystemIdentificationPenalty
from torch_qpmpc.learning.q_learning import QPQLearningLoss
from torch_qpmpc.learning.updates import Update, first_order, second_order
from torch_qpmpc.mpc.module import QPMPC


@dataclass(frozen=True)
class Learner:
    """What moves theta, for as long as its parameters are the same.

    Attributes:
        learn: what a batch does to theta.
        loss_module: with the target networks and the critics that there are.
        actor: observation to action, without exploration.
        deviation, si: the penalties that are on.
        target: the soft update of the target network, if there is one.
    """

    learn: Update
    loss_module: LossModule
    actor: TensorDictModuleBase
    optimizer: torch.optim.Optimizer
    schedule: LambdaLR
    deviation: DeviationPenalty | None
    si: SystemIdentificationPenalty | None
    target: SoftUpdate | None

    def advance(self) -> None:
        """End an update: the rates fall, and the target network follows."""
        self.schedule.step()
        if self.target is not None:
            self.target.step()


def make_learner(
    cfg: DictConfig,
    operator: QPActorValueOperator,
    physics: LinearSystem | GymnasiumPlant,
    done: int = 0,
) -> Learner:
    """What ``cfg.algo`` says, two learning rates, and the penalties on C.

    ``done`` updates have been made before, for the schedule of the rates.
    """
    mpc = operator.module
    if cfg.algo.name == "qlearning":
        loss_module = QPQLearningLoss(
            operator, delay_value=cfg.delay_value, td_error_clip=cfg.td_error_clip
        )
        actor = operator.get_policy_operator(POLICY_ACTIVE_SET)
    else:
        bounds = physics.lb_a, physics.ub_a
        loss_module = make_actor_critic_loss(cfg, mpc, *bounds)
        actor = make_acting(cfg, mpc, loss_module, *bounds)
    loss_module.make_value_estimator(gamma=cfg.task.gamma)
    deviation, si = make_penalties(cfg, mpc)
    optimizer = make_optimizer(cfg, mpc, loss_module)
    schedule = make_schedule(cfg, optimizer, done)
    delayed = cfg.algo.name != "qlearning" or cfg.delay_value
    return Learner(
        make_update(cfg, mpc, loss_module, optimizer, schedule, deviation, si, done),
        loss_module,
        actor,
        optimizer,
        schedule,
        deviation,
        si,
        SoftUpdate(loss_module, tau=cfg.target_rate) if delayed else None,
    )


def make_penalties(
    cfg: DictConfig, mpc: QPMPC
) -> tuple[DeviationPenalty | None, SystemIdentificationPenalty | None]:
    """The penalties that are on."""
    deviation, si = cfg.constraint.deviation, cfg.constraint.si
    return (
        None if deviation is None else DeviationPenalty(mpc.C_0, mpc.n_x, mpc.n_u, **deviation),
        None if si is None else SystemIdentificationPenalty(si.beta, normalised=si.normalised),
    )


def make_optimizer(
    cfg: DictConfig, mpc: QPMPC, loss_module: LossModule | None = None
) -> torch.optim.Optimizer:
    """The optimiser, with one rate for the cost and one for the constraints.

    ``loss_module`` is that of an actor, whose critics learn, too.
    """
    options = cfg.optimizer
    if options.name == "gauss_newton":
        return GaussNewton(
            mpc,
            scales={"cost": options.scale_cost, "constraints": options.scale_constraints},
            lr=options.lr,
            damping=options.damping,
            memory=options.memory,
            td_error_clip=cfg.td_error_clip,
            trust_region=options.trust_region,
        )
    rates = {"cost": options.lr_cost, "constraints": options.lr_constraints}
    if loss_module is None or cfg.algo.name == "qlearning":
        groups = mpc.parameter_groups(rates)
    else:
        groups = [*actor_groups(cfg, mpc, loss_module), *critic_groups(cfg, loss_module)]
    if options.name == "adam":
        return torch.optim.Adam(groups, betas=tuple(options.betas))
    return torch.optim.SGD(groups)


def make_update(
    cfg: DictConfig,
    mpc: QPMPC,
    loss_module: LossModule,
    optimizer: torch.optim.Optimizer,
    schedule: LambdaLR,
    deviation: DeviationPenalty | None,
    si: SystemIdentificationPenalty | None,
    done: int,
) -> Update:
    """What a batch does to theta, by the optimiser's order."""
    if isinstance(optimizer, GaussNewton):
        assert isinstance(loss_module, QPQLearningLoss)
        return second_order(mpc, loss_module, optimizer, deviation, si)
    every = cfg.algo.policy_delay if cfg.algo.name == "td3" else 1
    return first_order(
        mpc,
        loss_module,
        optimizer,
        deviation,
        si,
        cfg.penalty_step,
        lambda: (done + schedule.last_epoch + 1) % every == 0,
    )


def make_schedule(cfg: DictConfig, optimizer: torch.optim.Optimizer, done: int = 0) -> LambdaLR:
    """The rates fall with the updates, of which ``done`` have been made before."""
    # A configuration's values take longer to look up than such a function to evaluate.
    last, updates = cfg.optimizer.final_fraction, cfg.updates
    return LambdaLR(optimizer, lambda update: decay(done + update, updates, last))


def decay(update: int, updates: int, last: float) -> float:
    """What a rate is multiplied by after ``update`` of ``updates``: from 1 linearly to ``last``."""
    return 1 - (1 - last) * min(update / updates, 1)


def evaluate(
    cfg: DictConfig, policy: Callable[[Tensor], Tensor], physics: LinearSystem | GymnasiumPlant
) -> ClosedLoop:
    """``policy`` from the starts and with the noise of ``cfg.eval_seed``."""
    options = {} if cfg.eval_seed is None else {"seed": cfg.eval_seed}
    return find_task(cfg.task).closed_loop(
        policy, physics, steps=cfg.task.eval_steps, gamma=cfg.task.gamma, **options
    )
