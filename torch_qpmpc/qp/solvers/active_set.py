"""Active-set Newton steps for a whole batch: the end of the interior point.

With the rows' states held (see `crossover`), the KKT conditions of the condensed QP (eq:qp2,
eq:qp3) are linear. The method of multipliers solves them: a large curvature holds the active rows
at their bounds, and its error falls by orders of magnitude a pass, so one Cholesky factor of d x d
and no pivoting suffices, dependent active rows included.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torch_qpmpc.qp.solution import row_states
from torch_qpmpc.qp.solvers.batched import BatchedQPs

#: Relative residual of an answer that needs no further step.
SETTLED = 1e-9
#: Of the method of multipliers, a Newton step.
PASSES = 3


@dataclass
class Found:
    """The best v ``(B, d)`` and lam ``(B, r)`` so far, their residuals and steps, ``(B,)``."""

    v: Tensor
    lam: Tensor
    residual: Tensor
    steps: Tensor

    @classmethod
    def nothing(cls, qps: BatchedQPs) -> Found:
        """Zeros, and what any answer betters."""
        residual = torch.full_like(qps.cost, torch.inf)
        steps = torch.zeros_like(qps.cost, dtype=torch.int64)
        return cls(torch.zeros_like(qps.g), torch.zeros_like(qps.w), residual, steps)

    def offer(self, index: Tensor, v: Tensor, lam: Tensor, residual: Tensor) -> None:
        """Take the answers for ``index`` where they lower the residual."""
        better = residual < self.residual[index]
        chosen = index[better]
        self.v[chosen], self.lam[chosen] = v[better], lam[better]
        self.residual[chosen] = residual[better]


def settle(qps: BatchedQPs, v: Tensor, lam: Tensor, max_steps: int) -> Found:
    """Newton steps from v and lam, at least one, for each QP until it is solved as if exactly."""
    todo = torch.arange(len(qps), device=v.device)
    found = Found(v.clone(), lam.clone(), qps.residual(v, lam), torch.zeros_like(todo))
    for _ in range(max_steps):
        v, lam = _step(qps, v, lam)
        residual = qps.residual(v, lam)
        found.offer(todo, v, lam, residual)
        found.steps[todo] += 1
        going = ~(residual <= SETTLED)
        if not going.any():
            break
        if not going.all():
            qps, todo, v, lam = qps.take(going), todo[going], v[going], lam[going]
    return found


def _step(qps: BatchedQPs, v: Tensor, lam: Tensor) -> tuple[Tensor, Tensor]:
    """v and lam with the active rows at their bounds, and lam as held elsewhere."""
    y, stiffness = qps.rows(v), qps.force / qps.width
    nearest, active, held = row_states(y + lam / stiffness, qps.lower, qps.upper, qps.w / stiffness)
    lam = torch.where(active, lam, held * stiffness)
    weight = active * qps.penalty
    factor = qps.factor(weight)
    for _ in range(PASSES):
        short = nearest - y
        right = qps.pull(weight * short - lam) - qps.bend(v) - qps.g
        dv = torch.cholesky_solve(right.unsqueeze(-1), factor).squeeze(-1)
        dy = qps.rows(dv)
        v, y, lam = v + dv, y + dy, lam + weight * (dy - short)
    return v, lam
