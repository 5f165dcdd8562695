"""Schemes that are identified from a log: the model, and the stage cost if the task has none."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
import torch.nn.functional as F
from tensordict import TensorDictBase
from torch import Tensor

from torch_qpmpc.envs import LinearSystem, Plant
from torch_qpmpc.errors import QPError
from torch_qpmpc.experiment.config import Config, find_task
from torch_qpmpc.experiment.logs import estimated, without_blow_ups
from torch_qpmpc.experiment.tasks.registry import AnyPlant
from torch_qpmpc.identification.identification import check_excitation, measured_model
from torch_qpmpc.identification.innovations import Innovations
from torch_qpmpc.identification.learned import LearnedModel, fit_learned
from torch_qpmpc.identification.reading import as_log
from torch_qpmpc.identification.steps import MEASURED, NEXT, valid_steps
from torch_qpmpc.identification.subspace import fit_state_space
from torch_qpmpc.mpc.cost import Cost
from torch_qpmpc.mpc.layout import Layout
from torch_qpmpc.mpc.model import Model
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.mpc.projections import nearest_psd
from torch_qpmpc.mpc.riccati import affine_cost_to_go, lqr_gain, stage_weight, terminal_riccati
from torch_qpmpc.mpc.scheme import Scheme
from torch_qpmpc.mpc.stage_cost import StageCost, fit_rewards, scheme_cost
from torch_qpmpc.mpc.tightening import prediction_covariance, tighten

if TYPE_CHECKING:
    from torch_qpmpc.experiment.choosing import Choice

#: The most transitions of an update of a nonlinear scheme.
FEWER = 32
#: A nonlinear plan, whose cost has no end, looks so many times as far ahead.
FARTHER = 2.5
#: The weight of an action in a nonlinear scheme, relative to the costs of the log, for one minimum.
TINY = 1e-6
NETWORKS = (
    "Networks replace this model, C and b, and stay as fitted. Only theta's cost is learned, from "
    f"{FEWER} transitions an update: a nonlinear plan takes as long as many QPs."
)


class Start(NamedTuple):
    """A log of the task's plant, and the model and, if the task has none, the cost fitted to it.

    The observation of ``log`` is the state of ``model``: where the plant has an ``observer``, which
    is ``model`` then, its estimate; ``order`` is as in `fit_state_space`. ``cut`` is the number of
    the log's episodes that blow up. ``action`` ``(n_u,)`` is what the policy holds, by a cost of
    its own. ``choice`` is the table that it was chosen from, ``dynamics`` the networks in place of
    ``model``. ``riccati`` is True if the cost of x_N is the regulator's.
    """

    log: Any
    model: Innovations
    horizon: int
    order: int = 0
    observer: Innovations | None = None
    cost: StageCost | None = None
    cut: int = 0
    action: Tensor | None = None
    choice: Choice | None = None
    dynamics: LearnedModel | None = None
    riccati: bool = False

    @property
    def layout(self) -> Layout:
        """The sizes of the QP."""
        (n, n_u), n_d = self.model.B.shape, self.model.E.shape[1]
        return Layout(n, n_u, self.horizon, n_d=n_d)

    def __str__(self) -> str:
        cut = f"Episodes of the log that blow up, and are cut there: {self.cut}"
        poles = ", ".join(f"{abs(pole):.3g}" for pole in self.model.poles)
        parts = [cut] * (self.cut > 0)
        parts += [f"Model of order {len(self.model.A)}, with poles of sizes {poles}"]
        parts += [NETWORKS] * (self.dynamics is not None)
        if self.cost is not None:
            parts += [f"stage cost fitted to the rewards: R2 {self.cost.R2:.3f}"]
        return "\n".join(str(part) for part in (*parts, self.choice) if part is not None)

    @property
    def summary(self) -> dict[str, Any]:
        """The entries of summary.json: episodes cut, the model's order, and the cost's fit."""
        entries: dict[str, Any] = {"log_episodes_cut": self.cut}
        entries |= {"order": len(self.model.A)} if self.observer is not None else {}
        entries |= {} if self.choice is None else self.choice.summary
        return entries | ({} if self.cost is None else {"R2_cost": self.cost.R2})


def identified_start(cfg: Config, physics: AnyPlant, log: Any, order: int | None = None) -> Start:
    """Identify the model and a missing stage cost from a log of the plant; see `identify`.

    The state is the estimate by the filter of a model of this ``order``, None for the one that
    `fit_state_space` chooses. That of a `LinearSystem` is measured.
    """
    log, cut = without_blow_ups(log) if isinstance(log, TensorDictBase) else (log, 0)
    if cut and not valid_steps(log).any():
        remedy = "".join(f"The plant ends them by {x}." for x in getattr(physics, "raised", [])[:1])
        reward = log.get(("next", "reward"), log["action"])
        what = "step" if remedy or reward.isfinite().any() else "reward"
        got = f"{cut} episodes without a finite {what}"
        raise QPError.expected("start", got, f"finite {what}s in a log", remedy)
    observed = not isinstance(physics, LinearSystem)
    if observed:
        sizes = (physics.n_y, physics.n_d) if isinstance(physics, Plant) else (physics.n_x, 0)
        data = as_log(log, *sizes)
    else:
        data, order = as_log(log), 0
    check_excitation(data)

    fit = fit_state_space(data.trajectories, order)
    steps = estimated(log, fit.model) if observed else log
    observer = fit.model if observed else None
    start = Start(steps, fit.model, cfg.task.horizon, fit.order, observer, cut=cut)
    scheme = find_task(cfg.task).wrong_scheme(cfg, physics.observed(observer))
    if scheme.cost.stage_weight is not None:
        return start
    diagonal = cfg.task.hessian == "diagonal"
    return start._replace(cost=fit_rewards(steps, start.layout, diagonal, start.model))


def nonlinear_start(cfg: Config, physics: AnyPlant, start: Start) -> Start | None:
    """Return ``start``, of outputs, with networks; None if none predicts the outputs better.

    None, too, with known signals, or where C and b, which it lacks, are needed.
    """
    rest = {*cfg.task.learn_cost, *cfg.constraint.learn} - {"C", "b"}
    if isinstance(physics, LinearSystem | Plant) or cfg.constraint.si is not None or not rest:
        return None
    kept = valid_steps(start.log)
    x, u, after = (start.log[key].double()[kept] for key in ("observation", "action", NEXT))
    cost = None if start.cost is None else -_rewards(start.log)[kept]
    model = fit_learned(torch.cat((x, u), -1), x, after, cost)
    horizon = math.ceil(FARTHER * start.horizon)
    return start._replace(horizon=horizon, dynamics=model) if model.depth else None


def identified_scheme(cfg: Config, scheme: Scheme, start: Start) -> Scheme:
    """Return ``scheme`` with the identified model and, if it has no weight, the log's cost."""
    cost, model, layout, gamma = scheme.cost, start.model, start.layout, cfg.task.gamma
    if cost.stage_weight is None and start.dynamics is not None:
        cost = _cost_of_networks(cfg, start)
    elif cost.stage_weight is None:
        assert start.cost is not None
        cost = scheme_cost(start.cost, layout, gamma, cfg.task.hessian)
        # After x_N, the constant has the log's mean.
        cost = replace(cost, c=cost.c + _ahead(start.log, gamma, layout.horizon + 1))
        if start.riccati or cfg.task.terminal_weight == "riccati":
            cost = regulator_cost(cost, start.cost, model, layout, scheme.gamma)
    scheme = replace(scheme, layout=layout, model=Model(*model[:4]), cost=cost)
    return scheme if start.action is None else _holding(scheme, start)


def regulator_cost(
    cost: Cost, fitted: StageCost, model: Innovations, layout: Layout, gamma: float
) -> Cost:
    """Return ``cost``, ``fitted`` to a log, with the regulator's cost to go at x_N."""
    A, B, offset = map(torch.tensor, (model.A, model.B, model.offset))
    first = cost.q[: -layout.n_x]
    if layout.n_d:
        P = terminal_riccati(A, B, cost.stage_weight, gamma, layout)
        return replace(cost, terminal_weight=P, q=F.pad(first, (0, layout.n_x)))
    P = terminal_riccati(A, B, fitted.W, gamma, layout)
    P = nearest_psd(P)  # up to rounding, it is that
    p, ahead = affine_cost_to_go(A, B, offset, fitted.W, fitted.q, P, gamma)
    c = cost.c
    if gamma < 1:
        c = fitted.c / (1 - gamma) + gamma**layout.horizon * ahead
    return replace(cost, terminal_weight=P, q=torch.cat((first, p)), c=c)


def _holding(scheme: Scheme, start: Start) -> Scheme:
    """Return the scheme of the same model whose policy holds ``start.action``.

    Its cost is 1/2 (u_k - action)'R(u_k - action) in each stage, of the size of the log's costs,
    and a constant, their mean: a weight of x would move the actions, and some plants react to any.
    """
    action, log, layout = start.action, start.log, scheme.layout
    assert action is not None
    valid = valid_steps(log)
    reward = log.get(("next", "reward"), torch.zeros(()))  # a task with a weight needs none
    costs = -reward.double().reshape(log.shape)[valid] if reward.ndim else reward.double()
    size = (log["action"][valid].double() - action).abs().amax(0)
    R = (costs.abs().mean() if costs.any() else 1.0) / size.square()
    gamma, N, zero = scheme.gamma, layout.horizon, R.new_zeros(layout.n_x)
    q = torch.cat((R.new_zeros(layout.n_preview), layout.stages(zero, -R * action)))
    ahead = (gamma ** torch.arange(N, dtype=torch.float64)).sum()
    c = costs.mean() * (N if gamma == 1 else 1 / (1 - gamma))
    c += ahead * (R * action.square()).sum() / 2
    weight = torch.cat((zero, R))
    weight = weight if scheme.cost.hessian == "diagonal" else torch.diag(weight)
    weight = weight.expand_as(scheme.cost.stage_weight)  # one per stage where the scheme has that
    cost = Cost(weight, zero, scheme.cost.hessian, q=q, c=c)
    return replace(scheme, cost=cost, bounds=replace(scheme.bounds, state_bounds=None))


def _cost_of_networks(cfg: Config, start: Start) -> Cost:
    """Return theta's cost beside that of the dynamics: next to none."""
    gamma, layout, log = cfg.task.gamma, start.layout, start.log
    kept, weight = valid_steps(log), torch.zeros(layout.n, dtype=torch.float64)
    size = log["action"][kept].double().square().mean(0)
    weight[layout.n_x :] = TINY * _rewards(log)[kept].abs().mean() / size
    weights = weight, torch.zeros_like(weight[: layout.n_x])
    dense = cfg.task.hessian != "diagonal"
    stage, end = (torch.diag(x) if dense else x for x in weights)
    return Cost(stage, end, cfg.task.hessian, c=_ahead(log, gamma, layout.horizon))


def _ahead(log: TensorDictBase, gamma: float, k: int) -> Tensor:
    """Return the discounted costs from stage k on, each the mean of the log's; 0 if endless."""
    mean = -_rewards(log)[valid_steps(log)].mean()
    return gamma**k / (1 - gamma) * mean if gamma < 1 else 0 * mean


def _rewards(log: TensorDictBase) -> Tensor:
    return log["next", "reward"].double().reshape(log.shape)


def nominal_mpcs(cfg: Config, physics: AnyPlant, data: Sequence[TensorDictBase]) -> list[QPMPC]:
    """Make MPC with a model of logged steps and the plant's own cost and bounds, without learning.

    There is no discount. A task without a stage cost has the one fitted to the rewards, and a
    second scheme with the regulator's cost of x_N, if there is one. Soft bounds are tightened by
    the prediction errors' covariance, with the regulator's feedback, if there is one.
    """
    task = find_task(cfg.task)
    scheme = (task.nominal_scheme or task.true_scheme or task.wrong_scheme)(cfg, physics)
    layout, costs = scheme.layout, [scheme.cost]
    data = [steps.exclude(MEASURED) for steps in data]  # its outputs are the observations
    model, _ = measured_model(data, layout.n_x, layout.n_d)
    if scheme.cost.stage_weight is None:
        diagonal = cfg.task.hessian == "diagonal"
        fit = fit_rewards(data, layout, diagonal, model)
        costs = [scheme_cost(fit, layout, 1.0, cfg.task.hessian)]
        if not diagonal:
            with suppress(QPError):
                costs.append(regulator_cost(costs[0], fit, model, layout, 1.0))
    schemes = [replace(scheme, model=Model(*model[:4]), cost=cost, gamma=1.0) for cost in costs]
    mpcs = [
        QPMPC(scheme, learn=(), structure="tied", solver=cfg.solver, on_failure="mask")
        for scheme in schemes
    ]
    for mpc in mpcs:
        if (mpc.soft & (mpc.lb.isfinite() | mpc.ub.isfinite())).any():
            A, B, *_ = mpc.model()
            K = torch.zeros(B.mT.shape).to(A)
            with suppress(QPError):
                K = -lqr_gain(A, B, stage_weight(mpc))
            errors = prediction_covariance(A + B @ K, torch.tensor(model.S), mpc.horizon)
            tighten(mpc, errors, K=K)
    return mpcs
