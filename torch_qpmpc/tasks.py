"""The tasks of train.py: a plant, the QP (eq:qp5) that learning starts from, and its aim."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import torch
from omegaconf import DictConfig
from torch import Tensor

from torch_qpmpc.envs import GrosZanonLTI, GymnasiumPlant, LinearSystem, PointMass
from torch_qpmpc.mpc import QPMPC


@dataclass(frozen=True)
class Scheme:
    """What an MPC scheme knows of a plant: x+ = A x + B u + offset, a cost, and bounds."""

    A: Tensor
    B: Tensor
    offset: Tensor
    stage_weight: Tensor
    lb_s: Tensor
    ub_s: Tensor


def make_physics(cfg: DictConfig) -> LinearSystem | GymnasiumPlant:
    """The true system, with the run's noise where that can be chosen."""
    if cfg.task.name == "gymnasium":
        return GymnasiumPlant(cfg.task.id)
    if cfg.task.name == "gros_zanon":
        return GrosZanonLTI()
    return PointMass(noise_kind=cfg.noise.name, noise_std=cfg.noise.std)


def make_mpc(cfg: DictConfig, physics: LinearSystem | GymnasiumPlant) -> QPMPC:
    """The QP that learns: it starts from a wrong model, or from the one that the task gives."""
    learn = (*cfg.task.learn_cost, *cfg.constraint.learn)
    if isinstance(physics, LinearSystem):
        return _make(cfg, physics, _wrong_scheme(physics, cfg.seed), learn)
    return _make(cfg, physics, _given_scheme(cfg, physics), learn)


def make_true_mpc(cfg: DictConfig, physics: LinearSystem | GymnasiumPlant) -> QPMPC | None:
    """The other end: the same QP with the true model, cost and bounds; None where there is none."""
    if not isinstance(physics, LinearSystem):
        return None
    return _make(cfg, physics, _true_scheme(physics), ())


def _given_scheme(cfg: DictConfig, physics: GymnasiumPlant) -> Scheme:
    """The model and the weight in the task's configuration, the bounds of the plant's spaces."""
    A, B, weight = (
        torch.tensor(cfg.task[name], dtype=torch.float64) for name in ("A", "B", "stage_weight")
    )
    return Scheme(A, B, torch.zeros_like(physics.lb_s), weight, physics.lb_s, physics.ub_s)


def true_model(
    physics: LinearSystem | GymnasiumPlant,
) -> tuple[Tensor, Tensor, Tensor] | None:
    """A, B and the offset of the plant, the mean of its noise; None where it has no such model."""
    if not isinstance(physics, LinearSystem):
        return None
    scheme = _true_scheme(physics)
    return scheme.A, scheme.B, scheme.offset


def _wrong_scheme(physics: LinearSystem, seed: int) -> Scheme:
    """The point mass's corruption and random cost are the seed's; the other has no random ones."""
    none = torch.zeros_like(physics.lb_s)
    if isinstance(physics, PointMass):
        A, B, theta = physics.corrupted(seed)
        weight = torch.cat((theta, torch.zeros_like(physics.lb_a)))
        return Scheme(A, B, none, weight, physics.lb_s, physics.ub_s)
    assert isinstance(physics, GrosZanonLTI)
    A, B = physics.wrong_model()
    # As in the original, learning starts with a first upper bound that is too wide by one.
    wide = physics.ub_s + torch.tensor([1.0, 0.0]).to(physics.ub_s)
    return Scheme(A, B, none, _true_scheme(physics).stage_weight, physics.lb_s, wide)


def _true_scheme(physics: LinearSystem) -> Scheme:
    """1/2 H_k is the weight of L; the offset is the mean of the noise."""
    A, B, lb_s, ub_s = physics.A, physics.B, physics.lb_s, physics.ub_s
    if isinstance(physics, PointMass):
        weight = torch.cat((2 * physics.W.diagonal(), torch.zeros_like(physics.lb_a)))
        return Scheme(A, B, torch.zeros_like(lb_s), weight, lb_s, ub_s)
    assert isinstance(physics, GrosZanonLTI)
    middle = physics.noise(torch.zeros(1, 2), torch.full((1, 1), 0.5))[0]
    return Scheme(A, B, middle, A.new_tensor([1.0, 1.0, 0.5]), lb_s, ub_s)


def _make(
    cfg: DictConfig,
    physics: LinearSystem | GymnasiumPlant,
    scheme: Scheme,
    learn: Collection[str],
) -> QPMPC:
    task = cfg.task
    return QPMPC.from_model(
        scheme.A,
        scheme.B,
        task.horizon,
        offset=scheme.offset,
        gamma=task.gamma,
        state_bounds=(scheme.lb_s, scheme.ub_s),
        action_bounds=(physics.lb_a, physics.ub_a),
        structure=cfg.constraint.structure,
        hessian=task.hessian,
        stage_weight=scheme.stage_weight,
        terminal_weight="riccati" if task.terminal_weight == "riccati" else None,
        state_slack=task.state_slack,
        action_slack=task.action_slack,
        discount_slack=task.discount_slack,
        learn=learn,
        step=cfg.step,
        solver=cfg.solver,
        on_failure="mask",
    )
