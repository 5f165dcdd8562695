"""Tasks: a plant, the QP (eq:qp5) that learning starts from, and the QP with the true model.

Each task is one file that registers it. A user's script can register more.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from omegaconf import DictConfig
from torch import Tensor

from torch_qpmpc.experiment.tasks import (  # noqa: F401 (register)
    four_tanks,
    gros_zanon,
    gymnasium,
    house,
    house_wall,
    point_mass,
    tank_references,
)
from torch_qpmpc.experiment.tasks.code import has_run, named_code, resume_arguments, run_code
from torch_qpmpc.experiment.tasks.identified import Start, identified_scheme
from torch_qpmpc.experiment.tasks.registry import (
    TASKS,
    AnyPlant,
    Scheme,
    Task,
    TaskSettings,
    find_task,
    learned_parts,
    register,
)
from torch_qpmpc.mpc.module import QPMPC

__all__ = [
    "TASKS",
    "AnyPlant",
    "Scheme",
    "Task",
    "TaskSettings",
    "find_task",
    "has_run",
    "make_mpc",
    "make_physics",
    "make_true_mpc",
    "named_code",
    "register",
    "resume_arguments",
    "run_code",
    "true_model",
]


def make_physics(cfg: DictConfig) -> AnyPlant:
    """Make the plant of the run's task."""
    return find_task(cfg.task).make_plant(cfg)


def make_mpc(cfg: DictConfig, physics: AnyPlant, start: Start | None = None) -> QPMPC:
    """Make the QP that learns, from the task's wrong scheme or, if there is one, from ``start``."""
    scheme = find_task(cfg.task).wrong_scheme(cfg, physics)
    if start is not None:
        scheme = identified_scheme(cfg, scheme, start)
    return _make(cfg, physics, scheme, learned_parts(cfg))


def make_true_mpc(cfg: DictConfig, physics: AnyPlant) -> QPMPC | None:
    """Make the same QP with the true model, cost and bounds; None if they are unknown."""
    true_scheme = find_task(cfg.task).true_scheme
    return None if true_scheme is None else _make(cfg, physics, true_scheme(physics), ())


def true_model(
    physics: AnyPlant,
) -> tuple[Tensor, Tensor, Tensor] | None:
    """Return the plant's A, B and offset (the noise's mean); None if they are unknown."""
    return physics.true_model()


def _terminal_weight(choice: str, scheme: Scheme) -> Any:
    """Return the argument of `QPMPC`, which is None for ``default``."""
    if choice == "identity" and scheme.A is not None:
        return [1.0] * scheme.A.shape[-2]
    return "riccati" if choice == "riccati" else None


def _make(
    cfg: DictConfig,
    physics: AnyPlant,
    scheme: Scheme,
    learn: Collection[str],
) -> QPMPC:
    task = cfg.task
    options = {
        "offset": scheme.offset,
        "gamma": task.gamma,
        "state_bounds": (scheme.lb_s, scheme.ub_s),
        "action_bounds": (physics.lb_a, physics.ub_a),
        "structure": cfg.constraint.structure,
        "hessian": task.hessian,
        "stage_weight": scheme.stage_weight,
        "terminal_weight": _terminal_weight(task.terminal_weight, scheme),
        "state_slack": task.state_slack,
        "action_slack": task.action_slack,
        "discount_slack": task.discount_slack,
        "learn": learn,
        "step": cfg.step,
        "solver": cfg.solver,
        "on_failure": "mask",
    }
    options |= scheme.options
    options["start"] = {"c": scheme.c, **options.get("start", {})}
    return QPMPC.from_model(scheme.A, scheme.B, task.horizon, **options)
