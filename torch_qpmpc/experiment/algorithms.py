"""The parts that train.py puts together, each made from the configuration."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from omegaconf import DictConfig
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch.optim.lr_scheduler import LambdaLR
from torchrl.objectives import LossModule, SoftUpdate

from torch_qpmpc.analysis.model_error import one_step_error
from torch_qpmpc.analysis.plots import constraint_figure, policy_figure, slice_between
from torch_qpmpc.analysis.prediction_form import prediction_form
from torch_qpmpc.analysis.report import structure_metrics
from torch_qpmpc.analysis.structure import distance_by_band, nearest_model
from torch_qpmpc.envs import GymnasiumPlant, LinearSystem
from torch_qpmpc.envs.closed_loop import ClosedLoop, closed_gap, gap_text
from torch_qpmpc.experiment.actor_critic import actor_groups, critic_groups, make_actor_critic_loss
from torch_qpmpc.experiment.plots import closed_loop_figure, predictions_figure
from torch_qpmpc.experiment.run_folder import RunFolder
from torch_qpmpc.experiment.tasks import find_task
from torch_qpmpc.learning.gauss_newton import GaussNewton
from torch_qpmpc.learning.operators import QPActorValueOperator
from torch_qpmpc.learning.penalties import DeviationPenalty, SystemIdentificationPenalty
from torch_qpmpc.learning.q_learning import QPQLearningLoss
from torch_qpmpc.learning.updates import Update, first_order, second_order
from torch_qpmpc.mpc.module import QPMPC

#: How many numbers a part of theta may have to be shown one by one.
FEW = 16


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
        actor = operator.get_policy_operator()
    else:
        loss_module = make_actor_critic_loss(cfg, mpc, physics.lb_a, physics.ub_a)
        actor = loss_module.actor_network
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


def act(actor: TensorDictModuleBase, s: Tensor) -> Tensor:
    """The policy of ``actor``, as a function: s ``(*batch, n_x)`` to ``(*batch, n_u)``."""
    return actor(observation=s)


def evaluate(
    cfg: DictConfig, policy: Callable[[Tensor], Tensor], physics: LinearSystem | GymnasiumPlant
) -> ClosedLoop:
    """``policy`` from the starts and with the noise of ``cfg.eval_seed``."""
    options = {} if cfg.eval_seed is None else {"seed": cfg.eval_seed}
    return find_task(cfg.task).closed_loop(
        policy, physics, steps=cfg.task.eval_steps, gamma=cfg.task.gamma, **options
    )


def report(
    run: RunFolder, mpc: QPMPC | None, loops: dict[str, ClosedLoop], update: int
) -> dict[str, Any]:
    """Log an evaluation: J between its two ends, what C says, and figures if wanted.

    Before the first update, J alone; after the last, the predictions and the policy, too.

    Args:
        mpc: None where the learned policy is no QP's.

    Returns:
        `gap_summary` of ``loops``.
    """
    summary = gap_summary(loops)
    run.log({f"eval/{name}": summary[key] for name, key in LOGGED_OF_LOOPS.items()}, update)
    if mpc is None or update == 0:
        return summary
    distances = distance_by_band(mpc.C, mpc.C_0, mpc.n_x, mpc.n_u)
    distances |= structure_metrics(mpc)
    run.log({f"structure/{name}": distance for name, distance in distances.items()}, update)
    if run.cfg.figures:
        run.figure("structure/C", constraint_figure(mpc), update)
        run.figure("eval/closed_loop", closed_loop_figure(loops, mpc), update)
    if run.cfg.figures and update == run.cfg.updates:
        states = loops["learned"].states
        if states.isfinite().all():
            run.figure("eval/predictions", predictions_figure(mpc, loops["learned"]), update)
        if mpc.n_x > 1:
            run.figure("eval/policy", policy_figure(slice_between(mpc, states[0])), update)
    return summary


#: The names of an evaluation's scalars, and which of `gap_summary` they are.
LOGGED_OF_LOOPS = {
    "J": "J_final",
    "J_true_model": "J_true_model",
    "J_discounted": "J_discounted_final",
    "closed_gap": "closed_gap",
}


def structure_summary(mpc: QPMPC, true_model: Sequence[Tensor] | None) -> dict[str, float]:
    """How far the learned constraints are from an MPC scheme's, and from the true model if any.

    Returns:
        ``canonical_distance``, to the nearest scheme, and ``model_error``, of that scheme's model
        in one step (see `one_step_error`), with ``model_error_start``, that of C_0.
    """
    if true_model is None:
        return {"canonical_distance": structure_metrics(mpc)["distance_to_mpc"]}
    metrics = structure_metrics(mpc, true_model)
    start = nearest_model(prediction_form(mpc.C_0, mpc.n_x, mpc.n_u))
    return {
        "canonical_distance": metrics["distance_to_mpc"],
        "model_error": metrics["model_error"],
        "model_error_start": one_step_error(start, *true_model).item(),
    }


def theta_metrics(mpc: QPMPC) -> dict[str, float]:
    """The learned numbers of the parts that have few, by name."""
    few = {name: part for name, part in mpc.readable().items() if part.numel() <= FEW}
    return {
        f"theta/{name}_{i}" if part.ndim else f"theta/{name}": value
        for name, part in few.items()
        for i, value in enumerate(part.flatten().tolist())
    }


def gap_summary(loops: dict[str, ClosedLoop]) -> dict[str, float]:
    """J at the start, at the end and with the true model, and the closed gap; both discountings.

    nan for what there is not, as a plant without a true model.
    """
    summary = {}
    for tag, suffix in (("J", ""), ("J_discounted", "_discounted")):
        start, final, true = (
            getattr(loops.get(name), tag, math.nan) for name in ("start", "learned", "true model")
        )
        summary |= {f"{tag}_start": start, f"{tag}_final": final, f"{tag}_true_model": true}
        summary[f"closed_gap{suffix}"] = closed_gap(start, final, true)
    return summary


def table(summary: Mapping[str, Any]) -> str:
    """The outcome for the terminal."""
    lines = [f"{'':14}{'start':>10}{'learned':>10}{'true model':>12}{'closed gap':>12}"]
    for name, tag in (("J", "J"), ("J discounted", "J_discounted")):
        start, final, true = (summary[f"{tag}_{end}"] for end in ("start", "final", "true_model"))
        gap = summary[f"closed_gap{tag.removeprefix('J')}"]
        share = gap_text(gap, start, final, true, name)
        cell = f"  {share}" if math.isnan(gap) else f"{share:>12}"
        lines.append(f"{name:14}{start:10.1f}{final:10.1f}{true:12.1f}{cell}")
    return "\n".join(lines)
