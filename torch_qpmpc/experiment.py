"""The parts that train.py puts together, each made from the configuration."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import torch
from omegaconf import DictConfig
from tensordict.nn import TensorDictSequential
from torch.optim.lr_scheduler import LambdaLR
from torchrl.collectors import Collector
from torchrl.modules import AdditiveGaussianModule

from torch_qpmpc.envs.point_mass import PointMass, PointMassEnv
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


def make_physics(cfg: DictConfig) -> PointMass:
    """The true system with the run's noise."""
    return PointMass(noise_kind=cfg.noise.name, noise_std=cfg.noise.std)


def make_mpc(cfg: DictConfig, physics: PointMass) -> QPMPC:
    """The QP that learns: it starts from the seed's corrupted model and random cost."""
    A, B, theta = physics.corrupted(cfg.seed)
    learn = (*cfg.task.learn_cost, *cfg.constraint.learn)
    return _mpc(cfg, physics, A, B, theta, learn)


def make_true_mpc(cfg: DictConfig, physics: PointMass) -> QPMPC:
    """The other end: the same QP with the true model and the true cost, 1/2 H_k = W."""
    return _mpc(cfg, physics, physics.A, physics.B, 2 * physics.W.diagonal(), ())


def _mpc(cfg: DictConfig, physics: PointMass, A, B, theta, learn) -> QPMPC:
    return QPMPC.from_model(
        A,
        B,
        cfg.task.horizon,
        gamma=cfg.task.gamma,
        state_bounds=(physics.lb_s, physics.ub_s),
        action_bounds=(physics.lb_a, physics.ub_a),
        hessian=cfg.task.hessian,
        stage_weight=torch.cat((theta, torch.zeros(physics.B.shape[1]))),
        state_slack=cfg.task.state_slack,
        action_slack=cfg.task.action_slack,
        discount_slack=cfg.task.discount_slack,
        learn=learn,
        solver=cfg.solver,
        on_failure="mask",
    )


def make_collector(
    cfg: DictConfig, physics: PointMass, operator: QPActorValueOperator
) -> Collector:
    """Vectorised episodes under today's policy with Gaussian exploration."""
    env = PointMassEnv(cfg.num_envs, physics, max_steps=cfg.task.episode_steps, seed=cfg.seed)
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


def make_optimizer(cfg: DictConfig, mpc: QPMPC) -> tuple[torch.optim.Optimizer, LambdaLR]:
    """The optimiser, with one rate for the cost and one for the constraints, and their decay."""
    options = cfg.optimizer
    if options.name == "gauss_newton":
        optimizer = GaussNewton(
            mpc,
            scales={"cost": options.scale_cost, "constraints": options.scale_constraints},
            damping=options.damping,
            td_error_clip=cfg.td_error_clip,
            trust_region=options.trust_region,
        )
        return optimizer, LambdaLR(optimizer, partial(decay, cfg))
    groups = mpc.parameter_groups({"cost": options.lr_cost, "constraints": options.lr_constraints})
    if options.name == "adam":
        optimizer = torch.optim.Adam(groups, betas=tuple(options.betas))
    else:
        optimizer = torch.optim.SGD(groups)
    return optimizer, LambdaLR(optimizer, partial(decay, cfg))


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


def decay(cfg: DictConfig, update: int) -> float:
    """What the learning rates are multiplied by after ``update`` updates: linear in them."""
    return 1 - (1 - cfg.optimizer.final_fraction) * min(update / cfg.updates, 1)


def evaluate(cfg: DictConfig, mpc: QPMPC, physics: PointMass) -> ClosedLoop:
    """The policy without exploration, from the fixed starts and with the fixed noise."""
    return closed_loop(mpc.policy, physics, steps=cfg.task.episode_steps, gamma=cfg.task.gamma)


def report(run: RunFolder, mpc: QPMPC, loops: dict[str, ClosedLoop], update: int) -> dict[str, Any]:
    """Log an evaluation: J between its two ends, the distance of C to C_0, and the figures.

    Returns:
        `gap_summary` of ``loops``.
    """
    summary = gap_summary(loops)
    run.log({"eval/J": summary["J_final"], "eval/J_true_model": summary["J_true_model"]}, update)
    run.log({"eval/J_discounted": summary["J_discounted_final"]}, update)
    run.log({"eval/closed_gap": summary["closed_gap"]}, update)
    distances = distance_by_band(mpc.C, mpc.C_0, mpc.n_x, mpc.n_u)
    run.log({f"structure/{band}": distance for band, distance in distances.items()}, update)
    run.figure("structure/C", constraint_figure(mpc), update)
    run.figure("eval/closed_loop", closed_loop_figure(loops, mpc), update)
    return summary


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
