"""Updates of theta from a batch of transitions, of first order (eq:thup) or of second order.

An update takes a batch and the windows of the SI penalty (None without it), moves theta, and
returns the terms of the loss and scalars that describe the batch, for logging. It is an optimiser's
step followed by `QPMPC.project_` (eq:sdp1) and the deviation penalty's proximal step (eq:sdp2). A
batch without a usable transition leaves theta and the optimiser's state unchanged.
"""

from collections.abc import Callable, Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.optim import Optimizer

from torch_qpmpc.errors import QPError
from torch_qpmpc.learning.gauss_newton import GaussNewton
from torch_qpmpc.learning.penalties import Penalties
from torch_qpmpc.learning.q_learning import QPQLearningLoss
from torch_qpmpc.learning.td_error import td_loss, td_metadata
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.mpc.validation import check_one_model

Scalars = Mapping[str, Tensor]
Update = Callable[[TensorDictBase, Tensor | None], tuple[dict[str, Tensor], Scalars]]


def first_order(
    mpc: QPMPC, loss_module: QPQLearningLoss, optimizer: Optimizer, penalties: Penalties
) -> Update:
    """Return an update by a torch optimiser on the gradient of the loss and the penalties.

    A loss or gradient that is not finite changes nothing either.

    Raises:
        QPError: C is penalised, but the optimiser does not move it, or the QPMPC has dynamics.
    """
    pull = _proximal(mpc, optimizer, penalties)

    def update(batch: TensorDictBase, windows: Tensor | None) -> tuple[dict[str, Tensor], Scalars]:
        losses = loss_module(batch)
        terms = {"loss/value": losses["loss_value"]}
        if penalties.si is not None and windows is not None:
            terms["loss/si"] = penalties.si(mpc.C, windows, mpc.b.detach())
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
            pull()
        terms["train/accepted"] = torch.tensor(float(moves))
        return terms, losses

    return update


def second_order(
    mpc: QPMPC, loss_module: QPQLearningLoss, optimizer: GaussNewton, penalties: Penalties
) -> Update:
    """Return an update by a `GaussNewton` step on the loss module's loss.

    The SI penalty and the projection are part of that step; the deviation penalty's proximal step
    follows, even if that step is not accepted.

    Raises:
        QPError: as `first_order`; or the value network has other modules or ``theta_keys``: the
            step's curvature is that of the QP's own theta.
    """
    pull = _proximal(mpc, optimizer, penalties)
    network = loss_module.operator
    if loss_module.value_network is not network or network.theta_keys:
        remedy = "Learn with first_order and a torch optimiser."
        got = "a value network with theta_keys or upstream modules"
        raise QPError.expected("loss_module", got, "a QPActorValueOperator alone", remedy)

    def update(batch: TensorDictBase, windows: Tensor | None) -> tuple[dict[str, Tensor], Scalars]:
        target, terms, penalty = loss_module.target(batch).reshape(-1), {}, None
        if penalties.si is not None and windows is not None:
            penalty = penalties.si.curvature(windows)
            terms["loss/si"] = penalties.si(mpc.C, windows, mpc.b)
        key, pairs = network.active_set_key, batch.reshape(-1)
        start = None if key is None else pairs.get(key, None)
        p, a, clip = network.known(pairs), pairs.get(network.in_keys[1]), loss_module.td_error_clip
        own: Any = {"weights": loss_module.priority_weights(pairs), "warm_start": start}
        own |= {"clip": clip, "weighted": loss_module.weighted, "penalty": penalty}
        report = optimizer.step(p, a, -target, **own)
        if key is not None:
            batch.set(key, report.solution.active.view(*batch.shape, -1))
        prediction, use = -report.solution.value.to(target), report.usable
        if use.any():
            pull()
        elementwise = td_loss(prediction, target, clip)
        terms["loss/value"] = elementwise[use].sum() / use.sum().clamp(min=1)
        terms["train/damping"] = torch.tensor(report.damping, dtype=torch.float64)
        terms["train/accepted"] = torch.tensor(float(report.accepted))
        return terms, td_metadata(prediction, target, use)

    return update


def _proximal(mpc: QPMPC, optimizer: Optimizer, penalties: Penalties) -> Callable[[], None]:
    """Return the deviation penalty's proximal step; raise `QPError` if the penalties do not fit."""
    if penalties.si is not None:
        check_one_model(mpc)
    if (deviation := penalties.deviation) is None:
        return lambda: None
    rate_of_C(mpc, optimizer)
    return lambda: deviation.proximal_step_(*rate_of_C(mpc, optimizer))


def rate_of_C(mpc: QPMPC, optimizer: Optimizer) -> tuple[Tensor, float]:
    """Return C's parameter, and its learning rate over the initial one, 1 without a schedule.

    Raises:
        QPError: the optimiser does not move a C that is free.
    """
    free = mpc.structure == "free" and "C" in mpc.learned
    C = mpc.leaves("C")[0] if free else None
    groups = (x for x in optimizer.param_groups if any(C is leaf for leaf in x["params"]))
    if C is None or (group := next(groups, None)) is None:
        want = "one that moves a free C, which is penalised"
        raise QPError.expected("optimizer", "one that does not move C", want)
    initial = group.get("initial_lr", 0.0)
    return C, group["lr"] / initial if initial else 1.0
