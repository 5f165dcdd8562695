"""A task, and the registry by which a configuration finds it."""

from __future__ import annotations

import runpy
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Self

from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig
from pydantic import model_validator
from torch import Tensor

from torch_qpmpc.checks import check_kind
from torch_qpmpc.envs import LinearSystem
from torch_qpmpc.envs.closed_loop import ClosedLoop, closed_loop
from torch_qpmpc.errors import QPError
from torch_qpmpc.experiment.fields import (
    Count,
    Expected,
    Flag,
    Fraction,
    Group,
    Name,
    Weight,
    one_of,
    some_of,
)
from torch_qpmpc.mpc.validation import COST, HESSIANS

#: Every task by its name.
TASKS: dict[str, Task] = {}


class TaskSettings(Group):
    """The keys that every task has under ``task``."""

    name: Name
    #: Registers a task that is not built in.
    file: Annotated[str | None, Expected("a path, or null")] = None
    horizon: Count
    gamma: Fraction
    episode_steps: Count
    eval_steps: Count
    hessian: Annotated[str, one_of(HESSIANS)]
    terminal_weight: Annotated[str, one_of(("identity", "riccati"))]
    learn_cost: Annotated[list[str], some_of(COST)]
    state_slack: Weight
    action_slack: Weight
    discount_slack: Flag

    @model_validator(mode="after")
    def riccati_is_dense(self) -> Self:
        if self.terminal_weight == "riccati" and self.hessian == "diagonal":
            remedy = "With task.hessian=block it can be."
            raise QPError.expected("task.terminal_weight", "'riccati'", "identity", remedy)
        return self


@dataclass(frozen=True)
class Scheme:
    """What an MPC scheme knows of a plant: x+ = A x + B u + offset, a cost, and bounds.

    Attributes:
        A, B: ``(n_x, n_x)`` and ``(n_x, n_u)``.
        stage_weight: W of the cost 1/2 [x; u]' W [x; u], or its diagonal.
        lb_s, ub_s: bounds of the state ``(n_x,)``.
        offset: ``(n_x,)``; None for zero.
    """

    A: Tensor
    B: Tensor
    stage_weight: Tensor
    lb_s: Tensor
    ub_s: Tensor
    offset: Tensor | None = None

    @classmethod
    def true(cls, plant: LinearSystem, stage_weight: Tensor) -> Scheme:
        """The scheme that knows ``plant``; its offset is the mean of the noise."""
        A, B, offset = plant.true_model()
        return cls(A, B, stage_weight, plant.lb_s, plant.ub_s, offset)


@dataclass(frozen=True)
class Task:
    """A plant, the MPC scheme that learning starts from, and the one that it aims at.

    Attributes:
        name: of ``task=NAME``.
        make_plant: makes a configuration's plant, a `LinearSystem` or a `GymnasiumPlant`.
        wrong_scheme: the start, for a configuration and its plant.
        true_scheme: the aim, for a plant; None where the plant's model is unknown.
        closed_loop: runs a policy on the plant, as `torch_qpmpc.envs.closed_loop.closed_loop`.
        noises: choices of ``noise.name``; the first is the default.
        takes_noise_std: True if ``make_plant`` reads ``noise.std``.
        settings: the keys under ``task``.
        defaults: settings that differ from those of ``task=point_mass``, of any group; None where
            configs/task/NAME.yaml has them.
    """

    name: str
    make_plant: Callable[[DictConfig], Any]
    wrong_scheme: Callable[[DictConfig, Any], Scheme]
    true_scheme: Callable[[Any], Scheme] | None = None
    closed_loop: Callable[..., ClosedLoop] = closed_loop
    noises: tuple[str, ...] = ("none",)
    takes_noise_std: bool = False
    settings: type[TaskSettings] = TaskSettings
    defaults: Mapping[str, Any] | None = field(default_factory=dict)


def register(task: Task) -> None:
    """Make ``task=NAME`` a choice of train.py; a second task of this name replaces the first.

    Raises:
        QPError: train.py itself has a task of this name.
    """
    check_kind("task", task, Task)
    known = TASKS.get(task.name)
    if known is not None and known.defaults is None:
        raise QPError.expected("task.name", f"{task.name!r}, which exists", "a new name")
    TASKS[task.name] = task
    if task.defaults is None:
        return
    # Other processes, such as a sweep's, run the caller's file to register the task.
    file = Path(sys._getframe(1).f_code.co_filename).resolve()
    own = {"name": task.name, "file": str(file) if file.exists() else None}
    node = {
        "defaults": ["/task/point_mass@task", {"override /noise": task.noises[0]}, "_self_"],
        **task.defaults,
        "task": {**task.defaults.get("task", {}), **own},
    }
    ConfigStore.instance().store(task.name, node, group="task", package="_global_")


def find_task(settings: Mapping[str, Any]) -> Task:
    """Find the task that the keys under ``task`` name; if it is unknown, run its file.

    Raises:
        QPError: there is none.
    """
    name, file = settings.get("name"), settings.get("file")
    if name not in TASKS and isinstance(file, str):
        if not Path(file).exists():
            remedy = "Put it there, or set task.file to where it is."
            expected = f"the file that registers task={name}"
            raise QPError.expected("task.file", f"{file!r}, which does not exist", expected, remedy)
        runpy.run_path(file, run_name="task_file")
    if name not in TASKS:
        got = repr(name) if "name" in settings else "nothing"
        raise QPError.expected("task.name", got, f"one of {', '.join(TASKS)}")
    return TASKS[name]
