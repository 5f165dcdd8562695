"""The parts that train.py puts together, each made from the configuration."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from omegaconf import DictConfig
from tensordict.nn import TensorDictSequential
from torch.optim.lr_scheduler import LambdaLR
from torchrl.collectors import Collector
from torchrl.modules import AdditiveGaussianModule
from torchrl.objectives import SoftUpdate

from torch_qpmpc.envs import LinearSystem, LinearSystemEnv
from torch_qpmpc.evaluation import ClosedLoop, closed_gap, closed_loop
from torch_qpmpc.gauss_newton import GaussNewton
from torch_qpmpc.mpc import QPMPC
from torch_qpmpc.objectives import QPQLearningLoss
from torch_qpmpc.operators import QPActorValueOperator
from torch_qpmpc.penalties import DeviationPenalty, SystemIdentificationPenalty
from torch_qpmpc.plots import closed_loop_figure, constraint_figure
from torch_qpmpc.structure import distance_by_band
from torch_qpmpc.tracking import RunFolder
from torch_qpmpc.updates import Update, first_order, second_order

#: How many numbers a part of theta may have to be shown one by one.
FEW = 16


@dataclass(frozen=True)
class Learner:
    """What moves theta, for as long as its parameters are the same.

    Attributes:
        learn: what a batch does to theta.
        deviation, si: the penalties that are on.
        target: the soft update of the target network, if there is one.
    """

    learn: Update
    optimizer: torch.optim.Optimizer
    schedule: LambdaLR
    deviation: DeviationPenalty | None
    si: SystemIdentificationPenalty | None
    target: SoftUpdate | None


def make_learner(cfg: DictConfig, operator: QPActorValueOperator, done: int = 0) -> Learner:
    """Q-learning: V and Q from one QP, two learning rates, and the penalties on C.

    ``done`` updates have been made before, for the schedule of the rates.
    """
    mpc = operator.module
    loss_module = QPQLearningLoss(
        operator, delay_value=cfg.delay_value, td_error_clip=cfg.td_error_clip
    )
    loss_module.make_value_estimator(gamma=cfg.task.gamma)
    deviation, si = make_penalties(cfg, mpc)
    optimizer = make_optimizer(cfg, mpc)
    return Learner(
        make_update(cfg, mpc, loss_module, optimizer, deviation, si),
        optimizer,
        make_schedule(cfg, optimizer, done),
        deviation,
        si,
        SoftUpdate(loss_module, tau=cfg.target_rate) if cfg.delay_value else None,
    )


def make_collector(
    cfg: DictConfig, physics: LinearSystem, operator: QPActorValueOperator
) -> Collector:
    """Vectorised episodes under today's policy with Gaussian exploration."""
    env = LinearSystemEnv(physics, cfg.num_envs, cfg.task.episode_steps, seed=cfg.seed)
    exploration = AdditiveGaussianModule(
        env.action_spec, sigma_init=cfg.exploration_std, sigma_end=cfg.exploration_std
    )
    return Collector(
        env,
        TensorDictSequential([operator.get_policy_operator(), exploration]),
        frames_per_batch=cfg.num_envs * cfg.steps_per_update,
        total_frames=-1,
        auto_register_policy_transforms=False,
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


def make_optimizer(cfg: DictConfig, mpc: QPMPC) -> torch.optim.Optimizer:
    """The optimiser, with one rate for the cost and one for the constraints."""
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
    groups = mpc.parameter_groups({"cost": options.lr_cost, "constraints": options.lr_constraints})
    if options.name == "adam":
        return torch.optim.Adam(groups, betas=tuple(options.betas))
    return torch.optim.SGD(groups)


def make_update(
    cfg: DictConfig,
    mpc: QPMPC,
    loss_module: QPQLearningLoss,
    optimizer: torch.optim.Optimizer,
    deviation: DeviationPenalty | None,
    si: SystemIdentificationPenalty | None,
) -> Update:
    """What a batch does to theta, by the optimiser's order."""
    if isinstance(optimizer, GaussNewton):
        return second_order(mpc, loss_module, optimizer, si)
    by_gradient = deviation if cfg.penalty_step == "subgradient" else None
    return first_order(mpc, loss_module, optimizer, by_gradient, si)


def make_schedule(cfg: DictConfig, optimizer: torch.optim.Optimizer, done: int = 0) -> LambdaLR:
    """The rates fall with the updates, of which ``done`` have been made before."""
    # A configuration's values take longer to look up than such a function to evaluate.
    last, updates = cfg.optimizer.final_fraction, cfg.updates
    return LambdaLR(optimizer, lambda update: decay(done + update, updates, last))


def decay(update: int, updates: int, last: float) -> float:
    """What a rate is multiplied by after ``update`` of ``updates``: from 1 linearly to ``last``."""
    return 1 - (1 - last) * min(update / updates, 1)


def evaluate(cfg: DictConfig, mpc: QPMPC, physics: LinearSystem) -> ClosedLoop:
    """The policy without exploration, from the fixed starts and with the fixed noise."""
    return closed_loop(mpc.policy, physics, steps=cfg.task.eval_steps, gamma=cfg.task.gamma)


def report(run: RunFolder, mpc: QPMPC, loops: dict[str, ClosedLoop], update: int) -> dict[str, Any]:
    """Log an evaluation: J between its two ends, the distance of C to C_0, and figures if wanted.

    Returns:
        `gap_summary` of ``loops``.
    """
    summary = gap_summary(loops)
    run.log({"eval/J": summary["J_final"], "eval/J_true_model": summary["J_true_model"]}, update)
    run.log({"eval/J_discounted": summary["J_discounted_final"]}, update)
    run.log({"eval/closed_gap": summary["closed_gap"]}, update)
    distances = distance_by_band(mpc.C, mpc.C_0, mpc.n_x, mpc.n_u)
    run.log({f"structure/{band}": distance for band, distance in distances.items()}, update)
    if run.cfg.figures:
        run.figure("structure/C", constraint_figure(mpc), update)
        run.figure("eval/closed_loop", closed_loop_figure(loops, mpc), update)
    return summary


def theta_metrics(mpc: QPMPC) -> dict[str, float]:
    """The learned numbers of the parts that have few, by name."""
    few = {name: part for name, part in mpc.readable().items() if part.numel() <= FEW}
    return {
        f"theta/{name}_{i}" if part.ndim else f"theta/{name}": value
        for name, part in few.items()
        for i, value in enumerate(part.flatten().tolist())
    }


def stream_summary(costs: list[float], violation: float) -> dict[str, float]:
    """What learning itself cost: the mean cost of a step, over all updates and over the last tenth,
    and the violation of the states' bounds, summed over all steps."""
    last = costs[-max(1, len(costs) // 10) :]
    return {
        "train_cost": sum(costs) / len(costs),
        "train_cost_last_tenth": sum(last) / len(last),
        "train_violation": violation,
    }


def gap_summary(loops: dict[str, ClosedLoop]) -> dict[str, float]:
    """J at the start, at the end and with the true model, and the closed gap; both discountings."""
    summary = {}
    for tag, suffix in (("J", ""), ("J_discounted", "_discounted")):
        start, final, true = (
            getattr(loops[name], tag) for name in ("start", "learned", "true model")
        )
        summary |= {f"{tag}_start": start, f"{tag}_final": final, f"{tag}_true_model": true}
        summary[f"closed_gap{suffix}"] = closed_gap(start, final, true)
    return summary


def table(summary: dict[str, float]) -> str:
    """The outcome for the terminal."""
    lines = [f"{'':14}{'start':>10}{'learned':>10}{'true model':>12}{'closed gap':>12}"]
    for name, tag, gap in (
        ("J", "J", "closed_gap"),
        ("J discounted", "J_discounted", "closed_gap_discounted"),
    ):
        values = [summary[f"{tag}_{end}"] for end in ("start", "final", "true_model")]
        share = "  no gap" if math.isnan(summary[gap]) else f"{summary[gap]:.3f}"
        lines.append(f"{name:14}{values[0]:10.1f}{values[1]:10.1f}{values[2]:12.1f}{share:>12}")
    return "\n".join(lines)
