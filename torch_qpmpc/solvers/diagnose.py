"""Why a QP has no certified solution: infeasible, unbounded, or merely not converged.

Asked only about QPs that the chosen solver failed on. Two auxiliary problems answer it, each
feasible and bounded by construction, so that the answer does not rest on the failed solver's word.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torch_qpmpc.batching import largest
from torch_qpmpc.programs import SoftQPs, multiply
from torch_qpmpc.qp import Status
from torch_qpmpc.solvers.daqp import solve

#: Weight of the auxiliary objectives against the unit curvature that makes them strictly convex.
WEIGHT = 1e8
SIGNIFICANT = 1e-6
#: A direction of so little curvature, against H's largest, has none.
FLAT = 1e-9


def diagnose(qps: SoftQPs) -> Tensor:
    """`Status` of each QP, ``(B,)``, one of INFEASIBLE, UNBOUNDED and NOT_CONVERGED."""
    status = torch.full_like(qps.group, int(Status.NOT_CONVERGED))
    status[_falls_without_bound(qps)] = int(Status.UNBOUNDED)
    status[_hard_rows_conflict(qps)] = int(Status.INFEASIBLE)
    return status


def _hard_rows_conflict(qps: SoftQPs) -> Tensor:
    """Whether multipliers prove that no v satisfies the hard rows (Farkas' lemma).

    They come from minimising the rows' summed violation; with ``G'lam = 0`` the rows imply
    ``0 = lam'Gv <= u'max(lam, 0) - l'max(-lam, 0)``, which a negative right-hand side contradicts.
    """
    norms = torch.linalg.vector_norm(qps.G, dim=-1).clamp(min=1e-300)
    hard = qps.w.isinf()
    lower = torch.where(hard, qps.l / norms[qps.group], -torch.inf)
    upper = torch.where(hard, qps.u / norms[qps.group], torch.inf)
    d = qps.g.shape[1]
    relaxed = SoftQPs(
        H=torch.eye(d).to(qps.H).expand(len(qps.H), d, d),
        G=qps.G / norms.unsqueeze(-1),
        group=qps.group,
        g=torch.zeros_like(qps.g),
        l=lower,
        u=upper,
        w=WEIGHT * hard.to(qps.w),
    )
    nearest = solve(relaxed)
    y = multiply(relaxed.G, qps.group, nearest.v)
    violation = torch.maximum(lower - y, y - upper).clamp(min=0) / (1 + y.abs())
    lam = torch.where(hard, nearest.lam / WEIGHT, 0.0)
    pull = multiply(relaxed.G.mT, qps.group, lam)
    up, down = lam.clamp(min=0), (-lam).clamp(min=0)
    bound = up * torch.where(up > 0, upper, 0) - down * torch.where(down > 0, lower, 0)
    bound = bound.sum(-1)
    proof = (largest(pull) <= 1e-2 * -bound) & (bound < -SIGNIFICANT)
    # Rows that hold only far from v = 0 pull as hard as rows that never do, but they hold.
    return proof & (largest(violation) > SIGNIFICANT)


def _falls_without_bound(qps: SoftQPs) -> Tensor:
    """Whether a direction free of curvature and of hard bounds lowers the cost."""
    d = qps.g.shape[1]
    scale = largest(qps.g).clamp(min=1e-300).unsqueeze(-1)
    curvatures, basis = torch.linalg.eigh(qps.H)
    flat = curvatures.abs() <= FLAT * largest(curvatures).unsqueeze(-1)
    # A direction is N p: without its curved columns, N does not know what p is there.
    N = basis * flat.unsqueeze(-2)
    G = qps.G @ N
    unit = torch.eye(d).to(qps.H).expand(len(qps.H), d, d)
    box = torch.ones_like(qps.g)
    recession = SoftQPs(
        H=unit / WEIGHT,
        G=torch.cat((unit, G), dim=1),
        group=qps.group,
        g=multiply(N.mT, qps.group, qps.g) / scale,
        l=torch.cat((-box, torch.where(qps.l.isfinite(), 0.0, -torch.inf)), dim=1),
        u=torch.cat((box, torch.where(qps.u.isfinite(), 0.0, torch.inf)), dim=1),
        w=torch.cat((torch.inf * box, qps.w / scale), dim=1),
    )
    p = solve(recession).v
    # The slope far out: the linear cost, what soft rows charge, and no room for hard ones.
    y = multiply(G, qps.group, p)
    uphill = torch.maximum(
        torch.where(qps.u.isfinite(), y, 0), torch.where(qps.l.isfinite(), -y, 0)
    )
    charge = torch.where(qps.w.isfinite(), qps.w / scale, WEIGHT) * uphill.clamp(min=0)
    slope = (recession.g * p).sum(-1) + charge.sum(-1)
    return slope < -1e3 * SIGNIFICANT
