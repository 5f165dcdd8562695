"""The learner of train.py, made from the configuration: loss, actor, optimiser, penalties."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor
from torch.optim.lr_scheduler import LambdaLR
from torchrl.collectors import Collector
from torchrl.modules import AdditiveGaussianModule

from torch_qpmpc.envs.closed_loop import SEED, ClosedLoop, closed_loop
from torch_qpmpc.experiment.config import Config, find_task
from torch_qpmpc.experiment.logs import without_blow_ups
from torch_qpmpc.experiment.tasks import AnyPlant
from torch_qpmpc.experiment.tasks.identified import FEWER
from torch_qpmpc.identification.steps import valid_steps
from torch_qpmpc.learning.gauss_newton import GaussNewton
from torch_qpmpc.learning.operators import (
    POLICY_ACTIVE_SET,
    QPActorValueOperator,
    preview_key,
)
from torch_qpmpc.learning.penalties import DeviationPenalty, Penalties, SystemIdentificationPenalty
from torch_qpmpc.learning.q_learning import QPQLearningLoss
from torch_qpmpc.learning.replay import ACTIVE_SET, Replay
from torch_qpmpc.learning.updates import Update, first_order, second_order
from torch_qpmpc.mpc.module import QPMPC


@dataclass(frozen=True)
class Learner:
    """The objects that update theta."""

    learn: Update  # updates theta from a batch
    loss_module: QPQLearningLoss  # the loss
    actor: TensorDictModuleBase  # maps observation to action, without exploration
    optimizer: torch.optim.Optimizer
    scheduler: LambdaLR
    penalties: Penalties  # those that are on

    def centre(self, replay: Replay) -> float:
        """Make the mean TD error of the stored steps zero by c alone; return the change of c.

        Steps that blow up do not count.
        """
        steps, _ = without_blow_ups(replay.steps())
        return self.loss_module.centre_(steps[valid_steps(steps)])


def make_operator(mpc: QPMPC) -> QPActorValueOperator:
    """Make the operator of the run's QP, with the keys that the environments and replay have."""
    return QPActorValueOperator(mpc, preview_key=preview_key(mpc), active_set_key=ACTIVE_SET)


def make_learner(cfg: Config, operator: QPActorValueOperator) -> Learner:
    """Make the learner of the operator's QP."""
    mpc = operator.module
    loss_module = QPQLearningLoss(operator, td_error_clip=cfg.td_error_clip, weighted=cfg.weighted)
    loss_module.make_value_estimator(gamma=cfg.task.gamma)
    penalties = make_penalties(cfg, mpc)
    optimizer: Any = make_optimizer(cfg, mpc)
    last, updates = cfg.optimizer.final_fraction, cfg.updates
    scheduler = LambdaLR(optimizer, lambda k: 1 - (1 - last) * min(k / updates, 1))
    make = second_order if isinstance(optimizer, GaussNewton) else first_order
    update = make(mpc, loss_module, optimizer, penalties)
    actor = operator.get_policy_operator(POLICY_ACTIVE_SET)
    return Learner(update, loss_module, actor, optimizer, scheduler, penalties)


def make_penalties(cfg: Config, mpc: QPMPC) -> Penalties:
    """Make the penalties of a run."""
    own, si = cfg.constraint.deviation, cfg.constraint.si
    own = own if mpc.sequential is None else None  # no C is learned
    return Penalties(
        deviation=own and DeviationPenalty(mpc, c_1=own.c_1, c_2=own.c_2, c_3=own.c_3),
        si=si and SystemIdentificationPenalty(si.beta),
    )


def make_optimizer(cfg: Config, mpc: QPMPC) -> torch.optim.Optimizer:
    """Make the optimiser, with one rate for the cost and one for the constraints."""
    options = cfg.optimizer
    if options.name == "gauss_newton":
        scales = {"cost": 1.0, "constraints": options.scale_constraints}
        return GaussNewton(mpc, scales=scales, lr=options.lr, damping=options.damping)
    rates = {"cost": options.lr_cost, "constraints": options.lr_constraints}
    groups = mpc.parameter_groups(rates)
    if options.name == "adam":
        first, second = options.betas
        return torch.optim.Adam(groups, betas=(first, second))
    return torch.optim.SGD(groups)


def evaluate(
    cfg: Config,
    policy: Callable[[Tensor], Tensor],
    physics: AnyPlant,
    seed: int | None = None,
    starts: int | None = None,
) -> ClosedLoop:
    """Run ``policy`` in closed loop, with the starts and the noise of a seed, or ``eval_seed``."""
    seed = next(x for x in (seed, cfg.eval_seed, SEED) if x is not None)
    starts = starts or find_task(cfg.task).starts
    return closed_loop(policy, physics, steps=cfg.task.eval_steps, starts=starts, seed=seed)


def make_collector(cfg: Config, physics: AnyPlant, actor: TensorDictModuleBase) -> Collector:
    """Make the collector of ``actor``'s vectorised episodes with Gaussian exploration.

    The actor's active sets are left out of its batches: only the next step uses them.
    """
    env = physics.vectorised(cfg.num_envs, cfg.task.episode_steps, seed=cfg.seed)
    exploration = AdditiveGaussianModule(
        env.action_spec, sigma_init=cfg.exploration_std, sigma_end=cfg.exploration_std
    )
    policy = TensorDictSequential([actor, exploration])
    options: Any = {
        "frames_per_batch": cfg.num_envs * cfg.steps_per_update,
        "total_frames": -1,
        "auto_register_policy_transforms": False,
        "postproc": lambda batch: batch.exclude(POLICY_ACTIVE_SET),
    }
    return Collector(env, policy, **options)


def make_run_replay(cfg: Config, mpc: QPMPC) -> Replay:
    """Make a run's replay of transitions and, for the SI penalty, of windows."""
    si = cfg.constraint.si
    return Replay(
        cfg.replay_capacity,
        cfg.num_envs,
        cfg.batch_size if mpc.sequential is None else min(cfg.batch_size, FEWER),
        cfg.task.horizon,
        1 if si is None else si.windows,
        seed=cfg.seed,
        active_rows=len(mpc.G),
        preview_key=preview_key(mpc),
    )


def warm_up_batches(cfg: Config) -> int:
    """Return the number of batches, of ``steps_per_update`` steps each, of a run's warm-up."""
    return -(-cfg.warmup_steps // cfg.steps_per_update)
