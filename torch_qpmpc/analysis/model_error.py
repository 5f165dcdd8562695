"""One-step prediction errors of a QP: those of a model read from it, and its own."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torch_qpmpc.analysis.structure import NearestModel
from torch_qpmpc.checks import check_kind, check_tensor
from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.banded import banded_matrix
from torch_qpmpc.mpc.module import QPMPC


def second_moment(s: Tensor, a: Tensor, d: Tensor | None = None) -> Tensor:
    """Return E[v v'] ``(n_v, n_v)`` of v = (s, a, d, 1) over samples ``(*batch, n)``.

    Args:
        s, a: states and actions; with a window [x_k, .., x_{k+1-L}] and [u_k, .., u_{k+1-L}].
        d: the known signals d_k; None without a preview.

    Raises:
        QPError: if s, a and d differ in their numbers of samples, or have none.
    """
    check_tensor("s", s, "L n_x")
    check_tensor("a", a, "L n_u")
    d = a[..., :0] if d is None else check_tensor("d", d, "n_d")
    if not (s.shape[:-1] == a.shape[:-1] == d.shape[:-1] and s.shape[:-1].numel()):
        got = f"shapes {tuple(s.shape)}, {tuple(a.shape)} and {tuple(d.shape)}"
        raise QPError.expected("s, a, d", got, "the same number of samples, at least one")
    v = torch.cat((s, a, d, torch.ones_like(a[..., :1])), dim=-1)
    v = v.reshape(-1, v.shape[-1])
    return v.mT @ v / len(v)


def one_step_error(
    model: NearestModel,
    A: Tensor,
    B: Tensor,
    offset: Tensor | None = None,
    moment: Tensor | None = None,
    E: Tensor | None = None,
) -> Tensor:
    """Return the root mean square of the model's error in s+ over a distribution of (s, a).

    Args:
        model: the model, with tensors ``(*batch, ..)``, such as one per stage.
        A, B: the true model, ``(n_x, L n_x)`` and ``(n_x, L n_u)``, as in `NearestModel`.
        offset: the true offset, the mean of the noise, ``(n_x,)``; zero by default.
        moment: `second_moment` of the distribution; by default independent entries with mean 0 and
            variance 1, for which the error is the Frobenius norm of the difference.
        E: the true ``(n_x, n_d)``; zero by default.

    Returns:
        ``(*batch,)``.

    Raises:
        QPError: if ``model`` is not a `NearestModel`, or a shape does not fit.
    """
    check_kind("model", model, NearestModel, "Pass nearest_model(form), or stage_models(form).")
    own = (model.A, model.B, model.E, model.offset.unsqueeze(-1))
    sizes = [part.shape[-1] for part in own[:-1]]
    true = _checked(A, B, E, offset, model.A.shape[-2], sizes, model.A)
    error = torch.cat(own, dim=-1) - torch.cat((*true[:-1], true[-1].unsqueeze(-1)), dim=-1)
    n = error.shape[-1]
    if moment is not None:
        check_tensor("moment", moment, n, n, batched=False, remedy="Pass second_moment(s, a).")
    moment = torch.eye(n).to(error) if moment is None else moment.to(error)
    return ((error @ moment) * error).sum((-1, -2)).clamp(min=0).sqrt()


@torch.no_grad()
def first_state_error(
    mpc: QPMPC,
    s: Tensor,
    A: Tensor,
    B: Tensor,
    offset: Tensor | None = None,
    E: Tensor | None = None,
) -> Tensor:
    """Return the root mean square over s of x_1 - (A s + B pi(s) + offset), the QP's own error.

    Args:
        mpc: the QP; its x_1 may also depend on later actions.
        s: ``(*batch, n_p)``; states where the QP is not solved are left out.
        A, B, offset, E: the true model, as for `one_step_error`.

    Raises:
        QPError: if a shape does not fit.
    """
    check_kind("mpc", mpc, QPMPC)
    sizes = [mpc.past * mpc.n_x, mpc.past * mpc.n_u, mpc.n_d]
    A, B, E, offset = _checked(A, B, E, offset, mpc.n_x, sizes, mpc.C)
    solution = mpc.solve(s)
    z, end = solution.z, mpc.n_p + mpc.n_u
    # The model's one row block, on (d_0, d_1) and on the window up to u_0 and x_1.
    first, last = end - sizes[0] - sizes[1], end + mpc.n_x
    z = torch.cat((z[..., : 2 * mpc.n_d], z[..., first:last]), dim=-1)
    error = z @ banded_matrix(A, B, 1, E).mT + offset
    return error[solution.solved].square().sum(-1).mean().sqrt()


def _checked(
    A: Tensor,
    B: Tensor,
    E: Tensor | None,
    offset: Tensor | None,
    n_x: int,
    sizes: Sequence[int],
    like: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the true model on the device and in the dtype of ``like``; check its shapes.

    ``sizes`` are the columns of A, B and E.
    """
    offset = like.new_zeros(n_x) if offset is None else offset
    E = like.new_zeros(n_x, sizes[2]) if E is None else E
    for name, part, size in zip("ABE", (A, B, E), sizes, strict=True):
        check_tensor(name, part, n_x, size, batched=False)
    check_tensor("offset", offset, n_x, batched=False)
    return A.to(like), B.to(like), E.to(like), offset.to(like)
