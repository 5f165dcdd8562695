"""The QP in full space, as for a general QP layer: x_0 (and u_0) substituted, sigma explicit."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torch_qpmpc import QuadraticProgram

#: ProxSuite's infinity.
INFINITE = 1e20


@dataclass(frozen=True)
class FullSpace:
    """min over x = (y, sigma): ``1/2 x'Qx + p'x`` s.t. ``A x = b``, ``l <= G x <= u``.

    y are the entries of z that are not fixed. The matrices are shared by the batch; p, b, l, u are
    ``(B, .)``. Every tensor is differentiable in those of the `QuadraticProgram`.
    """

    qp: QuadraticProgram
    fixed: Tensor
    Q: Tensor
    p: Tensor
    A: Tensor
    b: Tensor
    G: Tensor
    l: Tensor  # noqa: E741 - ProxSuite's name
    u: Tensor

    @classmethod
    def of(cls, qp: QuadraticProgram, fixed: Tensor) -> FullSpace:
        """Convert a QP with unbatched tensors whose first n_f rows of G do not involve y."""
        n, B = fixed.shape[-1], len(fixed)
        if (qp.G[:n, n:] != 0).any():
            raise ValueError("G: its first rows contain free entries of z, expected the identity's")
        soft = qp.w[n:].isfinite()
        n_y, n_s, n_h = qp.n_z - n, int(soft.sum()), int((~soft).sum())
        H, C, G_y = qp.H[n:, n:], qp.C[:, n:], qp.G[n:, n:]
        offset = fixed @ qp.G[n:, :n].mT
        lower, upper = qp.lb[n:] - offset, qp.ub[n:] - offset
        eye, zeros = torch.eye(n_s).to(H), H.new_zeros
        rows = (
            torch.cat((G_y[soft], -eye), dim=1),
            torch.cat((G_y[soft], eye), dim=1),
            torch.cat((zeros(n_s, n_y), eye), dim=1),
            torch.cat((G_y[~soft], zeros(n_h, n_s)), dim=1),
        )
        absent = H.new_full((B, n_s), INFINITE)
        return cls(
            qp,
            fixed,
            Q=torch.block_diag(H, zeros(n_s, n_s)),
            p=torch.cat((qp.q[n:] + fixed @ qp.H[:n, n:], qp.w[n:][soft].expand(B, -1)), dim=1),
            A=torch.cat((C, zeros(len(C), n_s)), dim=1),
            b=qp.b - fixed @ qp.C[:, :n].mT,
            G=torch.cat(rows),
            l=torch.cat((-absent, lower[:, soft], zeros(B, n_s), lower[:, ~soft]), dim=1),
            u=torch.cat((upper[:, soft], absent, absent, upper[:, ~soft]), dim=1),
        )

    def one_sided(self) -> tuple[Tensor, Tensor]:
        """Write the inequalities as ``G x <= h``: G ``(m, n)`` and h ``(B, m)``."""
        upper, lower = self.u[0] < INFINITE, self.l[0] > -INFINITE
        G = torch.cat((self.G[upper], -self.G[lower]))
        return G, torch.cat((self.u[:, upper], -self.l[:, lower]), dim=1)

    def value(self, x: Tensor) -> Tensor:
        """Compute the cost ``(B,)`` of a minimiser x ``(B, n)``, including the fixed entries'."""
        qp, n = self.qp, self.fixed.shape[-1]
        n_y = qp.n_z - n
        z, sigma = torch.cat((self.fixed, x[:, :n_y]), dim=1), x[:, n_y:]
        soft = qp.w.isfinite()
        cost = 0.5 * (z @ qp.H * z).sum(-1) + z @ qp.q + qp.c + sigma @ qp.w[n:][soft[n:]]
        y = z @ qp.G[:n].mT
        outside = torch.relu(qp.lb[:n] - y) + torch.relu(y - qp.ub[:n])
        return cost + outside[:, soft[:n]] @ qp.w[:n][soft[:n]]
