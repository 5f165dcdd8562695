"""Schemes that are identified from a log: the model, and the stage cost if the task has none."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torch import Tensor

from torch_qpmpc.experiment.tasks.registry import AnyPlant, Scheme, find_task
from torch_qpmpc.mpc.identification import Identified, identify
from torch_qpmpc.mpc.layout import Layout
from torch_qpmpc.mpc.rewards import fit_rewards, scheme_cost
from torch_qpmpc.mpc.stage_cost import StageCost


class Start(NamedTuple):
    """A log of the task's plant, and the model and, if the task has none, the cost fitted to it.

    ``print`` shows the errors of both.
    """

    log: TensorDictBase
    identified: Identified
    cost: StageCost | None = None

    def __str__(self) -> str:
        return "\n".join(str(part) for part in self[1:] if part is not None)


def identified_start(cfg: DictConfig, physics: AnyPlant, log: TensorDictBase) -> Start:
    """Identify C, b and a missing stage cost from a log of the plant; `identify` names errors."""
    found = identify(
        log,
        cfg.task.horizon,
        past=getattr(physics, "past", 1),
        n_d=getattr(physics, "n_d", 0),
        n_x=getattr(physics, "n_y", None),
        structure=cfg.constraint.structure,
        causal=cfg.start.causal,
        ridge=cfg.start.ridge,
    )
    cost = None
    if find_task(cfg.task).wrong_scheme(cfg, physics).stage_weight is None:
        cost = fit_rewards(log, found.options.layout, cfg.task.hessian == "diagonal")
    return Start(log, found, cost)


def identified_scheme(cfg: DictConfig, scheme: Scheme, start: Start) -> Scheme:
    """Return ``scheme`` with the identified model and, if it has no weight, the log's cost."""
    arguments = start.identified.arguments
    model = {name: arguments[name] for name in ("A", "B")}
    options = {name: arguments[name] for name in ("past", "n_d", "E", "offset")}
    values = {**scheme.options.get("start", {}), **arguments.get("start", {})}
    cost = {}
    if scheme.stage_weight is None:
        layout = start.identified.options.layout
        cost, weights, q = observed_cost(cfg, start.log, layout, start.cost)
        options, values = options | weights, {**values, "q": q}
    options = {**scheme.options, **options, "start": values}
    return replace(scheme, **model, **cost, options=options)


def observed_cost(
    cfg: DictConfig, log: TensorDictBase, layout: Layout, found: StageCost | None = None
) -> tuple[dict[str, Any], dict[str, Tensor], Tensor]:
    """Return the cost of a scheme from that of a stage, by default fitted to the log's rewards.

    It is the cost of x_N, too, without an action, unless ``cfg`` has a terminal weight from the
    Riccati equation. The constant adds the mean cost of the log beyond the horizon.

    Returns:
        The stage weight and the constant c as fields of `Scheme`, the terminal weight as an
        argument of `QPMPC`, and q ``(n_z,)``.

    Raises:
        QPError: as in `fit_rewards`.
    """
    diagonal, gamma = cfg.task.hessian == "diagonal", cfg.task.gamma
    found = fit_rewards(log, layout, diagonal) if found is None else found
    cost = scheme_cost(found, layout, gamma, diagonal)
    q, constant = cost["start"]["q"], cost["start"]["c"]
    if gamma < 1:
        mean = -log["next", "reward"].double().mean()
        constant += gamma ** (layout.horizon + 1) / (1 - gamma) * mean
    fields = {"stage_weight": cost["stage_weight"], "c": constant.item()}
    if cfg.task.terminal_weight == "riccati":
        return fields, {}, torch.cat((q[: -layout.n_x], 0 * q[-layout.n_x :]))
    return fields, {"terminal_weight": cost["terminal_weight"]}, q
