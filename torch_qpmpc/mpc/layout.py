"""The order of the stages in z and in the rows of G, their ties, and the discounted cost (eq:qpH).

The rows of G are one for each entry of z, then those of D on (x_k, u_k) for each stage, then those
of D^f on x_N (eq:v1c4).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor


@dataclass(frozen=True)
class Layout:
    """The sizes N, n_x and n_u, and the numbers of rows of D and D^f."""

    n_x: int
    n_u: int
    horizon: int
    n_d: int = 0
    n_d_f: int = 0

    @property
    def n(self) -> int:
        """Entries of a stage, n_x + n_u."""
        return self.n_x + self.n_u

    @property
    def n_z(self) -> int:
        """Entries of z, N (n_x + n_u) + n_x."""
        return self.horizon * self.n + self.n_x

    @property
    def n_linear(self) -> int:
        """Rows of G other than bounds."""
        return self.horizon * self.n_d + self.n_d_f

    def entries(self, x: Tensor, u: Tensor) -> Tensor:
        """Arrange x ``(N + 1, n_x)`` and u ``(N + 1, n_u)`` as z ``(n_z,)``, without u_N."""
        x, u = (part.expand(self.horizon + 1, -1) for part in (x, u))
        return torch.cat((x, u), dim=-1).flatten()[: self.n_z]

    def rows(self, x: Tensor, u: Tensor, d: Tensor, d_f: Tensor) -> Tensor:
        """Arrange values of x, u, D ``(N, n_d)`` and D^f ``(n_d_f,)`` as rows of G ``(n_g,)``."""
        return torch.cat((self.entries(x, u), d.expand(self.horizon, -1).flatten(), d_f))

    def discounts(self, gamma: float) -> tuple[Tensor, Tensor]:
        """Return gamma^k for the entries of z ``(n_z,)`` and for the rows of G ``(n_g,)``."""
        powers = gamma ** torch.arange(self.horizon + 1, dtype=torch.float64).unsqueeze(-1)
        x, u = powers.expand(-1, self.n_x), powers.expand(-1, self.n_u)
        d, d_f = powers[:-1].expand(-1, self.n_d), powers[-1].expand(self.n_d_f)
        return self.entries(x, u), self.rows(x, u, d, d_f)

    def ties(self, part: str) -> Tensor:
        """Return the index of the value of each entry of a tied q, b, lb, ub or w.

        x_N has values of its own in q and w, as w^f in eq:v1c0, but not in lb and ub.
        """
        n_x, n = self.n_x, self.n
        x, u = torch.arange(n_x), torch.arange(n_x, n)
        if part == "b":
            return x.repeat(self.horizon)
        if part in ("q", "w"):
            x, n = torch.stack((*[x] * self.horizon, n + x)), n + n_x
        if part == "q":
            return self.entries(x, u)
        d, d_f = torch.arange(self.n_d), torch.arange(self.n_d_f)
        return self.rows(x, u, n + d, n + self.n_d + d_f)

    def predicted(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Return the states ``(*batch, N + 1, n_x)`` and actions ``(*batch, N, n_u)`` of z."""
        stages = z[..., : self.horizon * self.n].unflatten(-1, (self.horizon, self.n))
        terminal = z[..., None, self.horizon * self.n :]
        return torch.cat((stages[..., : self.n_x], terminal), -2), stages[..., self.n_x :]

    def hessian(
        self, kind: str, blocks: tuple[Tensor, ...], discount: Tensor, stages: Tensor
    ) -> Tensor:
        """Return H ``(n_z, n_z)`` (eq:qpH) from those of the stages and of x_N, or from a full H.

        ``stages`` is ``ties("q")``, for a diagonal H that all stages share.
        """
        H = blocks[0]
        if kind == "diagonal":
            entries = torch.cat((H.flatten(), blocks[1]))
            if H.ndim == 1:  # faster than expand
                entries = entries.index_select(0, stages)
            return torch.diag_embed(discount * entries)
        if kind == "block":
            H = torch.block_diag(*H.expand(self.horizon, self.n, self.n), blocks[1])
        root = discount.sqrt()
        return root.unsqueeze(-1) * H * root


class Discounts(NamedTuple):
    """The discount factors of theta's cost.

    ``z`` ``(n_z,)`` and ``rows`` ``(n_g,)`` are gamma^k, or one. ``hardness`` ``(n_g,)`` is added
    to w: inf for a hard row, whose w is a placeholder, and zero otherwise. ``stages`` is
    ``ties("q")`` of `Layout`.
    """

    z: Tensor
    rows: Tensor
    hardness: Tensor
    stages: Tensor


def discounted(
    layout: Layout,
    kind: str,
    blocks: tuple[Tensor, ...],
    q: Tensor,
    w: Tensor,
    discounts: Discounts,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return H ``(n_z, n_z)``, q ``(n_z,)`` and w ``(n_g,)`` of the QP.

    ``blocks`` are theta's H of the stages and of x_N, or a full one.
    """
    H = layout.hessian(kind, blocks, discounts.z, discounts.stages)
    return H, discounts.z * q, torch.addcmul(discounts.hardness, discounts.rows, w)
