"""How well a QP predicts its plant: by a model that has been read from it, or by itself."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_qpmpc.mpc import QPMPC
from torch_qpmpc.structure import Model


def second_moment(s: Tensor, a: Tensor) -> Tensor:
    """E[v v'] of v = (s, a, 1) from samples ``(*batch, n)``: ``(n_v, n_v)``."""
    v = torch.cat((s, a, torch.ones_like(a[..., :1])), dim=-1).flatten(0, -2)
    return v.mT @ v / len(v)


def one_step_error(
    model: Model, A: Tensor, B: Tensor, offset: Tensor | None = None, moment: Tensor | None = None
) -> Tensor:
    """Root mean square of the model's error in s+, over a distribution of (s, a).

    Args:
        model: with tensors ``(*batch, ..)``, such as one per stage.
        A, B: the true ones, ``(n_x, n_x)`` and ``(n_x, n_u)``.
        offset: the true one, the mean of the noise, ``(n_x,)``; zero by default.
        moment: `second_moment` of the distribution; by default that of independent entries with
            mean 0 and variance 1, where the error is the Frobenius norm of the difference.

    Returns:
        ``(*batch,)``.
    """
    offset = A.new_zeros(len(A)) if offset is None else offset
    truth = torch.cat((A, B, offset.unsqueeze(-1)), dim=-1)
    error = torch.cat((model.A, model.B, model.offset.unsqueeze(-1)), dim=-1) - truth
    moment = torch.eye(error.shape[-1]).to(error) if moment is None else moment.to(error)
    return ((error @ moment) * error).sum((-1, -2)).clamp(min=0).sqrt()


@torch.no_grad()
def first_state_error(
    mpc: QPMPC, s: Tensor, A: Tensor, B: Tensor, offset: Tensor | None = None
) -> Tensor:
    """Root mean square over s of ``x_1 - (A s + B pi(s) + offset)``: what the policy expects next.

    Args:
        mpc: the QP, whose x_1 may also depend on later actions.
        s: ``(*batch, n_x)``; states where the QP is not solved are left out.
        A, B, offset: the true ones, as for `one_step_error`.
    """
    solution = mpc.solve(s)
    states, actions = mpc.predicted(solution.z)
    truth = states[..., 0, :] @ A.mT + actions[..., 0, :] @ B.mT
    truth = truth if offset is None else truth + offset
    return (states[..., 1, :] - truth)[solution.solved].square().sum(-1).mean().sqrt()
