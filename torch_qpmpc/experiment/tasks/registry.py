"""Tasks and their registry."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from hydra.core.config_store import ConfigStore
from torch import Tensor

from torch_qpmpc.checks import check_kind
from torch_qpmpc.envs import Plant
from torch_qpmpc.envs.closed_loop import STARTS, AnyPlant
from torch_qpmpc.errors import QPError
from torch_qpmpc.experiment.config import TASKS, Config, TaskSettings
from torch_qpmpc.experiment.rivals import Policy, scalar_name
from torch_qpmpc.mpc.bounds import Bounds
from torch_qpmpc.mpc.cost import Cost
from torch_qpmpc.mpc.layout import Layout
from torch_qpmpc.mpc.model import Model
from torch_qpmpc.mpc.scheme import Scheme

#: Names in the metrics that no rival may have.
TAKEN = {"start", "learned", "candidate", "true_model", "discounted", "final"}


@dataclass(frozen=True)
class Task:
    """A plant, the `torch_qpmpc.Scheme` that learning starts from, and the true scheme.

    Attributes:
        name: the choice in ``task=NAME``.
        make_plant: makes the plant of a configuration, of any kind; a function in the file that
            registers the task, which other processes run.
        wrong_scheme: makes the scheme that learning starts from, of a configuration and a plant,
            as by `plant_scheme`. ``task.terminal_weight`` fills in a missing terminal weight.
            ``start=data`` replaces the model and, if its ``stage_weight`` is None, the cost.
        true_scheme: makes the true scheme, likewise; None if the plant's model is unknown.
        masks: makes, likewise, the masks of parts that are learned only in some entries.
        starts: the number of closed loops of an evaluation.
        noises: choices of ``noise.name``; the first is the default.
        takes_noise_std: True if ``make_plant`` reads ``noise.std``.
        rivals: functions of a plant that make controllers to compare the learned one with, by name.
        nominal_scheme: makes the scheme of the plant's own cost and bounds, which the rival
            `IDENTIFICATION` gives a model of its own; None if the true scheme has them or, without
            one, the wrong scheme.
        episode: returns arguments of `episode_figure` that show an episode of a plant in its own
            names and units, such as ``outputs`` or ``band``, from the known signals d of its steps
            ``(T + 1, n_d)``.
        settings: the model of the keys under ``task``.
        defaults: settings of any group that differ from ``task=point_mass``, and under ``defaults``
            other choices of groups, as ``[{"override /constraint": "free"}]``; None if they are in
            configs/task/NAME.yaml.
    """

    name: str
    make_plant: Callable[[Config], Any]
    wrong_scheme: Callable[[Config, Any], Scheme]
    true_scheme: Callable[[Config, Any], Scheme] | None = None
    masks: Callable[[Config, Any], Mapping[str, Tensor]] = lambda cfg, plant: {}
    starts: int = STARTS
    noises: tuple[str, ...] = ("none",)
    takes_noise_std: bool = False
    rivals: Mapping[str, Callable[[Any], Policy]] = field(default_factory=dict)
    nominal_scheme: Callable[[Config, Any], Scheme] | None = None
    episode: Callable[[Any, Tensor], Mapping[str, Any]] = lambda plant, d: {}
    settings: type[TaskSettings] = TaskSettings
    defaults: Mapping[str, Any] | None = field(default_factory=dict)


def plant_layout(plant: AnyPlant, horizon: int) -> Layout:
    """Return the sizes of the QP of a plant."""
    return Layout(plant.n_x, len(plant.lb_a), horizon, n_d=getattr(plant, "n_d", 0))


def plant_scheme(
    cfg: Config,
    plant: AnyPlant,
    model: Model,
    stage_weight: Tensor | None,
    state_bounds: tuple[Tensor, Tensor] | None = None,
) -> Scheme:
    """Make the scheme of a model and a weight with the settings of ``cfg.task``.

    ``stage_weight`` is W of the cost 1/2 [x; u]' W [x; u], or its diagonal. ``plant`` gives the
    sizes and the bounds; a `Plant` has no ``state_bounds`` by itself.
    """
    if state_bounds is None and not isinstance(plant, Plant):
        state_bounds = plant.lb_s, plant.ub_s
    bounds = Bounds(state_bounds=state_bounds, action_bounds=(plant.lb_a, plant.ub_a))
    layout = plant_layout(plant, cfg.task.horizon)
    cost = Cost(stage_weight, hessian=cfg.task.hessian)
    return Scheme(layout, model, cost, priced(cfg, bounds), cfg.task.gamma)


def priced(cfg: Config, bounds: Bounds) -> Bounds:
    """Return the bounds with the slack weights of ``cfg.task``."""
    task = cfg.task
    slacks = {"state_slack": task.state_slack, "action_slack": task.action_slack}
    return replace(bounds, **slacks, discount_slack=task.discount_slack)


def register(task: Task) -> None:
    """Make ``task=NAME`` a choice of train.py; registering it again replaces the task.

    Raises:
        QPError: a built-in task has the name, or two entries of the metrics would have one name.
    """
    check_kind("task", task, Task)
    names = [*map(scalar_name, task.rivals)]
    if len({*names}) < len(names) or {*names} & TAKEN:
        want = f"names that differ as words, from each other and {', '.join(sorted(TAKEN))}"
        raise QPError.expected("task.rivals", f"{[*task.rivals]}", want)
    known = TASKS.get(task.name)
    if known is not None and known.defaults is None:
        raise QPError.expected("task.name", f"{task.name!r}, which is built in", "a new name")
    TASKS[task.name] = task
    if task.defaults is None:
        return
    # Other processes, such as those of a sweep, run the plant's file to register the task.
    code = getattr(task.make_plant, "__code__", None)
    file = None if code is None else Path(code.co_filename).resolve()
    own = {"name": task.name, "file": str(file) if file is not None and file.exists() else None}
    groups = [{"override /noise": task.noises[0]}, *task.defaults.get("defaults", ())]
    node = {
        **task.defaults,
        "defaults": ["/task/point_mass@task", *groups, "_self_"],
        "task": {"terminal_weight": "default", **task.defaults.get("task", {}), **own},
    }
    ConfigStore.instance().store(task.name, node, group="task", package="_global_")
