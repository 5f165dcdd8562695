"""Updates of theta from a batch of transitions, of first order (eq:thup) or of second order.

An update takes a batch and the windows of the SI penalty (None without it), moves theta, and
returns the terms of the loss and scalars that describe the batch, for logging. It is an optimiser's
step followed by `QPMPC.project_` (eq:sdp1) and the deviation penalty's proximal step (eq:sdp2). A
batch without a usable transition leaves theta and the optimiser's state unchanged.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torch_qpmpc.errors import QPError
from torch_qpmpc.learning.gauss_newton import GaussNewton
from torch_qpmpc.learning.penalties import DeviationPenalty, SystemIdentificationPenalty
from torch_qpmpc.learning.q_learning import QPQLearningLoss
from torch_qpmpc.learning.td_error import td_loss, td_metadata
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.mpc.parameters import matrix
from torch_qpmpc.mpc.validation import check_one_model

Scalars = Mapping[str, Tensor]
Update = Callable[[TensorDictBase, Tensor | None], tuple[dict[str, Tensor], Scalars]]


def first_order(
    mpc: QPMPC,
    loss_module: QPQLearningLoss,
    optimizer: torch.optim.Optimizer,
    deviation: DeviationPenalty | None,
    si: SystemIdentificationPenalty | None,
) -> Update:
    """Return an update by a torch optimiser on the gradient of the loss and the penalties.

    A loss or gradient that is not finite changes nothing either. Penalties that are None are off.

    Raises:
        QPError: the SI penalty is of one C for all states, and the QPMPC has dynamics.
    """
    if si is not None:
        check_one_model(mpc)

    def update(batch: TensorDictBase, windows: Tensor | None) -> tuple[dict[str, Tensor], Scalars]:
        losses = loss_module(batch)
        terms = {"loss/value": losses["loss_value"]}
        if si is not None and windows is not None:
            terms["loss/si"] = si(mpc.C, windows, mpc.b.detach())
        total = torch.stack([*terms.values()]).sum()
        moves = losses["unsolved"] + losses["invalid_reward"] < batch.numel() and total.isfinite()
        optimizer.zero_grad()
        if moves:
            total.backward()
            gradients = [x.grad for group in optimizer.param_groups for x in group["params"]]
            moves = all(gradient is None or gradient.isfinite().all() for gradient in gradients)
        if moves:
            optimizer.step()
            mpc.project_()
            if deviation is not None:
                deviation.proximal_step_(entries_of_C(mpc), share_of_rate(optimizer))
        terms["train/accepted"] = torch.tensor(float(moves))
        return terms, losses

    return update


def second_order(
    mpc: QPMPC,
    loss_module: QPQLearningLoss,
    optimizer: GaussNewton,
    deviation: DeviationPenalty | None,
    si: SystemIdentificationPenalty | None,
) -> Update:
    """Return an update by a `GaussNewton` step towards the loss module's targets.

    The SI penalty and the projection are part of that step; the deviation penalty's proximal step
    follows, even if that step is not accepted. Penalties that are None are off.

    Raises:
        QPError: the value network has other modules or ``theta_keys``: the step's curvature is that
            of the QP's own theta. Or the QPMPC has dynamics and an SI penalty.
    """
    if si is not None:
        check_one_model(mpc)
    network = loss_module.operator
    if loss_module.value_network is not network or network.theta_keys:
        remedy = "Learn with first_order and a torch optimiser."
        got = "a value network with theta_keys or upstream modules"
        raise QPError.expected("loss_module", got, "a QPActorValueOperator alone", remedy)

    def update(batch: TensorDictBase, windows: Tensor | None) -> tuple[dict[str, Tensor], Scalars]:
        target, terms, penalty = loss_module.target(batch).reshape(-1), {}, None
        if si is not None and windows is not None:
            penalty = si.curvature(windows)
            terms["loss/si"] = si(mpc.C, windows, mpc.b)
        key, pairs = network.active_set_key, batch.reshape(-1)
        start = None if key is None else pairs.get(key, None)
        p, a = network.known(pairs), pairs.get(network.in_keys[1])
        report = optimizer.step(p, a, -target, penalty=penalty, warm_start=start)
        if key is not None:
            batch.set(key, report.solution.active.view(*batch.shape, -1))
        prediction = -report.solution.value.to(target)
        losses = td_metadata(prediction, target)
        solved = prediction.isfinite() & target.isfinite()
        if deviation is not None and solved.any():
            deviation.proximal_step_(entries_of_C(mpc), share_of_rate(optimizer))
        elementwise = td_loss(prediction, target, loss_module.td_error_clip)
        terms["loss/value"] = elementwise[solved].sum() / solved.sum().clamp(min=1)
        terms["train/damping"] = torch.tensor(report.damping, dtype=torch.float64)
        terms["train/accepted"] = torch.tensor(float(report.accepted))
        return terms, losses

    return update


def entries_of_C(mpc: QPMPC) -> Tensor:
    """Return C, or its parameter if only some of its entries are learned."""
    parameter = matrix(mpc, "C")
    return mpc.C if parameter is None else parameter


def share_of_rate(optimizer: torch.optim.Optimizer) -> float:
    """Return C's learning rate over its initial one, 1 without a schedule: the penalty's scale."""
    group = next(group for group in optimizer.param_groups if group["name"] == "C")
    initial = group.get("initial_lr", 0.0)
    return group["lr"] / initial if initial else 1.0
