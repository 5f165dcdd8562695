"""A run's configuration: its keys, the checks across them, loading and comparing."""

from __future__ import annotations

import difflib
import functools
import importlib.util
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn, Self, get_args

from omegaconf import DictConfig, OmegaConf
from pydantic import (
    AfterValidator,
    BaseModel,
    Field,
    PlainValidator,
    ValidationError,
    model_validator,
)

from torch_qpmpc.errors import QPError, printable
from torch_qpmpc.experiment.rivals import IDENTIFICATION
from torch_qpmpc.experiment.tasks import TASKS, TaskSettings, find_task
from torch_qpmpc.experiment.tasks.registry import (
    Count,
    Fraction,
    Group,
    NonNegative,
    Positive,
    Whole,
)
from torch_qpmpc.files import damaged
from torch_qpmpc.mpc.projections import check_step
from torch_qpmpc.qp.solvers import backend

Seed = Annotated[int, Field(ge=0, lt=2**63)]
Beta = Annotated[float, Field(ge=0, lt=1)]


class Noise(Group):
    name: str
    std: NonNegative | None


class Deviation(Group):
    c_1: NonNegative
    c_2: NonNegative
    c_3: NonNegative


class SystemIdentification(Group):
    beta: NonNegative
    windows: Count


class Constraint(Group):
    """The learned constraints and their penalties; a null penalty is off."""

    name: str
    structure: Literal["free", "tied"]
    learn: list[Literal["C", "b", "G", "lb", "ub"]]
    deviation: Deviation | None
    si: SystemIdentification | None


class SGD(Group):
    name: Literal["sgd"]
    lr_cost: NonNegative
    lr_constraints: NonNegative
    final_fraction: Fraction


class Adam(SGD):
    name: Literal["adam"]
    betas: Annotated[list[Beta], Field(min_length=2, max_length=2)]


class GaussNewton(Group):
    name: Literal["gauss_newton"]
    lr: Fraction
    scale_constraints: Positive
    damping: Positive
    final_fraction: Fraction


class FromModel(Group):
    """Learning starts from the model of the task."""

    name: Literal["model"]


class FromData(Group):
    """Learning starts from a model that is identified from a log."""

    name: Literal["data"]
    file: str | None
    transitions: Count
    levels: Literal["uniform", "binary"]
    hold: Annotated[float, Field(ge=1)]


def _installed_logger(name: str) -> str:
    if name in ("wandb", "mlflow") and importlib.util.find_spec(name) is None:
        got, remedy = f"{name}, which is not installed", f"Install it: pip install {name}."
        raise QPError.expected("logger", got, "an installed logger", remedy)
    return name


def _settings_of_the_task(value: Any) -> TaskSettings:
    if not isinstance(value, Mapping):
        raise QPError.expected("task", repr(value), "its keys, as in configs/task/")
    return find_task(value).settings.model_validate(value)


class Config(Group):
    """All keys of configs/ but Hydra's."""

    seed: Seed
    eval_seed: Seed | None
    solver: Annotated[str, AfterValidator(lambda name: backend(name) and name)]
    threads: Count
    updates: Count
    batch_size: Count
    num_envs: Count
    steps_per_update: Count
    warmup_steps: Whole
    replay: bool
    replay_capacity: Count
    exploration_std: NonNegative
    weighted: bool
    td_error_clip: Positive | None
    step: Annotated[
        Literal["cholesky", "projection", "sdp"], AfterValidator(lambda x: check_step(x) or x)
    ]
    ablation: str | None
    gate: Literal["act", "plant"] | bool
    gate_bound: Positive | None
    gate_interval: Count | None
    logger: Annotated[
        Literal["tensorboard", "csv", "wandb", "mlflow"], AfterValidator(_installed_logger)
    ]
    figures: bool
    rivals: bool | list[str]
    eval_interval: Count
    log_interval: Count
    start: Annotated[FromModel | FromData, Field(discriminator="name")]
    task: Annotated[TaskSettings, PlainValidator(_settings_of_the_task)]
    noise: Noise
    constraint: Constraint
    optimizer: Annotated[Adam | SGD | GaussNewton, Field(discriminator="name")]

    def conflict(self, key: str, expected: str, remedy: str = "") -> NoReturn:
        """Raise the error of a value that conflicts with others."""
        value = functools.reduce(getattr, key.split("."), self)
        raise QPError.expected(key, repr(value), expected, remedy)

    @model_validator(mode="after")
    def values_fit(self) -> Self:
        part, tied = self.constraint, self.constraint.structure != "free"
        if not part.learn and not self.task.learn_cost:
            self.conflict("task.learn_cost", "something to learn, here or in constraint.learn")
        if (part.deviation or part.si) and "C" not in part.learn:
            remedy = "Set the penalty to null, or learn C."
            self.conflict("constraint.learn", "a list with C, because a penalty on C is on", remedy)
        if tied and part.deviation:
            remedy = "A tied C has nothing off its band to penalise."
            self.conflict("constraint.structure", "free", remedy)
        if tied and part.si and self.optimizer.name == "gauss_newton":
            remedy = "gauss_newton needs a free C for constraint.si."
            self.conflict("constraint.structure", "free", remedy)
        if tied and "G" in part.learn:
            self.conflict("constraint.learn", "no G", "No task has mixed constraints to learn.")
        if self.replay_capacity % self.num_envs:
            self.conflict("replay_capacity", f"a multiple of num_envs = {self.num_envs}")
        if part.si and (self.task.episode_steps or self.task.horizon) < self.task.horizon:
            remedy = "constraint.si needs windows of task.horizon steps."
            expected = f"at least task.horizon = {self.task.horizon}"
            self.conflict("task.episode_steps", expected, remedy)
        if part.si and not self.replay:
            remedy = "constraint.si samples from the replay; constraint=deviation has no si."
            self.conflict("replay", "true", remedy)
        task = find_task(self.task.model_dump())
        if self.noise.name not in task.noises:
            self.conflict("noise.name", f"a noise of task {task.name}: {', '.join(task.noises)}")
        if self.noise.std is not None and not task.takes_noise_std:
            self.conflict("noise.std", "null", f"The noise of {task.name} cannot be changed.")
        known = (*task.rivals, IDENTIFICATION)
        if isinstance(self.rivals, list) and not {*self.rivals} <= {*known}:
            expected = f"true, false or a list of these: {'; '.join(known)}"
            self.conflict("rivals", expected, f"They are the rivals of task {task.name}.")
        return self


def check_config(cfg: DictConfig) -> None:
    """Raise `QPError` on the first unknown key, missing key or invalid value of ``cfg``."""
    try:
        Config.model_validate(OmegaConf.to_container(cfg, resolve=True))
    except ValidationError as error:
        # A misspelt key is also a missing one.
        first = min(error.errors(), key=lambda details: details["type"] != "extra_forbidden")
        raise _named(first) from None


def _named(error: Any) -> QPError:
    """Make the error of a key, in pydantic's words."""
    kind, value, path = error["type"], error["input"], error["loc"]
    if kind == "value_error" and isinstance(error["ctx"]["error"], QPError):
        return error["ctx"]["error"]
    if len(path) > 1 and Config.model_fields[path[0]].discriminator:
        path = path[:1] + path[2:]  # pydantic inserts the name of the choice
    key = ".".join(map(str, path))
    if kind == "extra_forbidden":
        return unknown_key(next(iter(flatten(value, key)), key))
    if kind.startswith("union_tag"):
        key, value = f"{key}.name", value.get("name")
    # Of a list or a union, pydantic names the entry or the type, too.
    key = next((known for known in keys() if key.startswith(f"{known}.")), key)
    got = "nothing" if kind in ("missing", "union_tag_not_found") else repr(value)
    words = f"{error['msg'][:1].lower()}{error['msg'][1:]}"
    return QPError(printable(f"{key}: got {got}, but {words}."))


def unknown_key(key: str) -> QPError:
    """Make the error of an unknown key, or of another choice's, with the nearest known one."""
    known = {*keys(), *(name.partition(".")[0] for name in keys())}
    close = difflib.get_close_matches(key, known - {key}, n=1)
    hint = f"Did you mean {close[0]}?" if close and key not in known else "See configs/."
    return QPError.expected(key, "an unknown key", "a key of the chosen groups", hint)


def keys(model: type[BaseModel] = Config, prefix: str = "") -> Iterator[str]:
    """Yield every dotted key of all choices."""
    for name, info in model.model_fields.items():
        kinds = (info.annotation, *get_args(info.annotation))
        groups = [kind for kind in kinds if isinstance(kind, type) and issubclass(kind, BaseModel)]
        if prefix + name == "task":
            groups = [task.settings for task in TASKS.values()]
        inner = [key for group in groups for key in keys(group, f"{prefix}{name}.")]
        yield from dict.fromkeys(inner or [prefix + name])


def flatten(tree: Any, prefix: str = "") -> dict[str, Any]:
    """Flatten nested mappings into one with dotted keys."""
    if not isinstance(tree, Mapping):
        return {prefix: tree}
    pairs = (flatten(value, f"{prefix}.{key}".lstrip(".")) for key, value in tree.items())
    return {key: value for pair in pairs for key, value in pair.items()}


def load_config(file: Path) -> DictConfig:
    """Load a run's saved configuration as plain values."""
    try:
        cfg = OmegaConf.load(file)
        tree = OmegaConf.to_container(cfg, resolve=False)
        if not isinstance(cfg, DictConfig) or not isinstance(tree, dict):
            raise ValueError("it is a list")
        for key, info in Config.model_fields.items():
            if info.is_required() and key not in tree:
                raise KeyError(key)
        if not isinstance(tree["task"], dict):
            raise ValueError("its task is not a mapping")
    except Exception as error:  # damaged files raise errors of any type
        raise damaged(file, error, "the configuration that a run wrote") from error
    for key in [key for key in tree if key not in Config.model_fields and tree[key] is None]:
        del cfg[key]  # of an earlier version, and off
    for key, value in flatten(tree).items():
        if isinstance(value, list | str) and "${" in str(value):
            remedy = "Interpolations of a saved configuration are not resolved: write the value."
            got = f"{key}={value!r} in {file}"
            raise QPError.expected("config.yaml", got, "values, as train.py writes them", remedy)
    return cfg


def settings(cfg: DictConfig) -> dict[str, Any]:
    """Return every setting by its dotted key."""
    return flatten(OmegaConf.to_container(cfg, resolve=True))


def differences(then: Mapping[str, Any], now: Mapping[str, Any]) -> tuple[str, str] | None:
    """Return the differing `settings` of both as ``key=value, ..``; None if all are equal."""
    changed = [key for key in {**then, **now} if then.get(key) != now.get(key)]
    if not changed:
        return None
    before, after = (", ".join(f"{key}={of.get(key)}" for key in changed) for of in (then, now))
    return before, after
