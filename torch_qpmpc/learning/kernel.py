"""The gradients of a batch in each learned part, and the kernel that they make with a metric.

With g_i = dQ(s_i, a_i)/dtheta and a metric D on theta, the step that minimises

    1/2 sum_i (delta_i - g_i'dtheta)^2 + 1/2 mu dtheta'D^-1 dtheta

is ``dtheta = D sum_i alpha_i g_i``, ``(K + mu I) alpha = delta``, ``K_ij = g_i'D g_j``, a system of
the batch's size. mu is a fraction of the mean of K's diagonal. In a batch of more pairs than theta
has entries, alpha follows from the smaller system of theta's size.

The gradients in a free C are the outer products chi_i z_i', so that ``K = (chi chi') * (z P z')``
is computed without forming them. P is the metric of C's rows: D's or, with the SI penalty
(eq:sdp3), which is quadratic in each row, the inverse of the summed curvatures of damping and
penalty. The penalty thus enters the same step.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from torch_qpmpc.errors import QPError


class Dense:
    """The gradients in one parameter as rows ``(B, n)``, with the metric ``scale * units``.

    Without ``units`` ``(n,)`` they are ones.
    """

    def __init__(
        self, leaf: nn.Parameter, group: dict[str, Any], rows: Tensor, units: Tensor | None
    ) -> None:
        self.leaf, self.group, self.rows, self.scale = leaf, group, rows, 1.0
        self.units = torch.ones_like(leaf).flatten() if units is None else units

    def __len__(self) -> int:
        return len(self.rows)

    def remember(self, state: dict[str, Tensor], count: int) -> None:
        """Append the remembered gradients, and remember the newest ``count`` for the next step."""
        if count:
            self.rows = torch.cat((self.rows, _past(state, "rows", self.rows)))
            state["rows"] = self.rows[:count]

    def insert(self, rows: Tensor, place: int) -> None:
        """Insert further rows, which are not remembered."""
        self.rows = torch.cat((self.rows[:place], rows, self.rows[place:]))

    def width(self) -> float:
        """Return n, or infinity with a penalty."""
        return self.rows.shape[1]

    def features(self) -> Tensor:
        """Return Phi ``(B, n)`` of the kernel Phi Phi', without a penalty."""
        return self.rows * (self.scale * self.units).sqrt()

    def diagonal(self) -> Tensor:
        """Return the kernel's diagonal without a penalty, ``(B,)``."""
        return self.scale * self.rows.square() @ self.units

    def damp(self, mu: Tensor) -> Tensor:
        """Set the damping; return the change of Q ``(B,)`` by the penalty alone, here zero."""
        return self.rows.new_zeros(len(self.rows))

    def kernel(self) -> Tensor:
        """Return the kernel ``(B, B)``."""
        return self.scale * (self.rows * self.units) @ self.rows.mT

    def step(self, alpha: Tensor) -> Tensor:
        """Return the parameter's step for the dual solution ``alpha`` ``(B,)``."""
        return (self.scale * self.units * (alpha @ self.rows)).reshape(self.leaf.shape)

    def penalty(self) -> Tensor | float:
        """Return the penalty of the parameter, here none."""
        return 0.0


class OuterProducts:
    """The gradients ``chi_i z_i'`` in C, with the metric ``scale * rows_i / columns_j``.

    The penalty ``1/2 tr([C, b] S [C, b]')`` by itself moves C by ``drift``; with it, the metric of
    a row is ``rows_i`` times a matrix P ``(n_z, n_z)``, one for each unit of a row. With a ``mask``
    of the learned entries of C, each pattern of learned entries in a row has its own P.
    Methods as in `Dense`.
    """

    def __init__(
        self,
        leaf: nn.Parameter,
        group: dict[str, Any],
        chi: Tensor,
        z: Tensor,
        rows: Tensor,
        columns: Tensor,
        S: Tensor | None,
        b: Tensor,
        mask: Tensor | None,
    ) -> None:
        self.leaf, self.group, self.chi, self.z, self.scale = leaf, group, chi, z, 1.0
        self.rows, self.columns, self.S, self.b = rows, columns, S, b.unsqueeze(-1)
        self.drift = torch.zeros_like(leaf)
        self.patterns = _patterns(mask, None if S is None else rows.unsqueeze(-1))

    def __len__(self) -> int:
        return len(self.z)

    def remember(self, state: dict[str, Tensor], count: int) -> None:
        if count:
            self.chi = torch.cat((self.chi, _past(state, "chi", self.chi)))
            self.z = torch.cat((self.z, _past(state, "z", self.z)))
            state["chi"], state["z"] = self.chi[:count], self.z[:count]

    def width(self) -> float:
        return self.leaf.numel() if self.S is None else math.inf

    def features(self) -> Tensor:
        chi, z = self.chi * self.rows.sqrt(), self.z * (self.scale / self.columns).sqrt()
        parts = (torch.einsum("bi,bj->bij", chi[:, i], z[:, j]) for i, j, _ in self.patterns)
        return torch.cat([chi[:, :0], *(part.flatten(1) for part in parts)], -1)

    def diagonal(self) -> Tensor:
        chi, z = self.rows * self.chi.square(), self.z.square() / self.columns
        diagonals = (chi[:, i].sum(-1) * z[:, j].sum(-1) for i, j, _ in self.patterns)
        return self.scale * sum(diagonals, torch.zeros_like(z[:, 0]))

    def damp(self, mu: Tensor) -> Tensor:
        drifted = self.z.new_zeros(len(self.z))
        self.z_P = [self.scale * self.z[:, j] / self.columns[j] for _, j, _ in self.patterns]
        if self.S is None:
            return drifted
        force, S = (torch.cat((self.leaf, self.b), -1) @ self.S)[:, :-1], self.S[:-1, :-1]
        for k, (i, j, entries) in enumerate(self.patterns):
            z, damping = self.z[:, j], mu / self.rows[i][0]
            precision = torch.diag(damping / self.scale * self.columns[j]) + S[j][:, j]
            inverse = torch.linalg.inv_ex(precision).inverse
            drift = -force[entries] @ inverse
            self.z_P[k], self.drift[entries] = damping * z @ inverse, drift
            drifted = drifted + ((self.chi[:, i] @ drift) * z).sum(-1)
        return drifted

    def kernel(self) -> Tensor:
        K = self.z.new_zeros(len(self.z), len(self.z))
        chi = self.rows * self.chi
        for (i, j, _), z_P in zip(self.patterns, self.z_P, strict=True):
            K = K + (chi[:, i] @ self.chi[:, i].mT) * (z_P @ self.z[:, j].mT)
        return K

    def step(self, alpha: Tensor) -> Tensor:
        step, chi = self.drift.clone(), alpha.unsqueeze(-1) * self.rows * self.chi
        for (i, _, entries), z_P in zip(self.patterns, self.z_P, strict=True):
            step[entries] += chi[:, i].mT @ z_P
        return step

    def penalty(self) -> Tensor | float:
        if self.S is None:
            return 0.0
        D = torch.cat((self.leaf, self.b), -1)
        return 0.5 * (D * (D @ self.S)).sum()


#: The gradients in one parameter.
Block = Dense | OuterProducts


def _past(state: dict[str, Tensor], name: str, current: Tensor) -> Tensor:
    """Return the remembered rows for ``current`` ``(B, n)``, ``(M, n)``; empty at first."""
    past = state.get(name, current[:0])
    if past.shape[1:] != current.shape[1:]:
        got = f"a memory of gradients with {past.shape[1]} entries"
        want = f"{current.shape[1]}, as in this QPMPC"
        remedy = "Load the state of a GaussNewton of the same QPMPC."
        raise QPError.expected("state_dict", got, want, remedy)
    return past


def _patterns(mask: Tensor | None, kinds: Tensor | None) -> list[tuple[Any, Any, Any]]:
    """Group the rows of C by learned entries and by ``kinds`` ``(n_c, 1)``, if these are not None.

    Return the rows, the columns, and the index in C of each group.
    """
    keys = [key for key in (mask, kinds) if key is not None]
    if not keys:
        return [(slice(None), slice(None), (slice(None), slice(None)))]
    kind = torch.unique(torch.cat(keys, dim=-1), dim=0, return_inverse=True)[1]
    groups: list[tuple[Any, Any, Any]] = []
    for k in kind.unique():
        i = (kind == k).nonzero()[:, 0]
        if mask is None:
            groups.append((i, slice(None), (i, slice(None))))
        elif len(j := mask[i[0]].nonzero()[:, 0]):
            groups.append((i, j, (i.unsqueeze(-1), j)))
    return groups


def damping_of(blocks: Sequence[Block], damping: float) -> Tensor:
    """Return mu, for a damping relative to the mean of K's diagonal."""
    mu = damping * sum((block.diagonal() for block in blocks), torch.zeros(())).mean()
    return mu.clamp(min=torch.finfo(mu.dtype).tiny)


def solve_dual(blocks: Sequence[Block], delta: Tensor, mu: Tensor) -> tuple[Tensor, Tensor]:
    """Solve the dual; return alpha ``(B,)`` and the step's predicted change of Q ``(B,)``."""
    drifted = sum((block.damp(mu) for block in blocks), torch.zeros_like(delta))
    if 0 < sum(block.width() for block in blocks) < len(delta):
        features = torch.cat([block.features() for block in blocks], -1)
        change = features @ _solve(features.mT @ features, features.mT @ delta, mu)
        return (delta - change) / mu, change
    K = sum((block.kernel() for block in blocks), delta.new_zeros(len(delta), len(delta)))
    alpha = _solve(K, delta - drifted, mu)
    return alpha, K @ alpha + drifted


def _solve(matrix: Tensor, right: Tensor, mu: Tensor) -> Tensor:
    """Return ``(matrix + mu I)^-1 right`` ``(n,)``, or nan if there is no Cholesky factor."""
    factor, failed = torch.linalg.cholesky_ex(matrix + mu * torch.eye(len(right)).to(right))
    x = torch.cholesky_solve(right.unsqueeze(-1), factor).squeeze(-1)
    return torch.where(failed == 0, x, math.nan)


def objective(errors: Tensor, blocks: Sequence[Block]) -> Tensor:
    """Return what a step minimises: half the sum of squared errors, plus the penalty."""
    return 0.5 * errors.square().sum() + sum(block.penalty() for block in blocks)
