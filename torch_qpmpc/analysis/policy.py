"""The policy in terms of control engineering: its gain near a state, and what it makes stable.

With a preview, the state s is all that V fixes, p ``(n_p,)``.
"""

import torch
from torch import Tensor

from torch_qpmpc.checks import check_kind, check_tensor
from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.mpc.validation import without_gradients


@without_gradients
def local_gain(mpc: QPMPC, s: Tensor) -> Tensor:
    """Return K = ``-d pi / d s`` for the active set at s: near s, u_0 = pi(s) - K ds.

    It is ``(*batch, n_u, n_p)`` for s ``(*batch, n_p)``, and zero where the QP is not solved.

    Raises:
        QPError: if the shape of s does not fit.
        SolverError: if a QP has no solution, and ``mpc.on_failure`` is ``"raise"``.
    """
    check_kind("mpc", mpc, QPMPC)
    s = check_tensor("s", s, mpc.n_p).detach().clone().requires_grad_()
    with torch.enable_grad():
        u = mpc.solve(s).z[..., mpc.n_p : mpc.n_p + mpc.n_u]
        # Each action depends on its own state alone, so the sum's gradient is each one's.
        sums = (x.sum() for x in u.unbind(-1))
        slopes = [torch.autograd.grad(x, s, retain_graph=True)[0] for x in sums]
    return -torch.stack(slopes, dim=-2)


def spectral_radius(A: Tensor, B: Tensor, K: Tensor) -> Tensor:
    """Return the largest eigenvalue modulus of A - B K, ``(*batch,)``; below 1 it is stable."""
    check_tensor("A", A, "n_x", "n_x")
    n_x = A.shape[-1]
    check_tensor("B", B, n_x, "n_u")
    check_tensor("K", K, B.shape[-1], n_x)
    closed = A - B.to(A) @ K.to(A)
    if not closed.isfinite().all():
        raise QPError.expected("A, B, K", "NaN or inf", "finite entries")
    return torch.linalg.eigvals(closed).abs().amax(-1)
