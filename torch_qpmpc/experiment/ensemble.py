"""An ensemble of linear models of a log, on which policies run in closed loop without the plant."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from omegaconf import DictConfig
from torch import Tensor

from torch_qpmpc.checks import check_kind
from torch_qpmpc.envs import LinearSystem, Plant
from torch_qpmpc.envs.arx_plant import ARXMember
from torch_qpmpc.envs.closed_loop import plant_loop
from torch_qpmpc.errors import QPError
from torch_qpmpc.experiment.collection import warm_up_batches
from torch_qpmpc.experiment.tasks import AnyPlant
from torch_qpmpc.experiment.tasks.identified import Start, arx_arguments
from torch_qpmpc.experiment.tasks.registry import plant_layout
from torch_qpmpc.learning.operators import warm_policy
from torch_qpmpc.mpc.identification import identify
from torch_qpmpc.mpc.layout import Layout
from torch_qpmpc.mpc.log import as_log
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.mpc.rewards import fit_rewards
from torch_qpmpc.mpc.stage_cost import StageCost as FittedCost
from torch_qpmpc.mpc.trajectories import folds

#: Models of an ensemble, and the blocks of consecutive steps that each is fitted to.
MEMBERS, BLOCKS = 4, 8

#: A cost of y, u and d.
StageCost = Callable[[Tensor, Tensor, Tensor], Tensor]


class PredictedCost(NamedTuple):
    """J on the models of an ensemble: the mean, the least and the largest."""

    J: float
    low: float
    high: float


def predict_cost(
    mpc: QPMPC,
    log: Any,
    stage_cost: StageCost | None = None,
    *,
    steps: int = 50,
    starts: int = 32,
    seed: int = 123,
) -> PredictedCost:
    """Predict J of a policy from a log alone: off-policy evaluation, with a range.

    The policy runs in closed loop on the models of an `ensemble`. Their range shows how much J
    varies between parts of the log, in models and starts. It is no confidence interval, and says
    nothing of what no linear model has.

    Args:
        mpc: the policy.
        log: logged steps of any other policy that excites the plant, as in `identify`.
        stage_cost: the cost ``(*batch,)`` of y ``(*batch, n_x)``, u ``(*batch, n_u)`` and the known
            signals d ``(*batch, n_d)``; by default the quadratic one that is fitted to the log's
            rewards.
        steps, starts, seed: those of the closed loops on each model.

    Raises:
        QPError: as in `ensemble`, or there are no rewards to fit a cost to.

    Example:
        >>> import torch_qpmpc as qm
        >>> from torch_qpmpc.envs import PointMass
        >>> physics = PointMass()
        >>> log = physics.vectorised(16, 25, seed=0).rollout(50, break_when_any_done=False)
        >>> options = {"stage_weight": [1.0] * 4 + [0.1] * 2, "action_bounds": ([-1] * 2, [1] * 2)}
        >>> mpc = qm.QPMPC.from_model(physics.A, physics.B, 5, **options)
        >>> J, low, high = predict_cost(mpc, log)
        >>> low < J < high
        True
    """
    check_kind("mpc", mpc, QPMPC)
    cost = _fitted(log, mpc.layout) if stage_cost is None else stage_cost
    free = torch.full((mpc.n_u,), torch.inf, dtype=torch.float64)
    members = ensemble(log, mpc.layout, cost, -free, free)
    options = {"steps": steps, "starts": starts, "seed": seed}
    J = [plant_loop(warm_policy(mpc), member, **options).J for member in members]
    return PredictedCost(sum(J) / len(J), min(J), max(J))


def ensemble(
    data: Any,
    layout: Layout,
    stage_cost: StageCost,
    lb_a: Tensor,
    ub_a: Tensor,
    held: Sequence[int] = (),
) -> list[ARXMember]:
    """Fit four ARX models to halves of a log, each to eight blocks of steps from all over it.

    A model of half the data differs from that of all by as much as that does from the truth: both
    differences have the same variance (half-samples: McCarthy, "Pseudo-replication: half samples",
    Review of the International Statistical Institute 1969).

    A member's disturbances are its own cross-validated one-step errors, drawn with replacement. It
    starts where a quarter of the log's trajectories do or, if these are fewer than four, where all
    do, with known signals that begin with another of these steps.

    Args:
        data: a log, as in `identify`.
        layout: the sizes of the policies.
        stage_cost: the cost ``(*batch,)`` of y, u and d.
        lb_a, ub_a: bounds of the action, ``(n_u,)``.
        held: outputs that keep their last value, as in `identify`.

    Raises:
        QPError: a half identifies no model.
    """
    log = as_log(data, layout.n_x, layout.n_d)
    blocks = folds(log.trajectories, 2 * BLOCKS)
    first = torch.tensor([0, *(trajectory.steps for trajectory in log.trajectories[:-1])]).cumsum(0)
    options = {"stage_cost": stage_cost, "lb_a": lb_a, "ub_a": ub_a, "horizon": layout.horizon}
    members = []
    for i in range(MEMBERS):
        # Blocks i and i + 1 of each four: each block is in two members.
        half = [*blocks[i::MEMBERS], *blocks[(i + 1) % MEMBERS :: MEMBERS]]
        part = [trajectory for block in half for trajectory in block]
        model = identify(
            replace(log, trajectories=part), 1, past=layout.past, structure="tied", held=held
        )
        starts = first[i::MEMBERS] if len(first) >= MEMBERS else first
        members.append(ARXMember(**arx_arguments(model, log), **options, first=starts))
    return members


def run_ensemble(
    cfg: DictConfig, physics: AnyPlant, start: Start | None, data: Any
) -> list[ARXMember]:
    """Fit the `ensemble` of a run's logged steps, with the outputs held that the start holds.

    The cost is the plant's own where it is one of outputs, inputs and known signals, else the
    start's if it is one of (y_k, u_k) and of the whole log, and else the one that is fitted to the
    rewards.

    Raises:
        QPError: as in `ensemble`.
    """
    layout = plant_layout(physics, cfg.task.horizon)
    cost: Any = None
    if isinstance(physics, LinearSystem):
        cost = lambda y, u, d: physics.cost(y, u)  # noqa: E731
    elif isinstance(physics, Plant):
        zeros = (torch.zeros(n).double() for n in (layout.n_x, layout.n_u, layout.n_d))
        cost = None if physics.output_cost(*zeros) is None else physics.output_cost
    fitted = None if start is None or start.still is not None else start.cost
    if cost is None and fitted is not None and not fitted.shifted:
        cost = _stage_cost(fitted.best)
    if cost is None:
        cost = _fitted(data, layout, cfg.task.hessian == "diagonal")
    held = () if start is None else start.outputs_held
    return ensemble(data, layout, cost, physics.lb_a, physics.ub_a, held)


def check_ensemble(cfg: DictConfig, physics: AnyPlant, start: Start | None) -> None:
    """Raise `QPError` unless a run has the transitions that an `ensemble` needs.

    It needs them at the first comparison of ``gate=model``: twice the coefficients of each member,
    and the steps that its blocks lose.
    """
    layout = plant_layout(physics, 1)
    coefficients = layout.past * layout.n + layout.n_d + 1
    needed = 2 * 2 * (coefficients + BLOCKS * layout.past)
    first = min(cfg.gate_interval or cfg.eval_interval, cfg.updates)
    batches = warm_up_batches(cfg) + first
    collected = min(batches * cfg.steps_per_update * cfg.num_envs, cfg.replay_capacity)
    total = collected + (0 if start is None else start.log["action"].shape[:-1].numel())
    if total < needed:
        got = f"'model' with {total} transitions before the first comparison"
        remedy = "Raise gate_interval, warmup_steps or, with start=data, start.transitions."
        raise QPError.expected("gate", got, f"at least {needed}", remedy)


def _fitted(data: Any, layout: Layout, diagonal: bool = False) -> StageCost:
    return _stage_cost(fit_rewards(data, layout, diagonal).now)


def _stage_cost(fitted: FittedCost) -> StageCost:
    return lambda y, u, d: fitted(torch.cat((d, y, u.to(y)), -1))
