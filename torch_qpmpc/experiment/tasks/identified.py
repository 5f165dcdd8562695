"""Schemes that are identified from a log: the model, and the stage cost if the task has none."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torch import Tensor

from torch_qpmpc.errors import QPError
from torch_qpmpc.experiment.tasks.registry import AnyPlant, Scheme, find_task
from torch_qpmpc.mpc.identification import Identified, identify
from torch_qpmpc.mpc.layout import Layout
from torch_qpmpc.mpc.stage_cost import StageCost, fit_stage_cost


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
        cost = fitted_cost(cfg, log, found.options.layout)
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


def fitted_cost(cfg: DictConfig, log: TensorDictBase, layout: Layout) -> StageCost:
    """Fit a convex stage cost to the rewards of a log.

    Raises:
        QPError: the log has no rewards, or not all are finite.
    """
    n_d = layout.n_d
    reward = log.get(("next", "reward"), None)
    if reward is None or not reward.isfinite().all():
        got = "a log without rewards" if reward is None else "a log with rewards of NaN or inf"
        remedy = "Pass task.stage_weight, the weight W of the cost 1/2 [x; u]' W [x; u]."
        raise QPError.expected("start", got, "finite rewards to fit a cost to", remedy)
    parts = [log["observation"][..., -layout.n_x :], log["action"]]
    if n_d:
        parts.insert(0, log["preview"][..., :n_d])
    v = torch.cat(tuple(part.double() for part in parts), dim=-1).flatten(0, -2)
    return fit_stage_cost(v, -reward.double().flatten(), n_d, cfg.task.hessian == "diagonal")


def observed_cost(
    cfg: DictConfig, log: TensorDictBase, layout: Layout, found: StageCost | None = None
) -> tuple[dict[str, Any], dict[str, Tensor], Tensor]:
    """Return the cost of a scheme from that of a stage, by default `fitted_cost`.

    It is the cost of x_N, too, without an action, unless ``cfg`` has a terminal weight from the
    Riccati equation. The constant adds the mean cost of the log beyond the horizon.

    Returns:
        The stage weight and the constant c as fields of `Scheme`, the terminal weight as an
        argument of `QPMPC`, and q ``(n_z,)``.

    Raises:
        QPError: as in `fitted_cost`.
    """
    n_d, n_x, n_u, N = layout.n_d, layout.n_x, layout.n_u, layout.horizon
    W, q, c = fitted_cost(cfg, log, layout) if found is None else found
    diagonal = cfg.task.hessian == "diagonal"
    weight, terminal = (W[n_d:, n_d:].diagonal() if diagonal else W), n_d + n_x
    weights = {"terminal_weight": weight[:n_x] if diagonal else W[:terminal, :terminal]}
    d, x, u = q.split((n_d, n_x, n_u))
    past = q.new_zeros(layout.n_before - layout.n_preview)
    ahead = cfg.task.gamma ** torch.arange(N + 1, dtype=torch.float64)
    constant = c * ahead.sum()
    if cfg.task.gamma < 1:
        constant += (
            cfg.task.gamma ** (N + 1)
            / (1 - cfg.task.gamma)
            * -log["next", "reward"].double().mean()
        )
    fields = {"stage_weight": weight, "c": constant.item()}
    if cfg.task.terminal_weight == "riccati":
        weights, x_N = {}, torch.zeros_like(x)
    else:
        x_N = x
    stages = layout.stages(torch.stack((*[x] * N, x_N)), u)
    return fields, weights, torch.cat((d.repeat(N + 1), past, stages))
