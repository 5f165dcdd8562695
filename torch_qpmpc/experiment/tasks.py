"""The tasks of train.py: a plant, the QP (eq:qp5) that learning starts from, and its aim."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import torch
from omegaconf import DictConfig
from torch import Tensor

from torch_qpmpc.envs import GrosZanonLTI, GymnasiumPlant, LinearSystem, PointMass
from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.module import QPMPC


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


#: Where a model comes from, and how the command line gives it.
MODEL = (
    "Find a model x+ = A x + B u of it around its target, by finite differences of its dynamics or "
    "by least squares on logged transitions (x, u, x+), and the weight of its cost "
    "1/2 [x; u]' W [x; u]; then, as for two states and one action, override "
    "'task.A=[[1,.1],[0,1]]' 'task.B=[[0],[.1]]' 'task.stage_weight=[[1,0,0],[0,1,0],[0,0,.1]]'."
)


def _given_scheme(cfg: DictConfig, physics: GymnasiumPlant) -> Scheme:
    """Read the model and the weight from the task's configuration, the bounds from the spaces.

    Raises:
        QPError: one of them is missing, or has another shape than the environment's spaces.
    """
    n_x, n_u = len(physics.lb_s), len(physics.lb_a)
    needed = {"A": (n_x, n_x), "B": (n_x, n_u), "stage_weight": (n_x + n_u, n_x + n_u)}
    spaces = f"{physics.id!r}, whose observation has {n_x} entries and whose action has {n_u}"
    for name, shape in needed.items():
        if cfg.task[name] is None:
            expected = f"the rows of a matrix {shape} for {spaces}"
            raise QPError.expected(f"task.{name}", "null", expected, MODEL)
    given = {name: torch.tensor(cfg.task[name], dtype=torch.float64) for name in needed}
    shapes = {name: tuple(matrix.shape) for name, matrix in given.items()}
    if shapes != needed:
        found, want = (
            ", ".join(f"task.{name} of shape {shape}" for name, shape in sizes.items())
            for sizes in (shapes, needed)
        )
        raise QPError.expected("task.id", f"{spaces}, with {found}", want, MODEL)
    bounds = physics.lb_s, physics.ub_s
    return Scheme(given["A"], given["B"], torch.zeros(n_x).double(), given["stage_weight"], *bounds)


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
