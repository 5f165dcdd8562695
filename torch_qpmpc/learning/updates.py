"""One update of theta from a batch of transitions: of the first order (eq:thup), or of the second.

An update takes a batch and the windows for the SI penalty (None without it), moves theta, and
returns what there is to log: the terms of the loss, and scalars that describe the batch. Each step
is an optimiser's proposal, then what the step rules make of it: `QPMPC.project_` (eq:sdp1), and the
deviation penalty's proximal step (eq:sdp2).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives import LossModule

from torch_qpmpc.learning.gauss_newton import GaussNewton
from torch_qpmpc.learning.penalties import DeviationPenalty, SystemIdentificationPenalty
from torch_qpmpc.learning.q_learning import QPQLearningLoss, invalid_rewards, td_loss, td_metadata
from torch_qpmpc.learning.restoring import restored
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.mpc.parameters import matrix

Scalars = Mapping[str, Tensor]
Update = Callable[[TensorDictBase, Tensor | None], tuple[dict[str, Tensor], Scalars]]


def first_order(
    mpc: QPMPC,
    loss_module: LossModule,
    optimizer: torch.optim.Optimizer,
    deviation: DeviationPenalty | None,
    si: SystemIdentificationPenalty | None,
    penalty_step: str = "proximal",
    actor_due: Callable[[], bool] = lambda: True,
) -> Update:
    """The gradient of the loss and of the penalties, for any torch optimiser.

    A batch whose loss or gradient is not finite moves nothing. Of such a loss, the transitions with
    an invalid reward are counted, with a `RuntimeWarning`, and the unsolved among the others.

    Args:
        loss_module: any of TorchRL's; its ``loss_*`` are summed.
        penalty_step: with ``"subgradient"`` the deviation penalty is one of the loss's terms.
        actor_due: whether this update is the actor's, too, which TD3 delays; else the critics'.
    """
    by_gradient, proximal = None, deviation
    if penalty_step == "subgradient":
        by_gradient, proximal = deviation, None

    def update(batch: TensorDictBase, windows: Tensor | None) -> tuple[dict[str, Tensor], Scalars]:
        with restored(loss_module):
            losses = loss_module(batch)
        terms = {name.replace("_", "/", 1): x for name, x in losses.items() if "loss_" in name}
        if si is not None and windows is not None:
            terms["loss/si"] = si(mpc.C, windows)
        if by_gradient is not None:
            terms["loss/deviation"] = by_gradient(mpc.C)
        due = actor_due()
        total = torch.stack([x for name, x in terms.items() if due or "value" in name]).sum()
        optimizer.zero_grad()
        if not total.isfinite():
            if losses.get("unsolved", None) is None:
                effect = "The batch moves nothing."
                keys: Any = loss_module.tensor_keys
                invalid = invalid_rewards(batch, keys.reward, effect).view(-1)
                error = losses["pred_value"] - losses["target_value"]
                # An ensemble has an error of each critic for a transition.
                lost = (~error.isfinite()).reshape(-1, len(batch)).any(0)
                losses["unsolved"] = (lost & ~invalid).sum()
                losses["invalid_reward"] = invalid.sum()
            return terms, losses
        total.backward()
        of_each = [x.grad for group in optimizer.param_groups for x in group["params"]]
        if not all(gradient is None or gradient.isfinite().all() for gradient in of_each):
            return terms, losses
        optimizer.step()
        if due:
            mpc.project_()
            if proximal is not None:
                proximal.proximal_step_(entries_of_C(mpc), share_of_rate(optimizer))
        return terms, losses

    return update


def second_order(
    mpc: QPMPC,
    loss_module: QPQLearningLoss,
    optimizer: GaussNewton,
    deviation: DeviationPenalty | None,
    si: SystemIdentificationPenalty | None,
) -> Update:
    """A Gauss-Newton step towards the loss module's targets, the SI penalty in the same step.

    The projection is part of it, too; the deviation penalty's proximal step follows.
    """
    network = loss_module.value_network
    observation, action = network.in_keys

    def update(batch: TensorDictBase, windows: Tensor | None) -> tuple[dict[str, Tensor], Scalars]:
        target, terms, penalty = loss_module.target(batch), {}, None
        if si is not None and windows is not None:
            penalty = si.curvature(windows)
            terms["loss/si"] = si(mpc.C, windows)
        start = None if network.active_set_key is None else batch.get(network.active_set_key, None)
        s, a = batch.get(observation), batch.get(action)
        report = optimizer.step(s, a, -target, penalty=penalty, warm_start=start)
        if deviation is not None:
            deviation.proximal_step_(entries_of_C(mpc), share_of_rate(optimizer))
        if network.active_set_key is not None:
            batch.set(network.active_set_key, report.solution.active)
        prediction = -report.solution.value.to(target)
        losses = td_metadata(prediction, target)
        solved = prediction.isfinite() & target.isfinite()
        of_each = td_loss(prediction, target, loss_module.td_error_clip)
        terms["loss/value"] = of_each[solved].sum() / solved.sum().clamp(min=1)
        terms["train/damping"] = torch.tensor(report.damping, dtype=torch.float64)
        terms["train/accepted"] = torch.tensor(float(report.accepted))
        return terms, losses

    return update


def entries_of_C(mpc: QPMPC) -> Tensor:
    """C, or its parameter where only some of its entries are learned."""
    parameter, _ = matrix(mpc, "C")
    return mpc.C if parameter is None else parameter


def share_of_rate(optimizer: torch.optim.Optimizer) -> float:
    """What a schedule has left of C's rate, which the penalty's weight follows: 1 without one."""
    group = next(group for group in optimizer.param_groups if group["name"] == "C")
    initial = group.get("initial_lr", 0.0)
    return group["lr"] / initial if initial else 1.0
