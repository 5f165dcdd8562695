"""A QP without its last stage: V_{N-1} of the same theta.

The stage cost and rows of N - 1 are dropped, and the terminal cost and rows move from x_N to
x_{N-1}, with the discount of their new place. C keeps the predictions of x_1, .., x_{N-1}. The
constant c counts as the sum of N equal discounted stage costs, of which N - 1 remain. With a model
in C it is the QP of the same MPC scheme over N - 1 stages.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torch_qpmpc.mpc.layout import Layout
from torch_qpmpc.qp.program import QuadraticProgram


class Shortening(NamedTuple):
    """The entries that remain, as indices into z ``(n_z,)`` and the rows of C and G.

    Attributes:
        columns: the entries of z in C and in the rows of stages of G.
        values: the entries of z with the same costs; x_{N-1} and d_{N-1} have those of N.
        equations: rows of C.
        rows: rows of G; those of x_{N-1} are those of x_N.
        terminal: True at the rows of x_N and of D^f among ``rows``.
        known: the entries of p that remain known, all but d_N.
    """

    columns: Tensor
    values: Tensor
    equations: Tensor
    rows: Tensor
    terminal: Tensor
    known: Tensor

    @classmethod
    def of(cls, layout: Layout, device: torch.device) -> Shortening:
        """Return the entries that remain of a QP with N > 1."""
        N, n, n_x, n_d = layout.horizon, layout.n, layout.n_x, layout.n_d
        z = torch.arange(layout.n_z, device=device)
        d, past, plan = z.split((layout.n_preview, layout.n_before - layout.n_preview, N * n + n_x))
        kept = (N - 1) * n
        columns = torch.cat((d[: N * n_d], past, plan[: kept + n_x]))
        values = torch.cat((d[: (N - 1) * n_d], d[N * n_d :], past, plan[:kept], plan[N * n :]))
        counts = len(plan), N * layout.n_mixed, layout.n_terminal, N * layout.n_rates
        g = torch.arange(sum(counts), device=device).split(counts)
        mixed, rates = g[1][: (N - 1) * layout.n_mixed], g[3][: (N - 1) * layout.n_rates]
        rows = torch.cat((g[0][:kept], g[0][N * n :], mixed, g[2], rates))
        terminal = torch.isin(rows, torch.cat((g[0][N * n :], g[2])))
        equations = torch.arange((N - 1) * n_x, device=device)
        return cls(columns, values, equations, rows, terminal, columns[: layout.n_p - n_d])

    def program(
        self, qp: QuadraticProgram, horizon: int, gamma: float, discounted: bool
    ) -> QuadraticProgram:
        """Return ``qp``, of N stages, without the last; ``discounted`` if its w has discounts."""
        # Costs of N become those of N - 1, with one gamma less.
        growth = 1 / torch.where(self.values != self.columns, qp.H.new_tensor(gamma), 1.0)
        root = growth.sqrt()
        weight = 1 / torch.where(self.terminal & discounted, qp.w.new_tensor(gamma), 1.0)
        share = sum(gamma**k for k in range(horizon - 1))
        share = share / sum(gamma**k for k in range(horizon))
        of_row = torch.where(self.terminal.unsqueeze(-1), self.values, self.columns)
        return QuadraticProgram(
            H=root.unsqueeze(-1) * qp.H[..., self.values.unsqueeze(-1), self.values] * root,
            q=growth * qp.q[..., self.values],
            c=share * qp.c,
            C=qp.C[..., self.equations.unsqueeze(-1), self.columns],
            b=qp.b[..., self.equations],
            G=qp.G[..., self.rows.unsqueeze(-1), of_row],
            lb=qp.lb[..., self.rows],
            ub=qp.ub[..., self.rows],
            w=weight * qp.w[..., self.rows],
            check_values=False,
        )
