"""Schemes that are identified from a log: the model, and the stage cost if the task has none."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torch import Tensor

from torch_qpmpc.envs import GymnasiumPlant
from torch_qpmpc.errors import QPError
from torch_qpmpc.experiment.blow_ups import without_blow_ups
from torch_qpmpc.experiment.tasks.choice import Choice
from torch_qpmpc.experiment.tasks.registry import AnyPlant, find_task, plant_layout
from torch_qpmpc.mpc.blended import BlendedModel
from torch_qpmpc.mpc.cost import Cost
from torch_qpmpc.mpc.identification import Identified, identify
from torch_qpmpc.mpc.layout import Layout
from torch_qpmpc.mpc.log import as_log, valid_steps
from torch_qpmpc.mpc.model import Model
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.mpc.rewards import RewardCost, fit_rewards, scheme_cost
from torch_qpmpc.mpc.riccati import affine_cost_to_go, terminal_riccati
from torch_qpmpc.mpc.roles import unmoved
from torch_qpmpc.mpc.scheme import Scheme
from torch_qpmpc.mpc.tightening import back_off, tighten


class Start(NamedTuple):
    """A log of the task's plant, and the model and, if the task has none, the cost fitted to it.

    ``cut`` is the number of the log's episodes that blow up. ``held`` is an action ``(n_u,)`` that
    the policy holds, by a cost of its own; None for the policy of the fitted cost.
    ``choice`` is the table of starts that it was chosen from, if it was. ``blended`` is the QP's
    schedule, in the place of the identified model; None without one. ``riccati`` is True if the
    cost of x_N is the regulator's. ``still`` has the outputs that hardly move near where episodes
    begin, if the model and the cost are fitted there; else None. ``print`` shows ``cut``, the
    errors of the model and the cost, and that table.
    """

    log: Any
    identified: Identified
    cost: RewardCost | None = None
    cut: int = 0
    held: Tensor | None = None
    choice: Choice | None = None
    blended: BlendedModel | None = None
    riccati: bool = False
    still: Sequence[int] | None = None

    @property
    def outputs_held(self) -> list[int]:
        """The outputs that a model of the whole log holds, too."""
        return [i for i in self.identified.options.held if i not in (self.still or ())]

    def plant(self, physics: AnyPlant) -> AnyPlant:
        """Return ``physics``, whose observation has the window of this start's model."""
        if not isinstance(physics, GymnasiumPlant):
            return physics
        return physics.windowed(self.identified.options.layout.past)

    def __str__(self) -> str:
        cut = f"Episodes of the log that blow up, and are cut there: {self.cut}"
        held, names = self.outputs_held, self.identified.log.outputs
        known = f"Held at their last value over the horizon: {', '.join(names[i] for i in held)}"
        known += f", as by task.held={[*held]}"
        count = 0 if self.blended is None else len(self.blended.centres)
        blended = f"Linear models at {count} centres, blended, take the place of the model above."
        still = ", ".join(names[i] for i in self.still or ()) or "none"
        local = "The model and the cost are those of the steps nearest to where episodes begin, "
        local += f"one by one. Outputs that hardly move there, and are held: {still}"
        parts = (cut if self.cut else None, self.identified, blended if count else None)
        parts += (None if self.still is None else local,)
        parts += known if held else None, self.cost, self.choice
        return "\n".join(str(part) for part in parts if part is not None)

    @property
    def summary(self) -> dict[str, Any]:
        """The entries of summary.json: episodes cut, outputs held, window, and fits of the cost."""
        held = self.outputs_held
        entries: dict[str, Any] = {"log_episodes_cut": self.cut}
        entries |= {"outputs_held": held} if held else {}
        past = self.identified.options.layout.past
        entries |= {"past": past} if past > 1 else {}
        entries |= {} if self.choice is None else self.choice.summary
        if self.cost is None:
            return entries
        now, after = self.cost.now, self.cost.after
        R2 = {"R2_cost": now.R2, "R2_cost_next": torch.nan if after is None else after.R2}
        return entries | R2 | {"cost_of_next": self.cost.shifted}


def identified_start(cfg: DictConfig, physics: AnyPlant, log: Any) -> Start:
    """Identify C, b and a missing stage cost from a log of the plant; `identify` names errors."""
    log, cut = without_blow_ups(log) if isinstance(log, TensorDictBase) else (log, 0)
    layout = plant_layout(physics, cfg.task.horizon)
    held = cfg.task.held if "held" in cfg.task else []
    if held is None:
        held = unmoved(as_log(log, layout.n_x).trajectories, cfg.task.horizon)
    structure, ridge = cfg.constraint.structure, cfg.start.ridge
    identified = identified_model(log, layout, structure, held, ridge)
    cost = None
    if find_task(cfg.task).wrong_scheme(cfg, physics).cost.stage_weight is None:
        cost = _fitted(cfg, log, identified.options.layout)
    return Start(log, identified, cost, cut)


def identified_scheme(cfg: DictConfig, scheme: Scheme, start: Start) -> Scheme:
    """Return ``scheme`` with the identified model and, if it has no weight, the log's cost."""
    identified, cost = start.identified, scheme.cost
    predictor = () if identified.options.structure == "tied" else identified.constraints
    if cost.stage_weight is None:
        cost = observed_cost(cfg, start.log, identified.options.layout, start.cost)
        if is_regulated(cfg, start):
            cost = regulator_cost(cost, start, scheme.gamma)
    scheme = replace(
        scheme,
        layout=identified.options.layout,
        model=Model(*identified.model, *predictor),
        cost=cost,
    )
    return scheme if start.held is None else _holding(scheme, start)


def is_regulated(cfg: DictConfig, start: Start) -> bool:
    """Return True if a fitted cost of x_N is to be the regulator's."""
    return start.cost is not None and (start.riccati or cfg.task.terminal_weight == "riccati")


def regulator_cost(cost: Cost, start: Start, gamma: float) -> Cost:
    """Return ``cost``, fitted to a log, with the regulator's cost to go at x_N.

    With known signals, that is the cost about the x of least stage cost for them.

    Raises:
        QPError: as in `terminal_riccati`.
    """
    layout, model, fitted = start.identified.options.layout, start.identified.model, start.cost
    assert fitted is not None
    first = cost.q[: -layout.n_x]
    if layout.n_d:
        P = terminal_riccati(model.A, model.B, cost.stage_weight, gamma, layout)
        return replace(cost, terminal_weight=P, q=F.pad(first, (0, layout.n_x)))
    # Outputs that are still have neither a weight nor an effect, and no action moves them.
    moving = torch.tensor([i for i in range(layout.n_x) if i not in (start.still or ())])
    both = torch.cat((moving, torch.arange(layout.n_x, layout.n)))
    sizes = replace(layout, n_x=len(moving))
    A, B, offset = model.A[moving][:, moving], model.B[moving], model.offset[moving]
    W, q, c = fitted.best.W[both][:, both], fitted.best.q[both], cost.c
    P = terminal_riccati(A, B, W, gamma, sizes)
    values, vectors = torch.linalg.eigh(P)
    P = vectors * values.clamp(min=0) @ vectors.mT  # up to rounding, it is that
    p, ahead = affine_cost_to_go(A, B, offset, W, q, P, gamma)
    if gamma < 1:
        c = fitted.best.c / (1 - gamma) + gamma**layout.horizon * ahead
    into = torch.eye(layout.n_x, dtype=P.dtype)[:, moving]
    return replace(cost, terminal_weight=into @ P @ into.mT, q=torch.cat((first, into @ p)), c=c)


def _holding(scheme: Scheme, start: Start) -> Scheme:
    """Return the scheme of the same model whose policy holds ``start.held``.

    Its cost is 1/2 (u_k - held)'R(u_k - held) in each stage, of the size of the log's costs, and a
    constant, their mean: a weight of x would move the actions, and some plants react to any.
    """
    held, log, layout = start.held, start.log, scheme.layout
    assert held is not None
    valid = valid_steps(log)
    reward = log.get(("next", "reward"), torch.zeros(()))  # a task with a weight needs none
    costs = -reward.double().reshape(log.shape)[valid] if reward.ndim else reward.double()
    size = (log["action"][valid].double() - held).abs().amax(0)
    R = (costs.abs().mean() if costs.any() else 1.0) / size.square()
    gamma, N, zero = scheme.gamma, layout.horizon, R.new_zeros(layout.n_x)
    q = torch.cat((R.new_zeros(layout.n_before), layout.stages(zero, -R * held)))
    ahead = (gamma ** torch.arange(N, dtype=torch.float64)).sum()
    c = costs.mean() * (N if gamma == 1 else 1 / (1 - gamma))
    c += ahead * (R * held.square()).sum() / 2
    weight = torch.cat((zero, R))
    weight = weight if scheme.cost.hessian == "diagonal" else torch.diag(weight)
    weight = weight.expand_as(scheme.cost.stage_weight)  # one per stage where the scheme has that
    cost = Cost(weight, zero, scheme.cost.hessian, q=q, c=c)
    return replace(scheme, cost=cost, bounds=replace(scheme.bounds, state_bounds=None))


def observed_cost(
    cfg: DictConfig, log: TensorDictBase, layout: Layout, fitted: RewardCost | None = None
) -> Cost:
    """Return the cost of a scheme from that of a stage, by default fitted to the log's rewards.

    It is the cost of x_N, too, without an action. The constant adds the mean cost of the log beyond
    the horizon.

    Raises:
        QPError: as in `fit_rewards`.
    """
    gamma = cfg.task.gamma
    fitted = _fitted(cfg, log, layout) if fitted is None else fitted
    cost = scheme_cost(fitted.best, layout, gamma, cfg.task.hessian, fitted.shifted)
    if gamma < 1:
        mean = -log["next", "reward"].reshape(log.shape)[valid_steps(log)].double().mean()
        stages = layout.horizon + (not fitted.shifted)
        cost = replace(cost, c=cost.c + gamma**stages / (1 - gamma) * mean)
    return cost


def nominal_mpcs(
    cfg: DictConfig, physics: AnyPlant, data: Sequence[TensorDictBase], held: Sequence[int] = ()
) -> list[QPMPC]:
    """Make MPC with a model of logged steps and the plant's own cost and bounds, without learning.

    There is no discount. A task without a stage cost has the one fitted to the rewards, and a
    second scheme with the regulator's cost of x_N, if there is one. Each soft bound is tightened by
    the covariance of the cross-validated prediction errors, so that it holds with a probability of
    95 %: with the feedback of `back_off` or, for a window, without one.

    Args:
        cfg: the run's configuration.
        physics: the plant.
        data: logs, each as in `identify`.
        held: the outputs that the model holds.

    Raises:
        QPError: the steps identify no model.
    """
    task = find_task(cfg.task)
    scheme = (task.nominal_scheme or task.true_scheme or task.wrong_scheme)(cfg, physics)
    layout, costs = scheme.layout, [scheme.cost]
    identified = identified_model(data, layout, "tied", held)
    if scheme.cost.stage_weight is None:
        diagonal = cfg.task.hessian == "diagonal"
        start = Start(data, identified, fit := fit_rewards(data, layout, diagonal))
        costs = [scheme_cost(fit.now, layout, 1.0, cfg.task.hessian)]
        if not diagonal and layout.past == 1:
            with suppress(QPError):
                costs.append(regulator_cost(costs[0], start, 1.0))
    model = Model(*identified.model)
    schemes = [replace(scheme, model=model, cost=cost, gamma=1.0) for cost in costs]
    return [_tightened(cfg, scheme, identified) for scheme in schemes]


def _tightened(cfg: DictConfig, scheme: Scheme, identified: Identified) -> QPMPC:
    """Return MPC with the bounds of `nominal_mpcs`."""
    mpc = QPMPC(scheme, learn=(), structure="tied", solver=cfg.solver, on_failure="mask")
    if not (mpc.soft & (mpc.lb.isfinite() | mpc.ub.isfinite())).any():
        return mpc
    if scheme.layout.past == 1:
        back_off(mpc, identified.covariance)
    else:
        errors = identified.errors
        errors = errors[errors.isfinite().flatten(1).all(-1)].transpose(0, 1)
        tighten(mpc, F.pad(errors.mT @ errors / errors.shape[1], (0, 0, 0, 0, 1, 0)))
    return mpc


def identified_model(
    data: Any,
    layout: Layout,
    structure: str,
    held: Sequence[int],
    ridge: float | None = None,
) -> Identified:
    """Identify C and b with the sizes of ``layout``; see `identify`."""
    sizes = {"past": layout.past, "n_d": layout.n_d, "n_x": layout.n_x}
    options = {"structure": structure, "ridge": ridge, "held": held}
    return identify(data, layout.horizon, **sizes, **options)


def _fitted(cfg: DictConfig, log: TensorDictBase, layout: Layout) -> RewardCost:
    """Fit the costs of a stage; with a tied C or a Riccati weight all stages have the same."""
    usable = cfg.constraint.structure == "free" and cfg.task.terminal_weight != "riccati"
    return fit_rewards(log, layout, cfg.task.hessian == "diagonal", after=True, usable=usable)
