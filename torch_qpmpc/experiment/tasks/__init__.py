"""Tasks: a plant, the QP (eq:qp5) that learning starts from, and the QP with the true model.

Each task is one file that registers it. A user's script can register more.
"""

from collections.abc import Collection
from dataclasses import replace
from typing import Any

from torch_qpmpc.errors import QPError
from torch_qpmpc.experiment.config import TASKS, Config, TaskSettings, find_task
from torch_qpmpc.experiment.tasks import gros_zanon, gymnasium, point_mass  # noqa: F401 (register)
from torch_qpmpc.experiment.tasks.identified import Start, identified_scheme
from torch_qpmpc.experiment.tasks.registry import (
    AnyPlant,
    Task,
    plant_layout,
    plant_scheme,
    priced,
    register,
)
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.mpc.scheme import Scheme

__all__ = [
    "TASKS",
    "AnyPlant",
    "Task",
    "TaskSettings",
    "find_task",
    "make_mpc",
    "make_physics",
    "make_true_mpc",
    "plant_layout",
    "plant_scheme",
    "priced",
    "register",
]


def make_physics(cfg: Config) -> AnyPlant:
    """Make the plant of the run's task."""
    return find_task(cfg.task).make_plant(cfg)


def make_mpc(cfg: Config, physics: AnyPlant, start: Start | None = None) -> QPMPC:
    """Make the QP that learns, from the task's wrong scheme or, if there is one, from ``start``."""
    task = find_task(cfg.task)
    scheme = task.wrong_scheme(cfg, physics)
    if start is not None:
        scheme = identified_scheme(cfg, scheme, start)
    masks = task.masks(cfg, physics)
    learned = (*cfg.task.learn_cost, *cfg.constraint.learn)
    learn = {part: masks.get(part, True) for part in learned}
    if start is None or start.dynamics is None:
        return _make(cfg, scheme, learn)
    learn = {part: mask for part, mask in learn.items() if part not in ("C", "b")}
    return _make(cfg, scheme, learn, dynamics=start.dynamics, iterations=1)


def make_true_mpc(cfg: Config, physics: AnyPlant) -> QPMPC | None:
    """Make the same QP with the true model, cost and bounds; None if they are unknown."""
    true_scheme = find_task(cfg.task).true_scheme
    return None if true_scheme is None else _make(cfg, true_scheme(cfg, physics), ())


def _make(cfg: Config, scheme: Scheme, learn: Collection[str], **options: Any) -> QPMPC:
    if not scheme.is_complete:
        got = f"{cfg.task.name!r}, whose scheme has no model or no stage weight"
        raise QPError.expected("task.name", got, "a scheme with both", "Or use start=data.")
    choice = cfg.task.terminal_weight
    if scheme.cost.terminal_weight is None and choice != "default":
        weight = choice if choice == "riccati" else [1.0] * scheme.layout.n_x
        scheme = replace(scheme, cost=replace(scheme.cost, terminal_weight=weight))
    return QPMPC(
        scheme,
        learn=learn,
        structure=cfg.constraint.structure,
        step=cfg.step,
        solver=cfg.solver,
        on_failure="mask",
        **options,
    )
