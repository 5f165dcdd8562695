"""``task=gymnasium``: any Gymnasium environment, learned from a linear model of it."""

import importlib.util
import re
from collections.abc import Iterator, Mapping
from typing import Annotated, Any

import torch
from pydantic import AfterValidator

from torch_qpmpc.envs import GymnasiumPlant
from torch_qpmpc.errors import QPError
from torch_qpmpc.experiment.config import Config, Count, Matrix, TaskSettings
from torch_qpmpc.experiment.rivals import ZERO_ACTION, zero_action
from torch_qpmpc.experiment.tasks.code import has_run
from torch_qpmpc.experiment.tasks.registry import Task, plant_scheme, register
from torch_qpmpc.mpc.model import Model
from torch_qpmpc.mpc.scheme import Scheme


def _is_chosen(id: str) -> str:
    if id == "???":
        want = "the id of a Gymnasium environment, as in task.id=Pendulum-v1"
        raise QPError.expected("task.id", repr(id), want)
    return id


class GymnasiumSettings(TaskSettings):
    """The keys of the environment and its linear model."""

    # Narrower in other tasks, whose plants have no length of their own.
    episode_steps: Count | None  # pyright: ignore[reportIncompatibleVariableOverride]
    eval_steps: Count | None  # pyright: ignore[reportIncompatibleVariableOverride]
    #: Take the bounds of the observation space as constraints.
    observation_bounds: bool
    id: Annotated[str, AfterValidator(_is_chosen)]
    kwargs: dict[str, Any] | None = None
    #: The model; null by default, as with ``start=data``, which replaces it.
    A: Matrix | None
    B: Matrix | None
    stage_weight: Matrix | None

    @property
    def modules(self) -> list[str]:
        names = [text.partition(":")[0] for text in _strings([self.id, self.kwargs])]
        return [name for name in names if _is_module(name)]


#: Instructions for finding a model and passing it on the command line.
REMEDY = (
    "Start from data instead, with start=data; or find a model x+ = A x + B u around the target, by"
    " finite differences of the dynamics, and the weight W of the cost 1/2 [x; u]' W [x; u]; then "
    "pass them, as here for two states and one action: "
    "'task.A=[[1,.1],[0,1]]' 'task.B=[[0],[.1]]' 'task.stage_weight=[[1,0,0],[0,1,0],[0,0,.1]]'."
)


def _strings(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, Mapping | list):
        for item in value.values() if isinstance(value, Mapping) else value:
            yield from _strings(item)


def _is_module(name: str) -> bool:
    """Return True if ``name`` could be imported; its code does not run."""
    if not re.fullmatch(r"[^\W\d]\w*(\.[^\W\d]\w*)*", name):
        return False
    try:
        return importlib.util.find_spec(name.partition(".")[0]) is not None
    except ValueError:  # __main__, as under pytest
        return True


def make_plant(cfg: Config) -> GymnasiumPlant:
    """Make the environment with its further arguments, if its module has been imported."""
    task = cfg.task
    assert isinstance(task, GymnasiumSettings)
    if not has_run(task):
        got = f"{task.id!r} with task.kwargs={task.kwargs}"
        expected = "an environment whose module has been imported"
        remedy = "Name it on the command line with task.id=MODULE:ID, or import it before."
        raise QPError.expected("task.id", got, expected, remedy)
    return GymnasiumPlant(task.id, **(task.kwargs or {}))


def given_scheme(cfg: Config, plant: GymnasiumPlant) -> Scheme:
    """Read the model and the weight from the task's configuration, the bounds from the spaces.

    With ``start=data`` the log's model takes the place of A and B, and the weight may be null. The
    weight is of the observations and actions: hidden states have none. The bounds of the
    observations count with ``task.observation_bounds`` only.
    """
    task = cfg.task
    assert isinstance(task, GymnasiumSettings)
    n_x, n_y, n_u = plant.n_x, len(plant.lb_s), len(plant.lb_a)
    shapes = {"A": (n_x, n_x), "B": (n_x, n_u), "stage_weight": (n_y + n_u, n_y + n_u)}
    given = []
    for name, shape in shapes.items():
        if (rows := getattr(task, name)) is None and cfg.start.name != "data":
            expected = f"the rows of a matrix {shape} for {plant.id!r}"
            raise QPError.expected(f"task.{name}", "null", expected, REMEDY)
        given.append(None if rows is None else torch.tensor(rows, dtype=torch.float64))
    A, B, weight = given
    if cfg.start.name == "data":
        A, B, sizes = None, None, [(n + n_u, n + n_u) for n in (n_y, n_x)]
        if weight is not None and weight.shape not in sizes:
            got, want = f"shape {tuple(weight.shape)}", f"shape {sizes[0]}"
            raise QPError.expected("task.stage_weight", got, want)
    if weight is not None and len(weight) == n_y + n_u:  # the outputs are the first states
        seen = torch.cat((torch.arange(n_y), torch.arange(n_x, n_x + n_u)))
        own, weight = weight, weight.new_zeros(n_x + n_u, n_x + n_u)
        weight[seen[:, None], seen] = own
    states = torch.tensor([[-torch.inf], [torch.inf]], dtype=torch.float64).repeat(1, n_x)
    if task.observation_bounds:
        states[0, : len(plant.lb_s)], states[1, : len(plant.ub_s)] = plant.lb_s, plant.ub_s
    return plant_scheme(cfg, plant, Model(A, B), weight, (states[0], states[1]))


register(
    Task(
        "gymnasium",
        make_plant,
        given_scheme,
        rivals={ZERO_ACTION: zero_action},
        settings=GymnasiumSettings,
        defaults=None,
    )
)
