"""``task=linear``: the matrices of a linear model instead of the plant.

    x+ = A x + B (u + v),   y = C_y x + e

The policy reads a window of outputs, and predicts from it as a Kalman filter does, so that it needs
no observer. With a weight of moves the last input is an output, too.
"""

from __future__ import annotations

from typing import Annotated

import torch
import torch.nn.functional as F
from omegaconf import DictConfig
from torch import Tensor

from torch_qpmpc.envs import LinearPlant
from torch_qpmpc.envs.closed_loop import plant_loop
from torch_qpmpc.errors import QPError
from torch_qpmpc.experiment.fields import MATRIX, Count, Expected, Finite, Matrix, NonNegative
from torch_qpmpc.experiment.tasks.log import (
    Names,
    Pairs,
    Weights,
    by_name,
    episode,
    plant_cost_scheme,
    read_pairs,
    stage_cost,
)
from torch_qpmpc.experiment.tasks.registry import Task, TaskSettings, register
from torch_qpmpc.experiment.tracking import window_model
from torch_qpmpc.mpc.model import Model
from torch_qpmpc.mpc.scheme import Scheme

#: The least standard deviation that the filter takes for an output's noise.
LEAST = 1e-4
#: What a missing matrix is answered with.
EXAMPLE = (
    "python train.py task=linear 'task.A=[[1, 0.1], [0, 0.9]]' 'task.B=[[0], [0.1]]' "
    "'task.Q={y1: 1}' .."
)
NOTE = (
    "task=linear has no plant but its model: closed loops run on that, so that every J is a "
    "prediction."
)
OptionalMatrix = Annotated[Matrix | None, MATRIX]


class LinearSettings(TaskSettings):
    """The keys of the model and of the cost."""

    A: OptionalMatrix
    B: OptionalMatrix
    C_y: OptionalMatrix
    outputs: Names
    inputs: Names
    #: Number of outputs in the window.
    past: Annotated[Count | None, Expected("a whole number >= 1, or null")]
    noise: Annotated[
        dict[str, NonNegative] | None,
        Expected("standard deviations >= 0 by output or input, as {y1: 0.1}, or null"),
    ]
    #: Ranges of the first outputs.
    starts: Pairs
    Q: Weights
    R: Weights
    dR: Weights  # noqa: N815 (the weight of du)
    r: Annotated[dict[str, Finite] | None, Expected("numbers by output, as {y1: 21.0}, or null")]
    y_bounds: Pairs
    u_bounds: Pairs


def make_plant(cfg: DictConfig) -> LinearPlant:
    """Make the plant of the matrices, with its cost and bounds.

    Raises:
        QPError: a matrix is missing, shapes do not match, or a name is not that of a signal.
    """
    task = cfg.task
    A, B, C = _matrices(task)
    (n, m), n_y = B.shape, len(C)
    outputs, inputs = _labels(task, "outputs", "y", n_y), _labels(task, "inputs", "u", m)
    if both := {*outputs} & {*inputs}:
        raise QPError.expected("task.inputs", f"{min(both)!r}, an output", "names of their own")
    std = _vector(task, "noise", (*outputs, *inputs))
    past = task.past or (1 if torch.linalg.matrix_rank(C) == n else 2 * n)
    V, std_y = B * std[n_y:], std[:n_y]
    dR, r = _vector(task, "dR", inputs), _vector(task, "r", outputs)
    y_bounds = read_pairs(task, "y_bounds", outputs, _infinite(n_y))
    u_bounds = read_pairs(task, "u_bounds", inputs, _infinite(m))
    near = torch.where(y_bounds.isfinite().all(0), y_bounds, torch.stack((r - 1, r + 1)))
    first = read_pairs(task, "starts", outputs, near)
    W, q, c = stage_cost(task, outputs, inputs)
    if dR.any():
        unit = torch.eye(m).double()
        A, B = torch.block_diag(A, 0 * unit), torch.cat((B, unit))
        C, V = torch.block_diag(C, unit), F.pad(V, (0, 0, 0, m))
        first, std_y = F.pad(first, (0, m)), F.pad(std_y, (0, m))
        y_bounds = torch.cat((y_bounds, _infinite(m)), -1)
        outputs = (*outputs, *(f"last {name}" for name in inputs))
        # [y; u] becomes [y; last u; u], and gets the moves' cost.
        wider = torch.zeros(n_y + m, n_y + 2 * m).double()
        wider[:n_y, :n_y], wider[n_y:, -m:] = torch.eye(n_y), unit
        du = torch.cat((torch.zeros(m, n_y).double(), -unit, unit), -1)
        W, q = wider.mT @ W @ wider + 2 * du.mT @ (dR[:, None] * du), q @ wider
    return LinearPlant(
        A=A,
        B=B,
        C=C,
        V=V,
        std=std_y,
        W=W,
        q=q,
        c=c,
        lb_a=u_bounds[0],
        ub_a=u_bounds[1],
        lb_y=y_bounds[0],
        ub_y=y_bounds[1],
        first=first,
        price=task.state_slack,
        labels=(outputs, inputs, ()),
        n_y=len(C),
        horizon=task.horizon,
        past=past,
    )


def linear_scheme(cfg: DictConfig, plant: LinearPlant) -> Scheme:
    """Make the scheme of the plant's own model, as the window shows it, and of its cost."""
    E = torch.diag(plant.std.clamp(min=LEAST).square())
    V = plant.V @ plant.V.mT
    return plant_cost_scheme(
        cfg, plant, Model(*window_model(plant.A, plant.B, plant.C, V, E, plant.past))
    )


def _matrices(task: DictConfig) -> tuple[Tensor, Tensor, Tensor]:
    """Return A, B and C_y."""
    for name in ("A", "B"):
        if task[name] is None:
            remedy = f"As in: {EXAMPLE}"
            raise QPError.expected(f"task.{name}", "null", "a matrix by its rows", remedy)
    A, B = (torch.tensor([list(row) for row in task[name]]).double() for name in ("A", "B"))
    n = len(A)
    C = torch.eye(n).double()
    if task.C_y is not None:
        C = torch.tensor([list(row) for row in task.C_y]).double()
    wanted = {"A": (A, (n, n)), "B": (B, (n, B.shape[-1])), "C_y": (C, (len(C), n))}
    for name, (matrix, shape) in wanted.items():
        if matrix.shape != shape:
            got = f"shape {tuple(matrix.shape)}"
            raise QPError.expected(f"task.{name}", got, f"shape {shape}, for {n} states")
    return A, B, C


def _labels(task: DictConfig, key: str, letter: str, size: int) -> tuple[str, ...]:
    """Return the names of signals, by default y1, .. or u1, ..."""
    names = task[key] or [f"{letter}{i + 1}" for i in range(size)]
    if len(names) != size or len({*names}) != size:
        raise QPError.expected(f"task.{key}", f"{list(names)}", f"{size} different names")
    return (*names,)


def _vector(task: DictConfig, key: str, names: tuple[str, ...]) -> Tensor:
    """Return the numbers by name under ``key``, zero where there is none."""
    given = by_name(task, key, {name: i for i, name in enumerate(names)})
    return torch.tensor([given.get(name, 0.0) for name in names]).double()


def _infinite(size: int) -> Tensor:
    """Return bounds that are none, ``(2, size)``."""
    return torch.tensor([[-torch.inf], [torch.inf]]).double().expand(2, size)


register(
    Task(
        "linear",
        make_plant,
        linear_scheme,
        closed_loop=plant_loop,
        episode=episode,
        settings=LinearSettings,
        defaults=None,
        note=NOTE,
    )
)
