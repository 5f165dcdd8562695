"""Schemes that are identified from a log: the model, and the stage cost if the task has none."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase

from torch_qpmpc.experiment.tasks.registry import AnyPlant, find_task, plant_layout
from torch_qpmpc.mpc.cost import Cost
from torch_qpmpc.mpc.identification import Identified, identify
from torch_qpmpc.mpc.layout import Layout
from torch_qpmpc.mpc.model import Model
from torch_qpmpc.mpc.rewards import fit_rewards, scheme_cost
from torch_qpmpc.mpc.scheme import Scheme
from torch_qpmpc.mpc.stage_cost import StageCost


class Start(NamedTuple):
    """A log of the task's plant, and the model and, if the task has none, the cost fitted to it.

    ``print`` shows the errors of both.
    """

    log: Any
    identified: Identified
    cost: StageCost | None = None

    def __str__(self) -> str:
        return "\n".join(str(part) for part in self[1:] if part is not None)


def identified_start(cfg: DictConfig, physics: AnyPlant, log: Any) -> Start:
    """Identify C, b and a missing stage cost from a log of the plant; `identify` names errors."""
    layout = plant_layout(physics, cfg.task.horizon)
    identified = identify(
        log,
        layout.horizon,
        past=layout.past,
        n_d=layout.n_d,
        n_x=layout.n_x,
        structure=cfg.constraint.structure,
        causal=cfg.start.causal,
        ridge=cfg.start.ridge,
    )
    cost = None
    if find_task(cfg.task).wrong_scheme(cfg, physics).cost.stage_weight is None:
        cost = fit_rewards(log, identified.options.layout, cfg.task.hessian == "diagonal")
    return Start(log, identified, cost)


def identified_scheme(cfg: DictConfig, scheme: Scheme, start: Start) -> Scheme:
    """Return ``scheme`` with the identified model and, if it has no weight, the log's cost."""
    identified, cost = start.identified, scheme.cost
    predictor = () if identified.options.structure == "tied" else identified.constraints
    if cost.stage_weight is None:
        cost = observed_cost(cfg, start.log, identified.options.layout, start.cost)
    return replace(
        scheme,
        layout=identified.options.layout,
        model=Model(*identified.model, *predictor),
        cost=cost,
    )


def observed_cost(
    cfg: DictConfig, log: TensorDictBase, layout: Layout, fitted: StageCost | None = None
) -> Cost:
    """Return the cost of a scheme from that of a stage, by default fitted to the log's rewards.

    It is the cost of x_N, too, without an action, unless ``cfg`` has a terminal weight from the
    Riccati equation. The constant adds the mean cost of the log beyond the horizon.

    Raises:
        QPError: as in `fit_rewards`.
    """
    diagonal, gamma = cfg.task.hessian == "diagonal", cfg.task.gamma
    fitted = fit_rewards(log, layout, diagonal) if fitted is None else fitted
    cost = scheme_cost(fitted, layout, gamma, cfg.task.hessian)
    if gamma < 1:
        mean = -log["next", "reward"].double().mean()
        cost = replace(cost, c=cost.c + gamma ** (layout.horizon + 1) / (1 - gamma) * mean)
    if cfg.task.terminal_weight != "riccati":
        return cost
    q = torch.cat((cost.q[: -layout.n_x], 0 * cost.q[-layout.n_x :]))
    return replace(cost, terminal_weight=None, q=q)
