"""A run's configuration: its keys, the checks across them, and their names."""

from __future__ import annotations

import difflib
import functools
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal, NoReturn, Self, get_args

from omegaconf import DictConfig, OmegaConf
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainValidator,
    SerializeAsAny,
    ValidationError,
    model_validator,
)

from torch_qpmpc.errors import QPError, printable
from torch_qpmpc.experiment.rivals import IDENTIFICATION
from torch_qpmpc.mpc.projections import check_step
from torch_qpmpc.qp.solvers import backend

if TYPE_CHECKING:
    from torch_qpmpc.experiment.tasks.registry import Task

#: All registered tasks by name.
TASKS: dict[str, Task] = {}


class Group(BaseModel):
    """A group of keys that forbids unknown keys, converts no values, and takes finite numbers."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


def _equally_long(rows: list[list[float]]) -> list[list[float]]:
    if not rows or any(len(row) != len(rows[0]) for row in rows):
        raise ValueError("rows should be equally long")
    return rows


Seed = Annotated[int, Field(ge=0, lt=2**63)]
Beta = Annotated[float, Field(ge=0, lt=1)]
Whole = Annotated[int, Field(ge=0)]
Count = Annotated[int, Field(ge=1)]
Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Fraction = Annotated[float, Field(gt=0, le=1)]
#: Weight of a slack; inf, on a command line .inf as well, makes the row hard.
OfYaml = BeforeValidator(lambda x: float("inf") if x == ".inf" else x)
Weight = Annotated[float, Field(ge=0, allow_inf_nan=True), OfYaml]
Matrix = Annotated[list[list[float]], AfterValidator(_equally_long)]


class TaskSettings(Group):
    """The keys under ``task`` that all tasks share."""

    name: str
    #: The script that registers a user's task.
    file: str | None = None
    horizon: Count
    gamma: Fraction
    episode_steps: Count
    eval_steps: Count
    hessian: Literal["diagonal", "block"]
    terminal_weight: Literal["default", "identity", "riccati"]
    learn_cost: list[Literal["H", "H_f", "q", "c", "w"]]
    state_slack: Weight
    action_slack: Weight
    discount_slack: bool
    #: Episodes by which a start from data is chosen; 0 for the run's own start.
    start_episodes: Whole = 0

    @property
    def modules(self) -> list[str]:
        """The importable modules that the keys name."""
        return []


class UnreadSettings(TaskSettings, extra="allow"):
    """The keys of a task whose script has not run, without checks."""


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
    hold: Annotated[float, Field(ge=1)]


def _settings_of_the_task(value: Any) -> TaskSettings:
    if not isinstance(value, Mapping):
        raise QPError.expected("task", repr(value), "its keys, as in configs/task/")
    unread = UnreadSettings.model_construct(**{"name": None, **value})
    if unread.file is not None and unread.name not in TASKS:
        return unread
    return find_task(unread).settings.model_validate(value)


def find_task(settings: TaskSettings) -> Task:
    """Find a task by its settings; raise `QPError` if its script has not run."""
    name, file = settings.name, settings.file
    if name in TASKS:
        return TASKS[name]
    if file is None:
        raise QPError.expected("task.name", repr(name), f"one of {', '.join(TASKS)}")
    remedy = "Name it on the command line with task.file=FILE, or run it before."
    want = f"a script that has registered {name!r}"
    raise QPError.expected("task.file", f"{file!r}, which has not run", want, remedy)


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
    gate: Literal["act", "plant", True, False]
    gate_bound: Positive | None
    gate_interval: Count | None
    figures: bool
    rivals: bool | list[str]
    eval_interval: Count
    log_interval: Count
    start: Annotated[FromModel | FromData, Field(discriminator="name")]
    task: Annotated[SerializeAsAny[TaskSettings], PlainValidator(_settings_of_the_task)]
    noise: Noise
    constraint: Constraint
    optimizer: Annotated[Adam | SGD | GaussNewton, Field(discriminator="name")]

    @classmethod
    def of(cls, cfg: DictConfig | Mapping[str, Any]) -> Self:
        """Read Hydra's configuration or the settings of a saved one.

        Raises:
            QPError: names the first unknown key, missing key or invalid value.
        """
        tree = OmegaConf.to_container(cfg, resolve=True) if isinstance(cfg, DictConfig) else cfg
        try:
            return cls.model_validate(tree)
        except ValidationError as error:
            # A misspelt key is also a missing one.
            errors = sorted(error.errors(), key=lambda one: one["type"] != "extra_forbidden")
            raise _named(errors) from None

    @property
    def settings(self) -> dict[str, Any]:
        """Every setting that was given, by its dotted key."""
        return flatten(self.model_dump(exclude_unset=True))

    def conflict(self, key: str, expected: str, remedy: str = "") -> NoReturn:
        """Raise the error of a value that conflicts with others."""
        value = functools.reduce(getattr, key.split("."), self)
        raise QPError.expected(key, repr(value), expected, remedy)

    @model_validator(mode="after")
    def values_fit(self) -> Self:
        if isinstance(self.task, UnreadSettings):
            return self
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
        if self.task.terminal_weight == "riccati" and self.task.hessian == "diagonal":
            remedy = "The Riccati weight needs task.hessian=block."
            self.conflict("task.terminal_weight", "default or identity", remedy)
        least = self.task.horizon * self.num_envs
        if self.replay_capacity % self.num_envs or self.replay_capacity < least:
            expected = f"a multiple of num_envs = {self.num_envs}, and at least {least}"
            remedy = f"Set replay_capacity={max(self.replay_capacity // least, 1) * least}."
            self.conflict("replay_capacity", expected, remedy)
        if part.si and (self.task.episode_steps or self.task.horizon) < self.task.horizon:
            remedy = "constraint.si needs windows of task.horizon steps."
            expected = f"at least task.horizon = {self.task.horizon}"
            self.conflict("task.episode_steps", expected, remedy)
        if part.si and not self.replay:
            remedy = "constraint.si samples from the replay; constraint=deviation has no si."
            self.conflict("replay", "true", remedy)
        task = find_task(self.task)
        if self.noise.name not in task.noises:
            self.conflict("noise.name", f"a noise of task {task.name}: {', '.join(task.noises)}")
        if self.noise.std is not None and not task.takes_noise_std:
            self.conflict("noise.std", "null", f"The noise of {task.name} cannot be changed.")
        known = (*task.rivals, IDENTIFICATION)
        if isinstance(self.rivals, list) and not {*self.rivals} <= {*known}:
            expected = f"true, false or a list of these: {'; '.join(known)}"
            self.conflict("rivals", expected, f"They are the rivals of task {task.name}.")
        return self


def _key(error: Any) -> str:
    """Return the key of an error: pydantic's path also has choices, entries of lists, and types."""
    (key, *path), known = map(str, error["loc"]), {*keys()}
    for i, part in enumerate(path, 1):
        longer, unknown = f"{key}.{part}", error["type"] == "extra_forbidden" and i == len(path)
        key = longer if unknown or any(f"{x}.".startswith(f"{longer}.") for x in known) else key
    return f"{key}.name" if error["type"].startswith("union_tag") else key


def _named(errors: Any) -> QPError:
    """Make the error of the first key, in pydantic's words for all types that it may have."""
    kind, value, context = (errors[0].get(name) for name in ("type", "input", "ctx"))
    if kind == "value_error" and isinstance(context["error"], QPError):
        return context["error"]
    key, words = _key(errors[0]), [x["msg"] for x in errors if _key(x) == _key(errors[0])]
    if kind == "extra_forbidden":
        return unknown_key(next(iter(flatten(value, key)), key))
    if kind.startswith("union_tag"):
        tags = context.get("expected_tags")
        value, words = value.get("name"), [f"Input should be {tags}" if tags else "Field required"]
    got = "nothing" if kind in ("missing", "union_tag_not_found") else repr(value)
    words = " or ".join(dict.fromkeys(words)).removeprefix("Value error, ")
    words = f"{words[:1].lower()}{words[1:]}".replace(" or Input should be", " or")
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
