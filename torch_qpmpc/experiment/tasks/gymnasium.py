"""``task=gymnasium``: any Gymnasium environment, learned from a linear model of it."""

from __future__ import annotations

from typing import Annotated, Any

import torch
from omegaconf import DictConfig, OmegaConf
from pydantic import AfterValidator

from torch_qpmpc.envs import GymnasiumPlant
from torch_qpmpc.envs.closed_loop import gymnasium_loop
from torch_qpmpc.errors import QPError
from torch_qpmpc.experiment.rivals import ZERO_ACTION, zero_action
from torch_qpmpc.experiment.tasks.code import has_run
from torch_qpmpc.experiment.tasks.registry import (
    Count,
    Matrix,
    Task,
    TaskSettings,
    Whole,
    plant_scheme,
    register,
)
from torch_qpmpc.mpc.model import Model
from torch_qpmpc.mpc.scheme import Scheme


def _is_chosen(id: str) -> str:
    if id == "???":
        want = "the id of a Gymnasium environment, as in task.id=Pendulum-v1"
        raise QPError.expected("task.id", repr(id), want)
    return id


#: A matrix of the model; null by default, which `given_scheme` accepts with ``start=data`` only.
Given = Matrix | None


#: The length of episodes, null for the environment's own.
Steps = Count | None


class GymnasiumSettings(TaskSettings):
    """The keys of the environment and its linear model."""

    # Narrower in other tasks, whose plants have no length of their own.
    episode_steps: Steps  # pyright: ignore[reportIncompatibleVariableOverride]
    eval_steps: Steps  # pyright: ignore[reportIncompatibleVariableOverride]
    #: Take the bounds of the observation space as constraints.
    observation_bounds: bool
    #: Episodes by which a start from data is chosen; 0 for the run's own start.
    start_episodes: Whole = 0

    id: Annotated[str, AfterValidator(_is_chosen)]
    kwargs: dict[str, Any] | None = None
    A: Given
    B: Given
    stage_weight: Given


#: Instructions for finding a model and passing it on the command line.
REMEDY = (
    "Start from data instead, with start=data; or find a model x+ = A x + B u around the target, by"
    " finite differences of the dynamics, and the weight W of the cost 1/2 [x; u]' W [x; u]; then "
    "pass them, as here for two states and one action: "
    "'task.A=[[1,.1],[0,1]]' 'task.B=[[0],[.1]]' 'task.stage_weight=[[1,0,0],[0,1,0],[0,0,.1]]'."
)


def make_plant(cfg: DictConfig) -> GymnasiumPlant:
    """Make the environment with its further arguments, if its module has been imported."""
    if not has_run(cfg.task):
        got = f"{cfg.task.id!r} with task.kwargs={cfg.task.get('kwargs')}"
        expected = "an environment whose module has been imported"
        remedy = "Name it on the command line with task.id=MODULE:ID, or import it before."
        raise QPError.expected("task.id", got, expected, remedy)
    kwargs: Any = OmegaConf.to_container(OmegaConf.create(cfg.task.get("kwargs") or {}))
    return GymnasiumPlant(cfg.task.id, **kwargs)


def given_scheme(cfg: DictConfig, plant: GymnasiumPlant) -> Scheme:
    """Read the model and the weight from the task's configuration, the bounds from the spaces.

    With ``start=data`` the log's model takes the place of A and B, and the weight may be null. The
    weight is of the observations and actions: hidden states have none. The bounds of the
    observations count with ``task.observation_bounds`` only.
    """
    n_x, n_y, n_u = plant.n_x, len(plant.lb_s), len(plant.lb_a)
    shapes = {"A": (n_x, n_x), "B": (n_x, n_u), "stage_weight": (n_y + n_u, n_y + n_u)}
    for name, shape in shapes.items():
        if cfg.task[name] is None and cfg.start.name != "data":
            expected = f"the rows of a matrix {shape} for {plant.id!r}"
            raise QPError.expected(f"task.{name}", "null", expected, REMEDY)
    A, B, weight = (
        None if rows is None else torch.tensor(rows, dtype=torch.float64)
        for rows in map(cfg.task.get, shapes)
    )
    if cfg.start.name == "data":
        A, B, sizes = None, None, [(n + n_u, n + n_u) for n in (n_y, n_x)]
        if weight is not None and weight.shape not in sizes:
            got, want = f"shape {tuple(weight.shape)}", f"shape {sizes[0]}"
            raise QPError.expected("task.stage_weight", got, want)
    if weight is not None and len(weight) == n_y + n_u:  # the outputs are the first states
        seen = torch.cat((torch.arange(n_y), torch.arange(n_x, n_x + n_u)))
        own, weight = weight, weight.new_zeros(n_x + n_u, n_x + n_u)
        weight[seen[:, None], seen] = own
    states = torch.full((2, n_x), torch.inf, dtype=torch.float64)
    states[0] = -states[0]
    if cfg.task.observation_bounds:
        states[0, : len(plant.lb_s)], states[1, : len(plant.ub_s)] = plant.lb_s, plant.ub_s
    return plant_scheme(cfg, plant, Model(A, B), weight, (states[0], states[1]))


register(
    Task(
        "gymnasium",
        make_plant,
        given_scheme,
        closed_loop=gymnasium_loop,
        rivals={ZERO_ACTION: zero_action},
        settings=GymnasiumSettings,
        defaults=None,
    )
)
