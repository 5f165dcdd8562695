"""The linear quadratic regulator (LQR) of a scheme's model and stage cost."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_qpmpc.checks import check_kind, check_number, check_tensor
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.mpc.riccati import riccati_weight
from torch_qpmpc.mpc.validation import check_weight


def lqr_gain(A: Tensor, B: Tensor, W: Tensor, gamma: float = 1.0) -> Tensor:
    """Return K ``(n_u, n_x)`` of the discounted linear quadratic regulator u = -K x.

    Args:
        A, B: the model, ``(n_x, n_x)`` and ``(n_x, n_u)``.
        W: weight of the stage cost ``1/2 [x; u]' W [x; u]``, ``(n_x + n_u, n_x + n_u)``.
        gamma: discount of the stage costs.

    Raises:
        QPError: if a shape does not fit, W is not positive semidefinite, or the Riccati equation
            has no stabilising solution.
    """
    check_tensor("A", A, "n_x", "n_x", batched=False)
    n_x = len(A)
    check_tensor("A", A, n_x, n_x, batched=False)
    check_tensor("B", B, n_x, "n_u", batched=False)
    n = n_x + B.shape[-1]
    check_tensor(
        "W", W, n, n, batched=False, remedy="Pass stage_weight(mpc), the weight of [x; u]."
    )
    check_number("gamma", gamma, lambda x: 0 < x <= 1, "a discount factor in (0, 1]")
    B, W = B.to(A), W.to(A)
    check_weight("W", W, diagonal=False, n_d=0)
    P = riccati_weight(A, B, W, gamma)
    left = W[n_x:, n_x:] + gamma * B.mT @ P @ B
    return torch.linalg.solve(left, gamma * B.mT @ P @ A + W[n_x:, :n_x])


def stage_weight(mpc: QPMPC) -> Tensor:
    """Return the weight of (x_0, u_0), ``(n_x + n_u, n_x + n_u)``: H's first block (eq:qpH)."""
    check_kind("mpc", mpc, QPMPC)
    stage = slice(mpc.n_p - mpc.n_x, mpc.n_p + mpc.n_u)
    return mpc.quadratic_program().H.detach()[stage, stage]
