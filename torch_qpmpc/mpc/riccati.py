"""The discounted linear quadratic regulator (LQR): its gain and its cost to go."""

from __future__ import annotations

from typing import TYPE_CHECKING

import scipy
import torch
from torch import Tensor

from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.layout import Layout
from torch_qpmpc.mpc.validation import without_gradients

if TYPE_CHECKING:
    from torch_qpmpc.mpc.module import QPMPC

RICCATI = "riccati"


@without_gradients
def lqr_gain(A: Tensor, B: Tensor, W: Tensor, gamma: float = 1.0) -> Tensor:
    """Return K ``(n_u, n_x)`` of the discounted linear quadratic regulator u = -K x.

    Args:
        A, B: the model, ``(n_x, n_x)`` and ``(n_x, n_u)``.
        W: weight of the stage cost ``1/2 [x; u]' W [x; u]``, ``(n_x + n_u, n_x + n_u)``.
        gamma: discount of the stage costs.
    """
    n_x, B, W = len(A), B.to(A), (W + W.mT).to(A) / 2
    P = riccati_weight(A, B, W, gamma)
    left = W[n_x:, n_x:] + gamma * B.mT @ P @ B
    return torch.linalg.solve(left, gamma * B.mT @ P @ A + W[n_x:, :n_x])


def stage_weight(mpc: QPMPC) -> Tensor:
    """Return the weight of (x_0, u_0), ``(n_x + n_u, n_x + n_u)``: H's first block (eq:qpH)."""
    stage = slice(mpc.n_p - mpc.n_x, mpc.n_p + mpc.n_u)
    return mpc.quadratic_program().H.detach()[stage, stage]


@without_gradients
def riccati_weight(A: Tensor, B: Tensor, W: Tensor, gamma: float = 1.0) -> Tensor:
    """Return P ``(n_x, n_x)`` of the discounted linear quadratic regulator's cost to go 1/2 x'Px.

    Without active bounds, an MPC scheme with H_f = P is that regulator, for any horizon. Arguments
    and errors are as in `lqr_gain`.
    """
    n_x, root, W = A.shape[-1], gamma**0.5, (W + W.mT) / 2  # SciPy allows W no rounding
    Q, S, R = W[:n_x, :n_x], W[:n_x, n_x:], W[n_x:, n_x:]
    try:
        parts = (x.detach().numpy() for x in (root * A, root * B, Q, R))
        P = scipy.linalg.solve_discrete_are(*parts, s=S.detach().numpy())
    except (ValueError, scipy.linalg.LinAlgError) as error:
        got = f"a Riccati equation without a solution ({error})"
        want = "a stabilisable model and a positive definite weight of the actions"
        remedy = "Give the actions some weight, or pass a matrix."
        raise QPError.expected("terminal_weight", got, want, remedy) from error
    return torch.as_tensor((P + P.T) / 2).to(A)


def affine_cost_to_go(
    A: Tensor, B: Tensor, offset: Tensor, W: Tensor, q: Tensor, P: Tensor, gamma: float = 1.0
) -> tuple[Tensor, Tensor]:
    """Return p ``(n_x,)`` and c of the regulator's cost to go ``1/2 x'Px + p'x + c``.

    The model is ``A x + B u + offset``, and the stage cost ``1/2 v'Wv + q'v`` of v = [x; u].
    Without active bounds, an MPC scheme with H_f = P and q_f = p is the optimal policy, for any
    horizon. Without a discount c has no finite value. P is the `riccati_weight` of A, B and W.
    """
    n_x, W = len(A), (W + W.mT) / 2
    # The regulator is u = -K x - k; an action without any cost has none.
    M = torch.linalg.pinv(W[n_x:, n_x:] + gamma * B.mT @ P @ B, hermitian=True)
    K = M @ (W[n_x:, :n_x] + gamma * B.mT @ P @ A)
    closed = gamma * (A - B @ K).mT
    rest = q[:n_x] - K.mT @ q[n_x:] + closed @ P @ offset
    p = torch.linalg.solve(torch.eye(n_x).to(A) - closed, rest)
    k = q[n_x:] + gamma * B.mT @ (P @ offset + p)
    c = gamma * (offset @ P @ offset / 2 + p @ offset) - k @ M @ k / 2
    return p, c / (1 - gamma)


def terminal_riccati(A: Tensor, B: Tensor, W: Tensor, gamma: float, layout: Layout) -> Tensor:
    """Return P for a scheme's model and stage weight, about the x of least stage cost for d.

    W is the stage weight, or its diagonal; with a preview, of [d; x; u] or of [x; u].
    """
    W, n_d = torch.diag(W) if W.shape == (layout.n,) else W, layout.n_d
    cross = W.new_zeros(layout.n_x, 0)
    if W.shape == (n_d + layout.n,) * 2:
        cross, W = W[n_d : n_d + layout.n_x, :n_d], W[n_d:, n_d:]
    sizes = {"A": (A, layout.n_x, layout.n_x), "B": (B, layout.n_x, layout.n_u)}
    for name, (matrix, *shape) in (sizes | {"stage_weight": (W, layout.n, layout.n)}).items():
        if list(matrix.shape) != shape:
            got, remedy = f"shape {tuple(matrix.shape)}", "The Riccati equation has one stage only."
            raise QPError.expected(name, got, f"shape {tuple(shape)}", remedy)
    P = riccati_weight(A, B, W, gamma)
    if not cross.any():
        return P
    # x - target, where the stage's cost of x is least for d.
    Q = W[: layout.n_x, : layout.n_x]
    error = torch.cat((torch.linalg.pinv(Q, hermitian=True) @ cross, torch.eye(len(P)).to(P)), -1)
    return error.mT @ P @ error
