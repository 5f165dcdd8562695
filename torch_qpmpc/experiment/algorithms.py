"""The learner of train.py, made from the configuration: loss, actor, optimiser, penalties."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch.optim.lr_scheduler import LambdaLR
from torchrl.objectives import LossModule, SoftUpdate

from torch_qpmpc.envs.closed_loop import ClosedLoop
from torch_qpmpc.experiment.actor_critic import (
    POLICY_DELAY,
    actor_groups,
    critic_groups,
    make_actor_critic_loss,
    make_closed_loop_actor,
)
from torch_qpmpc.experiment.blow_ups import without_blow_ups
from torch_qpmpc.experiment.tasks import AnyPlant, find_task
from torch_qpmpc.learning.gauss_newton import GaussNewton
from torch_qpmpc.learning.operators import (
    POLICY_ACTIVE_SET,
    QPActorValueOperator,
    in_closed_loop,
    preview_key,
)
from torch_qpmpc.learning.penalties import DeviationPenalty, SystemIdentificationPenalty
from torch_qpmpc.learning.prediction_errors import PredictionErrors
from torch_qpmpc.learning.q_learning import QPQLearningLoss
from torch_qpmpc.learning.replay import ACTIVE_SET, Replay
from torch_qpmpc.learning.updates import Update, first_order, second_order
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.mpc.tightening import BackOff
from torch_qpmpc.mpc.trajectories import valid_steps


@dataclass(frozen=True)
class Learner:
    """The objects that update theta; `QPMPC.release` requires a new one.

    Attributes:
        learn: updates theta from a batch.
        loss_module: the loss, with its target networks and critics.
        actor: maps observation to action, without exploration.
        deviation, si: the penalties; None if off.
        target: the soft update of an actor-critic's target networks; None for Q-learning.
        n_preview: entries of the preview, with which p begins.
        errors: the prediction errors of the transitions, which the model follows; None if off.
        back_off: tightens the bounds by their covariance; None if off.
    """

    learn: Update
    loss_module: LossModule
    actor: TensorDictModuleBase
    optimizer: torch.optim.Optimizer
    scheduler: LambdaLR
    deviation: DeviationPenalty | None
    si: SystemIdentificationPenalty | None
    target: SoftUpdate | None
    n_preview: int = 0
    errors: PredictionErrors | None = None
    back_off: BackOff | None = None

    @property
    def policy(self) -> Callable[[Tensor], Tensor]:
        """The actor as a function from p to a, for one closed loop."""
        return in_closed_loop(self.actor, self.n_preview)

    def observe(self, batch: TensorDictBase) -> None:
        """Add new transitions to the loss's range of rewards and to the prediction errors."""
        if isinstance(self.loss_module, QPQLearningLoss):
            self.loss_module.observe(batch)
        if self.errors is not None:
            assert isinstance(self.loss_module, QPQLearningLoss)
            operator, flat = self.loss_module.operator, batch.reshape(-1)
            following = operator.known(flat.get("next"))[:, -operator.module.n_x :]
            self.errors.add(operator.known(flat), flat.get(operator.in_keys[1]), following)

    def centre(self, replay: Replay) -> float:
        """Make the mean TD error of the stored steps zero by c alone; return the change of c.

        Steps that blow up do not count, and an actor-critic's c stays.
        """
        if not isinstance(self.loss_module, QPQLearningLoss):
            return 0.0
        steps, _ = without_blow_ups(replay.steps())
        return self.loss_module.centre_(steps[valid_steps(steps)])

    def advance(self) -> None:
        """Advance the learning rates, the bounds and the target network by one update."""
        self.scheduler.step()
        if self.back_off is not None and self.errors is not None:
            self.back_off.tighten(self.errors.covariance(self.back_off.mpc.quadratic_program()))
        if self.target is not None:
            self.target.step()


def make_operator(cfg: DictConfig, mpc: QPMPC) -> QPActorValueOperator:
    """Make the operator of the run's QP, with the keys that the environments and replay have."""
    active_set = ACTIVE_SET if cfg.algo.name == "qlearning" else None
    return QPActorValueOperator(mpc, preview_key=preview_key(mpc), active_set_key=active_set)


def make_learner(
    cfg: DictConfig,
    operator: QPActorValueOperator,
    physics: AnyPlant,
    *,
    done: int = 0,
) -> Learner:
    """Make the learner of ``cfg.algo``; its rates continue after ``done`` updates."""
    mpc = operator.module
    if cfg.algo.name == "qlearning":
        loss_module = QPQLearningLoss(
            operator, td_error_clip=cfg.td_error_clip, weighted=cfg.algo.weighted
        )
        actor = operator.get_policy_operator(POLICY_ACTIVE_SET)
    else:
        loss_module = make_actor_critic_loss(cfg, mpc, physics)
        actor = make_closed_loop_actor(cfg, mpc, loss_module, physics)
    loss_module.make_value_estimator(gamma=cfg.task.gamma)
    deviation, si = make_penalties(cfg, mpc)
    errors = make_errors(cfg, mpc)
    optimizer = make_optimizer(cfg, mpc, loss_module, errors)
    scheduler = make_scheduler(cfg, optimizer, done)
    update = make_update(cfg, mpc, loss_module, optimizer, scheduler, deviation, si, done)
    return Learner(
        update,
        loss_module,
        actor,
        optimizer,
        scheduler,
        deviation,
        si,
        None if cfg.algo.name == "qlearning" else SoftUpdate(loss_module, tau=cfg.target_rate),
        (mpc.horizon + 1) * mpc.n_d,
        errors,
        None if cfg.back_off is None else BackOff(mpc, cfg.back_off),
    )


def make_penalties(
    cfg: DictConfig, mpc: QPMPC
) -> tuple[DeviationPenalty | None, SystemIdentificationPenalty | None]:
    """Make the deviation and the SI penalty; None for each that is off."""
    deviation, si = cfg.constraint.deviation, cfg.constraint.si
    return (
        None if deviation is None else DeviationPenalty.of(mpc, **deviation),
        None if si is None else SystemIdentificationPenalty(si.beta),
    )


def make_errors(cfg: DictConfig, mpc: QPMPC) -> PredictionErrors | None:
    """Make the prediction errors, which model and bounds follow; None without a back-off."""
    return None if cfg.back_off is None else PredictionErrors(mpc)


def make_optimizer(
    cfg: DictConfig,
    mpc: QPMPC,
    loss_module: LossModule | None = None,
    errors: PredictionErrors | None = None,
) -> torch.optim.Optimizer:
    """Make the optimiser, with one rate for the cost and one for the constraints.

    ``errors`` are a term of Gauss-Newton's steps.
    ``loss_module`` is needed for actor-critic algorithms, whose critics are optimised, too.
    """
    options = cfg.optimizer
    if options.name == "gauss_newton":
        return GaussNewton(
            mpc,
            scales={"cost": 1.0, "constraints": options.scale_constraints},
            lr=options.lr,
            damping=options.damping,
            memory=options.memory,
            td_error_clip=cfg.td_error_clip,
            trust_region=not options.memory,  # a few new pairs do not judge a step on past ones
            normalise=not options.memory,
            residuals=None if errors is None else errors.residuals,
            weighted=cfg.algo.weighted,
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
    scheduler: LambdaLR,
    deviation: DeviationPenalty | None,
    si: SystemIdentificationPenalty | None,
    done: int,
) -> Update:
    """Make the function that updates theta from a batch, of first or second order."""
    if isinstance(optimizer, GaussNewton):
        assert isinstance(loss_module, QPQLearningLoss)
        return second_order(mpc, loss_module, optimizer, deviation, si)
    every = POLICY_DELAY if cfg.algo.name == "td3" else 1
    return first_order(
        mpc,
        loss_module,
        optimizer,
        deviation,
        si,
        lambda: (done + scheduler.last_epoch + 1) % every == 0,
    )


def make_scheduler(cfg: DictConfig, optimizer: torch.optim.Optimizer, done: int = 0) -> LambdaLR:
    """Make the linear decay of the learning rates, continued after ``done`` updates."""
    # Read once: OmegaConf's lookups are slower than the function itself.
    last, updates = cfg.optimizer.final_fraction, cfg.updates
    return LambdaLR(optimizer, lambda update: decay(done + update, updates, last))


def decay(update: int, updates: int, last: float) -> float:
    """Return the factor of the learning rates, which falls linearly from 1 to ``last``."""
    return 1 - (1 - last) * min(update / updates, 1)


def evaluate(
    cfg: DictConfig,
    policy: Callable[[Tensor], Tensor],
    physics: AnyPlant,
    seed: int | None = None,
) -> ClosedLoop:
    """Run ``policy`` in closed loop, with the starts and the noise of a seed, or ``eval_seed``."""
    seed = cfg.eval_seed if seed is None else seed
    options = {} if seed is None else {"seed": seed}
    return find_task(cfg.task).closed_loop(
        policy, physics, steps=cfg.task.eval_steps, gamma=cfg.task.gamma, **options
    )
