"""The model of a run's configuration: its keys, and the checks across keys."""

from __future__ import annotations

import functools
import importlib.util
from collections.abc import Mapping
from typing import Annotated, Any, Literal, NoReturn, Self

from pydantic import AfterValidator, Field, PlainValidator, model_validator

from torch_qpmpc.errors import QPError
from torch_qpmpc.experiment.config.groups import (
    Constraint,
    Noise,
    Optimizer,
    Start,
)
from torch_qpmpc.experiment.fields import (
    Count,
    Expected,
    Flag,
    Group,
    Name,
    NonNegative,
    Positive,
    Whole,
    one_of,
)
from torch_qpmpc.experiment.rivals import IDENTIFICATION
from torch_qpmpc.experiment.tasks import TASKS, TaskSettings, find_task
from torch_qpmpc.mpc.projections import STEPS, check_step
from torch_qpmpc.qp.solvers import backend

Seed = Annotated[int, Field(ge=0, lt=2**63)]
LOGGERS = ("tensorboard", "csv", "wandb", "mlflow")


def _known_solver(name: str) -> str:
    backend(name)
    return name


def _installed_logger(name: str) -> str:
    if name in ("wandb", "mlflow") and importlib.util.find_spec(name) is None:
        got, remedy = f"{name}, which is not installed", f"Install it: pip install {name}."
        raise QPError.expected("logger", got, "an installed logger", remedy)
    return name


def _installed_step(name: str) -> str:
    check_step(name)
    return name


def _settings_of_the_task(value: Any) -> TaskSettings:
    if not isinstance(value, Mapping):
        raise QPError.expected("task", repr(value), "its keys, as in configs/task/")
    return find_task(value).settings.model_validate(value)


class Config(Group):
    """All keys of configs/ but Hydra's."""

    seed: Annotated[Seed, Expected("a whole number >= 0 and < 2^63")]
    eval_seed: Annotated[Seed | None, Expected("a whole number >= 0 and < 2^63, or null")]
    solver: Annotated[Name, AfterValidator(_known_solver)]
    threads: Count
    updates: Count
    batch_size: Count
    num_envs: Count
    steps_per_update: Count
    warmup_steps: Whole
    replay: Flag
    replay_capacity: Count
    exploration_std: NonNegative
    weighted: Flag
    td_error_clip: Annotated[Positive | None, Expected("a finite number > 0, or null")]
    step: Annotated[str, one_of(STEPS), AfterValidator(_installed_step)]
    release: Annotated[Count | None, Expected("a whole number >= 1, or null")]
    resume: Annotated[str | None, Expected("a path, or null")]
    ablation: Annotated[str | None, Expected("a name, or null")]
    gate: Annotated[Literal["act", "plant"] | bool, Expected("true, act, plant or false")]
    gate_bound: Annotated[Positive | None, Expected("a finite number > 0, or null")]
    gate_interval: Annotated[Count | None, Expected("a whole number >= 1, or null")]
    logger: Annotated[str, one_of(LOGGERS), AfterValidator(_installed_logger)]
    export: Annotated[Literal["c"] | None, Expected("c, or null")]
    prove: Annotated[NonNegative | None, Expected("a finite number >= 0, or null")]
    figures: Flag
    rivals: Annotated[bool | list[str], Expected("true, false or a list of names")]
    eval_interval: Count
    log_interval: Count
    start: Start
    task: Annotated[TaskSettings, PlainValidator(_settings_of_the_task)]
    noise: Noise
    constraint: Constraint
    optimizer: Optimizer

    @property
    def second_order(self) -> bool:
        return self.optimizer.name == "gauss_newton"

    def conflict(self, key: str, expected: str, remedy: str = "") -> NoReturn:
        """Raise the error of a value that conflicts with others."""
        value = functools.reduce(getattr, key.split("."), self)
        raise QPError.expected(key, repr(value), expected, remedy)

    @model_validator(mode="after")
    def something_learns(self) -> Self:
        if not self.constraint.learn and not self.task.learn_cost:
            self.conflict("task.learn_cost", "something to learn, here or in constraint.learn")
        return self

    @model_validator(mode="after")
    def si_penalty_has_windows(self) -> Self:
        """Check that windows of the horizon's length fit the episodes, in the replay."""
        if self.constraint.si is None:
            return self
        if (self.task.episode_steps or self.task.horizon) < self.task.horizon:
            expected = f"at least task.horizon = {self.task.horizon}"
            remedy = "constraint.si needs windows of task.horizon steps."
            self.conflict("task.episode_steps", expected, remedy)
        if not self.replay:
            remedy = "constraint.si samples from the replay; constraint=deviation has no si."
            self.conflict("replay", "true", remedy)
        return self

    @model_validator(mode="after")
    def second_order_has_quadratic_penalties(self) -> Self:
        """Check that gauss_newton can apply the SI penalty, which must be quadratic in a free C."""
        if self.second_order and self.constraint.si and self.constraint.structure != "free":
            remedy = "gauss_newton needs a free C for constraint.si."
            self.conflict("constraint.structure", "free", remedy)
        return self

    @model_validator(mode="after")
    def task_has_the_noise(self) -> Self:
        if self.task.name not in TASKS:  # its script has not run
            return self
        task = find_task(self.task.model_dump())
        if self.noise.name not in task.noises:
            self.conflict("noise.name", f"a noise of task {task.name}: {', '.join(task.noises)}")
        if self.noise.std is not None and not task.takes_noise_std:
            self.conflict("noise.std", "null", f"The noise of {task.name} cannot be changed.")
        return self

    @model_validator(mode="after")
    def task_has_the_rivals(self) -> Self:
        if self.task.name not in TASKS:
            return self
        known = (*find_task(self.task.model_dump()).rivals, IDENTIFICATION)
        if isinstance(self.rivals, list) and not {*self.rivals} <= {*known}:
            expected = f"true, false or a list of these: {'; '.join(known)}"
            self.conflict("rivals", expected, f"They are the rivals of task {self.task.name}.")
        return self

    @model_validator(mode="after")
    def release_has_ties(self) -> Self:
        if self.release is None:
            return self
        if self.constraint.structure == "free":
            self.conflict("release", "null", "Nothing is tied: choose constraint=mpc.")
        return self

    @model_validator(mode="after")
    def environments_divide_evenly(self) -> Self:
        """Check that num_envs divides the replay's capacity."""
        if self.replay_capacity % self.num_envs:
            self.conflict("replay_capacity", f"a multiple of num_envs = {self.num_envs}")
        return self
