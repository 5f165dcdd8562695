"""One-step prediction errors of a QP: those of a model read from it, and its own."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_qpmpc.analysis.structure import Model
from torch_qpmpc.checks import check_kind, check_tensor
from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.module import QPMPC


def second_moment(s: Tensor, a: Tensor) -> Tensor:
    """Return E[v v'] ``(n_v, n_v)`` of v = (s, a, 1) over samples ``(*batch, n)``.

    Raises:
        QPError: if s and a differ in their numbers of samples, or have none.
    """
    check_tensor("s", s, "n_x")
    check_tensor("a", a, "n_u")
    if s.shape[:-1] != a.shape[:-1] or not s.shape[:-1].numel():
        got = f"shapes {tuple(s.shape)} and {tuple(a.shape)}"
        raise QPError.expected("s, a", got, "the same number of samples, at least one")
    v = torch.cat((s, a, torch.ones_like(a[..., :1])), dim=-1)
    v = v.reshape(-1, v.shape[-1])
    return v.mT @ v / len(v)


def one_step_error(
    model: Model, A: Tensor, B: Tensor, offset: Tensor | None = None, moment: Tensor | None = None
) -> Tensor:
    """Return the root mean square of the model's error in s+ over a distribution of (s, a).

    Args:
        model: the model, with tensors ``(*batch, ..)``, such as one per stage.
        A, B: the true model, ``(n_x, n_x)`` and ``(n_x, n_u)``.
        offset: the true offset, the mean of the noise, ``(n_x,)``; zero by default.
        moment: `second_moment` of the distribution; by default independent entries with mean 0 and
            variance 1, for which the error is the Frobenius norm of the difference.

    Returns:
        ``(*batch,)``.

    Raises:
        QPError: if ``model`` is not a `Model`, or a shape does not fit.
    """
    check_kind("model", model, Model, "Pass nearest_model(form), or stage_models(form).")
    n_x, n_u = model.B.shape[-2:]
    A, B, offset = _checked(A, B, offset, n_x, n_u, model.A)
    if moment is not None:
        n = n_x + n_u + 1
        check_tensor("moment", moment, n, n, batched=False, remedy="Pass second_moment(s, a).")
    true = torch.cat((A, B, offset.unsqueeze(-1)), dim=-1)
    error = torch.cat((model.A, model.B, model.offset.unsqueeze(-1)), dim=-1) - true
    moment = torch.eye(error.shape[-1]).to(error) if moment is None else moment.to(error)
    return ((error @ moment) * error).sum((-1, -2)).clamp(min=0).sqrt()


@torch.no_grad()
def first_state_error(
    mpc: QPMPC, s: Tensor, A: Tensor, B: Tensor, offset: Tensor | None = None
) -> Tensor:
    """Return the root mean square over s of x_1 - (A s + B pi(s) + offset), the QP's own error.

    Args:
        mpc: the QP; its x_1 may also depend on later actions.
        s: ``(*batch, n_x)``; states where the QP is not solved are left out.
        A, B, offset: the true model, as for `one_step_error`.

    Raises:
        QPError: if a shape does not fit.
    """
    check_kind("mpc", mpc, QPMPC)
    A, B, offset = _checked(A, B, offset, mpc.n_x, mpc.n_u, mpc.C)
    solution = mpc.solve(s)
    states, actions = mpc.predicted(solution.z)
    truth = states[..., 0, :] @ A.mT + actions[..., 0, :] @ B.mT + offset
    return (states[..., 1, :] - truth)[solution.solved].square().sum(-1).mean().sqrt()


def _checked(
    A: Tensor, B: Tensor, offset: Tensor | None, n_x: int, n_u: int, like: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the true model on the device and in the dtype of ``like``; check its shapes."""
    offset = like.new_zeros(n_x) if offset is None else offset
    check_tensor("A", A, n_x, n_x, batched=False)
    check_tensor("B", B, n_x, n_u, batched=False)
    check_tensor("offset", offset, n_x, batched=False)
    return A.to(like), B.to(like), offset.to(like)
