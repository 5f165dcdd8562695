"""Active-set Newton steps for a whole batch, the last phase of the interior-point method.

With fixed states of the rows (see `torch_qpmpc.qp.solution.row_states`), the KKT conditions of the
condensed QP (eq:qp2, eq:qp3) are linear. The method of multipliers solves them: a large curvature
holds the active rows at their bounds, and each pass reduces its error by orders of magnitude. One
d x d Cholesky factor without pivoting suffices, even for dependent active rows.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torch_qpmpc.qp.solution import row_states
from torch_qpmpc.qp.solvers.batched import BatchedQPs

#: A solution with this relative residual needs no further step.
SETTLED = 1e-9
#: Passes of the method of multipliers per Newton step.
PASSES = 3


@dataclass
class Best:
    """The best v ``(B, d)`` and lam ``(B, r)`` so far, their residuals and steps, ``(B,)``."""

    v: Tensor
    lam: Tensor
    residual: Tensor
    steps: Tensor

    @classmethod
    def initial(cls, qps: BatchedQPs) -> Best:
        """Return zeros with infinite residuals."""
        residual = torch.full_like(qps.cost, torch.inf)
        steps = torch.zeros_like(qps.cost, dtype=torch.int64)
        return cls(torch.zeros_like(qps.g), torch.zeros_like(qps.w), residual, steps)

    def update(self, index: Tensor, v: Tensor, lam: Tensor, residual: Tensor) -> None:
        """Take the solutions at ``index`` that lower the residual."""
        better = residual < self.residual[index]
        for best, new in ((self.v, v), (self.lam, lam), (self.residual, residual)):
            mask = better.unsqueeze(-1) if best.ndim > 1 else better
            best[index] = torch.where(mask, new, best[index])


def settle(qps: BatchedQPs, v: Tensor, lam: Tensor, max_steps: int) -> Best:
    """Take one or more Newton steps from v and lam, until the residual of each QP is `SETTLED`."""
    todo = torch.arange(len(qps), device=v.device)
    best = Best(v.clone(), lam.clone(), qps.residual(v, lam), torch.zeros_like(todo))
    for _ in range(max_steps):
        v, lam = _step(qps, v, lam)
        residual = qps.residual(v, lam)
        best.update(todo, v, lam, residual)
        best.steps[todo] += 1
        going = (~(residual <= SETTLED)).nonzero().squeeze(-1)
        if not len(going):
            break
        if len(going) < len(todo):
            qps, todo, v, lam = qps.take(going), todo[going], v[going], lam[going]
    return best


def _step(qps: BatchedQPs, v: Tensor, lam: Tensor) -> tuple[Tensor, Tensor]:
    """Return v and lam with active rows at their bounds, and fixed lam in the others."""
    y, stiffness = qps.rows(v), qps.force / qps.width
    nearest, active, multiplier = row_states(
        y + lam / stiffness, qps.lower, qps.upper, qps.w / stiffness
    )
    lam = torch.where(active, lam, multiplier * stiffness)
    weight = active * qps.penalty
    factor = qps.factor(weight)
    for _ in range(PASSES):
        short = nearest - y
        right = qps.pull(weight * short - lam) - qps.bend(v) - qps.g
        dv = torch.cholesky_solve(right.unsqueeze(-1), factor).squeeze(-1)
        dy = qps.rows(dv)
        v, y, lam = v + dv, y + dy, lam + weight * (dy - short)
    return v, lam
