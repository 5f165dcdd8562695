"""The gradients of a batch in each learned part, and the kernel that they make with a metric.

With g_i = dQ(s_i, a_i)/dtheta by the envelope theorem and a metric D on theta, the step that
minimises

    1/2 sum_i (delta_i - g_i'dtheta)^2 + 1/2 mu dtheta'D^-1 dtheta

is ``dtheta = D sum_i alpha_i g_i``, ``(K + mu I) alpha = delta``, ``K_ij = g_i'D g_j``, a system of
the batch's size. mu is a fraction of the mean of K's diagonal.

The gradients in a free C are the outer products chi_i z_i', so that ``K = (chi chi') * (z P z')``
is computed without forming them. P is the metric of C's rows: D's or, with the SI penalty
(eq:sdp3), which is quadratic in each row, the inverse of the summed curvatures of damping and
penalty. The penalty thus enters the same step.

The metric has no free units. For each part p of theta

    D_p = scale_p U_p / size_p,    size_p <- max(mean_i g_ip'U_p g_ip, 0.9 size_p),

so that mu damps each part in relation to its own gradients. A part of the cost has a size of its
own; C, b, G, lb and ub share the sum of theirs, as they describe one model. Sizes rise at once, as
in MINPACK's scaling: otherwise a part would move the more freely, the less Q depends on it.
They fall slowly, so that the large gradients of a bad start do not damp a part for ever.

U is the identity except where C is free. With m_j the mean square of signal j, an entry of x, u
or d, over a batch and z's stages, with the same slow fall, U is m_i / m_j for the entry of C in a
row that predicts x's entry i and a column of signal j, and m_i for that row's entry of b: entries
are measured by the prediction's relative change. For q it is 1 / m_j. The step is then the same in
any unit of the cost and, for c, q, C and b, in any units of the signals. A signal has one m for all
stages, because a single entry of z may be nearly zero in a batch without being small.

Sizes and mean squares are entries of the optimiser's parameter groups, and so of its state.
"""

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.mpc.validation import COST

#: Smallest size of a part and smallest mean square of a signal, as a fraction of the largest.
FLOOR = 1e-12
#: Factor by which a size or a mean square can fall from one batch to the next.
FORGET = 0.9
#: The entries of a parameter group before the first batch.
FRESH = {"size": 0.0, "signals": None}


class Dense:
    """The gradients in one parameter as rows ``(B, n)``, with the metric ``scale * units``."""

    def __init__(
        self, leaf: nn.Parameter, group: dict[str, Any], rows: Tensor, units: Tensor | None
    ) -> None:
        self.leaf, self.group, self.rows, self.scale = leaf, group, rows, 1.0
        self.units = torch.ones_like(leaf).flatten() if units is None else units

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
    a row is ``rows_i`` times a matrix P ``(n_z, n_z)``, one for each group of rows of one unit.
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
    ) -> None:
        self.leaf, self.group, self.chi, self.z, self.scale = leaf, group, chi, z, 1.0
        self.rows, self.columns, self.S, self.b = rows, columns, S, b.unsqueeze(-1)
        self.drift = torch.zeros_like(leaf)
        self.groups: list[Any] = [slice(None)]
        if S is not None:
            self.groups = [(rows == unit).nonzero()[:, 0] for unit in rows.unique()]

    def diagonal(self) -> Tensor:
        chi, z = self.rows * self.chi.square(), self.z.square() / self.columns
        parts = [chi[:, i].sum(-1) * z.sum(-1) for i in self.groups]
        return self.scale * torch.stack(parts).sum(0)

    def damp(self, mu: Tensor) -> Tensor:
        drifted = self.z.new_zeros(len(self.z))
        self.z_P = [self.scale * self.z / self.columns for _ in self.groups]
        if self.S is None:
            return drifted
        force, S = (torch.cat((self.leaf, self.b), -1) @ self.S)[:, :-1], self.S[:-1, :-1]
        for k, i in enumerate(self.groups):
            damping = mu / self.rows[i][0]
            precision = torch.diag(damping / self.scale * self.columns) + S
            inverse = torch.linalg.inv_ex(precision).inverse
            self.z_P[k], self.drift[i] = damping * self.z @ inverse, -force[i] @ inverse
            drifted = drifted + ((self.chi[:, i] @ self.drift[i]) * self.z).sum(-1)
        return drifted

    def kernel(self) -> Tensor:
        K = self.z.new_zeros(len(self.z), len(self.z))
        chi = self.rows * self.chi
        for i, z_P in zip(self.groups, self.z_P, strict=True):
            K = K + (chi[:, i] @ self.chi[:, i].mT) * (z_P @ self.z.mT)
        return K

    def step(self, alpha: Tensor) -> Tensor:
        step, chi = self.drift.clone(), alpha.unsqueeze(-1) * self.rows * self.chi
        for i, z_P in zip(self.groups, self.z_P, strict=True):
            step[i] += chi[:, i].mT @ z_P
        return step

    def penalty(self) -> Tensor | float:
        if self.S is None:
            return 0.0
        D = torch.cat((self.leaf, self.b), -1)
        return 0.5 * (D * (D @ self.S)).sum()


#: The gradients in one parameter.
Block = Dense | OuterProducts


def signal_sizes(mpc: QPMPC, group: dict[str, Any], z: Tensor) -> tuple[Tensor, Tensor]:
    """Return m for the rows ``(n_c,)`` and the columns ``(n_z,)`` of C, updated with z.

    A signal that was always zero counts as one.
    """
    signals = mpc.layout.signals().to(z.device)
    count = signals.bincount()
    squares = torch.zeros_like(z[0, : len(count)]).index_add(0, signals, z.square().mean(0))
    m = squares / count
    if group["signals"] is not None:
        m = m.maximum(FORGET * m.new_tensor(group["signals"]))
    if m.isfinite().all():
        group["signals"] = m.tolist()
    m = torch.where(m > 0, m.clamp(min=FLOOR * m.max()), 1)
    return m[: mpc.n_x].repeat(mpc.horizon), m[signals]


def scale(blocks: Sequence[Block], count: int) -> None:
    """Update the parts' sizes with the gradients of ``count`` pairs, and scale the metric."""
    sizes = {block.group["name"]: 0.0 for block in blocks}
    for block in blocks:
        sizes[block.group["name"]] += float(block.diagonal().sum()) / count
    for block in blocks:
        group = block.group
        if math.isfinite(size := sizes[group["name"]]):
            group["size"] = max(FORGET * group["size"], size)
        sizes[group["name"]] = group["size"]
    model = sum(size for name, size in sizes.items() if name not in COST)
    least = FLOOR * max(sizes.values(), default=0.0)
    for block in blocks:
        name = block.group["name"]
        size = max(sizes[name] if name in COST else model, least)
        block.scale = block.group["scale"] / (size or 1.0)


def damping_of(blocks: Sequence[Block], damping: float) -> Tensor:
    """Return mu, for a damping relative to the mean of K's diagonal."""
    mu = damping * sum((block.diagonal() for block in blocks), torch.zeros(())).mean()
    return mu.clamp(min=torch.finfo(mu.dtype).tiny)


def solve_dual(blocks: Sequence[Block], delta: Tensor, mu: Tensor) -> tuple[Tensor, Tensor]:
    """Solve the dual; return alpha ``(B,)`` and the step's predicted change of Q ``(B,)``."""
    drifted = sum((block.damp(mu) for block in blocks), torch.zeros_like(delta))
    K = sum((block.kernel() for block in blocks), delta.new_zeros(len(delta), len(delta)))
    # NaN if there is no Cholesky factor.
    factor, failed = torch.linalg.cholesky_ex(K + mu * torch.eye(len(delta)).to(delta))
    alpha = torch.cholesky_solve((delta - drifted).unsqueeze(-1), factor).squeeze(-1)
    alpha = torch.where(failed == 0, alpha, math.nan)
    return alpha, K @ alpha + drifted


def objective(errors: Tensor, blocks: Sequence[Block]) -> Tensor:
    """Return what a step minimises: half the sum of squared errors, plus the penalty."""
    return 0.5 * errors.square().sum() + sum(block.penalty() for block in blocks)
