"""``task=log``: a log of a plant instead of the plant, whose ARX model closed loops run on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import torch
from omegaconf import DictConfig
from pydantic import Field
from torch import Tensor

from torch_qpmpc.envs import ARXPlant, LinearPlant
from torch_qpmpc.envs.closed_loop import plant_loop
from torch_qpmpc.errors import QPError
from torch_qpmpc.experiment.fields import Count, Expected, Finite, NonNegative
from torch_qpmpc.experiment.tasks.identified import arx_arguments
from torch_qpmpc.experiment.tasks.registry import Task, TaskSettings, plant_layout, priced, register
from torch_qpmpc.mpc.bounds import Bounds
from torch_qpmpc.mpc.identification import identify
from torch_qpmpc.mpc.log import Log, read_log
from torch_qpmpc.mpc.model import Model
from torch_qpmpc.mpc.rewards import scheme_cost
from torch_qpmpc.mpc.scheme import Scheme
from torch_qpmpc.mpc.stage_cost import StageCost

NOTE = (
    "task=log has no plant: closed loops run on the ARX model of the log, disturbed by its own "
    "one-step errors, so that every J is a prediction."
)
Names = Annotated[list[str] | None, Expected("a list of names, or null")]
Column = Annotated[str | None, Expected("a column, or null")]
Weights = Annotated[
    dict[str, NonNegative] | None, Expected("weights >= 0 by name, as {T: 1.0}, or null")
]
Pairs = Annotated[
    dict[str, Annotated[list[Finite], Field(min_length=2, max_length=2)]] | None,
    Expected("pairs of numbers by name, as {T: [18, 24]}, or null"),
]


class LogSettings(TaskSettings):
    """The keys of the log and of the cost."""

    outputs: Names
    inputs: Names
    known: Names
    time: Column
    episode: Column
    #: Number of outputs in the window.
    past: Count
    Q: Weights
    R: Weights
    r: Annotated[
        dict[str, Finite | str] | None,
        Expected("numbers or known signals by output, as {T: 21.0}, or null"),
    ]
    linear: Annotated[
        dict[str, str] | None, Expected("known signals by input, as {q: price}, or null")
    ]
    y_bounds: Pairs
    u_bounds: Pairs


def read(cfg: DictConfig) -> Log:
    """Read the log that ``cfg.task`` names.

    Raises:
        QPError: there is no file, or as in `read_log`.
    """
    task = cfg.task
    if task.get("file") is None:
        remedy = "python train.py task=log task.file=FILE 'task.outputs=[..]' 'task.inputs=[..]' .."
        raise QPError.expected("task.file", "null", "the path of a CSV file, as in", remedy)
    columns = (task[name] for name in ("outputs", "inputs", "known"))
    names = (None if x is None else list(x) for x in columns)
    return read_log(Path(task.file), *names, time=task.time, episode=task.episode)


def make_plant(cfg: DictConfig) -> ARXPlant:
    """Identify the model that stands for the plant, with its cost and bounds."""
    task, log = cfg.task, read(cfg)
    identified = identify(log, 1, past=task.past, structure="tied")
    u = torch.cat([part.u for part in log.trajectories])
    seen = torch.stack((u.amin(0), u.amax(0)))
    unbounded = torch.full((2, len(log.outputs)), torch.inf).double()
    unbounded[0] *= -1
    lb_a, ub_a = read_pairs(task, "u_bounds", log.inputs, seen)
    lb_y, ub_y = read_pairs(task, "y_bounds", log.outputs, unbounded)
    W, q, c = stage_cost(task, log.outputs, log.inputs, log.known)

    def labels(names: tuple[str, ...]) -> list[str]:
        return [log.label(name) for name in names]

    return ARXPlant(
        **arx_arguments(identified, log),
        W=W,
        q=q,
        c=c,
        lb_a=lb_a,
        ub_a=ub_a,
        lb_y=lb_y,
        ub_y=ub_y,
        price=task.state_slack,
        labels=(labels(log.outputs), labels(log.inputs), labels(log.known)),
        horizon=task.horizon,
    )


def stage_cost(
    task: Mapping[str, Any],
    outputs: Sequence[str],
    inputs: Sequence[str],
    known: Sequence[str] = (),
) -> StageCost:
    """Return (y - r)'Q(y - r) + u'R u + price u as a cost of v = [d; y; u], by their names.

    Raises:
        QPError: a name is not that of a signal of its kind, or no output has a weight.
    """
    d, y, u = ({x: i for i, x in enumerate(names)} for names in (known, outputs, inputs))
    n_d, n = len(d), len(d) + len(y) + len(u)
    W, q, c = torch.zeros(n, n).double(), torch.zeros(n).double(), torch.zeros(()).double()
    if not task["Q"]:
        example = f"'task.Q={{{outputs[0]}: 1.0}}'"
        raise QPError.expected("task.Q", "none", f"weights of outputs, such as {example}")
    targets = by_name(task, "r", y)
    for name, weight in by_name(task, "Q", y).items():
        row, target = n_d + y[name], targets.get(name, 0.0)
        W[row, row] += 2 * weight
        if isinstance(target, str):
            column = _index("r", target, d)
            W[column, column] += 2 * weight
            W[row, column] = W[column, row] = -2 * weight
        else:
            q[row] -= 2 * weight * target
            c += weight * target**2
    for name, weight in by_name(task, "R", u).items():
        W[n_d + len(y) + u[name], n_d + len(y) + u[name]] = 2 * weight
    for name, price in by_name(task, "linear", u).items():
        row, column = n_d + len(y) + u[name], _index("linear", price, d)
        W[row, column] = W[column, row] = 1.0
    return StageCost(W, q, c)


def scheme(cfg: DictConfig, plant: ARXPlant) -> Scheme:
    """Make the scheme of the plant's own model; ``start=data`` replaces that by a predictor."""
    return plant_cost_scheme(cfg, plant, Model(plant.A, plant.B, plant.E, plant.offset))


def plant_cost_scheme(cfg: DictConfig, plant: ARXPlant | LinearPlant, model: Model) -> Scheme:
    """Make the scheme of a model with the plant's own cost and bounds."""
    layout = plant_layout(plant, cfg.task.horizon)
    cost = scheme_cost(
        StageCost(plant.W, plant.q, plant.c), layout, cfg.task.gamma, cfg.task.hessian
    )
    bounds = Bounds(state_bounds=(plant.lb_y, plant.ub_y), action_bounds=(plant.lb_a, plant.ub_a))
    return Scheme(layout, model, cost, priced(cfg, bounds), cfg.task.gamma)


def episode(plant: ARXPlant | LinearPlant, d: Tensor) -> dict[str, Any]:
    """Show the signals by their names and units in the log."""
    outputs, actions, known = plant.labels
    signals = dict(zip(known, d.unbind(-1), strict=True))
    return {"outputs": outputs, "actions": actions, "signals": signals}


def by_name(task: Mapping[str, Any], key: str, known: Mapping[str, int]) -> Mapping[str, Any]:
    """Return the mapping under ``key``, whose names are ``known``."""
    chosen = task.get(key) or {}
    for name in chosen:
        _index(key, name, known)
    return chosen


def _index(key: str, name: str, known: Mapping[str, int]) -> int:
    if name not in known:
        expected = f"one of {', '.join(known)}" if known else "none: there is no such signal"
        raise QPError.expected(f"task.{key}", repr(name), expected)
    return known[name]


def read_pairs(task: DictConfig, key: str, names: Sequence[str], default: Tensor) -> Tensor:
    """Return the pairs by name under ``key`` as ``(2, n)``, the ``default`` where there is none.

    Raises:
        QPError: a name is none of ``names``, or the first number of a pair is above the second.
    """
    index = {name: i for i, name in enumerate(names)}
    bounds = default.clone()
    for name, pair in by_name(task, key, index).items():
        if pair[0] > pair[1]:
            got = f"{{{name}: {list(pair)}}}"
            raise QPError.expected(f"task.{key}", got, "the lower number first")
        bounds[:, index[name]] = torch.tensor(list(pair)).double()
    return bounds


register(
    Task(
        "log",
        make_plant,
        scheme,
        closed_loop=plant_loop,
        episode=episode,
        settings=LogSettings,
        defaults=None,
        log=read,
        note=NOTE,
    )
)
