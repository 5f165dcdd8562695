"""Why a QP has no certified solution: infeasible, unbounded, or merely not converged.

Asked only about QPs that every solver failed on. Two auxiliary problems answer it, each feasible
and bounded by construction, so that the answer does not rest on the failed solvers' words.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from torch_qpmpc.condense import SoftQPs
from torch_qpmpc.qp import Status
from torch_qpmpc.solvers.daqp import solve

#: Curvature that makes the auxiliary problems strictly convex, relative to their unit weights.
REGULARISATION = 1e-7
SIGNIFICANT = 1e-6


def diagnose(qps: SoftQPs) -> np.ndarray:
    """`Status` of each QP, ``(B,)``, one of INFEASIBLE, UNBOUNDED and NOT_CONVERGED."""
    status = np.full(len(qps.group), Status.NOT_CONVERGED, dtype=np.int64)
    status[_falls_without_bound(qps)] = Status.UNBOUNDED
    status[_hard_rows_conflict(qps)] = Status.INFEASIBLE
    return status


def _hard_rows_conflict(qps: SoftQPs) -> np.ndarray:
    """Whether min over v of the hard rows' summed violation is positive."""
    norm = np.maximum(np.linalg.norm(qps.G, axis=-1), 1e-300)
    G, norms = qps.G / norm[..., None], norm[qps.group]
    lower, upper = qps.l / norms, qps.u / norms
    d = qps.g.shape[1]
    relaxed = SoftQPs(
        H=np.broadcast_to(REGULARISATION * np.eye(d), qps.H.shape),
        G=G,
        group=qps.group,
        g=np.zeros_like(qps.g),
        l=lower,
        u=upper,
        w=np.where(np.isinf(qps.w), 1.0, 0.0),
    )
    y = np.einsum("brd,bd->br", G[qps.group], solve(relaxed).v)
    violation = np.maximum(np.maximum(lower - y, y - upper), 0) * np.isinf(qps.w)
    return (violation / (1 + np.abs(y))).sum(-1) > SIGNIFICANT


def _falls_without_bound(qps: SoftQPs) -> np.ndarray:
    """Whether a direction in the unit box, free of curvature and of hard bounds, lowers the cost."""
    d = qps.g.shape[1]
    scale = np.maximum(np.abs(qps.g).max(axis=-1, initial=0), 1e-300)
    curvature = np.maximum(np.abs(qps.H).max(axis=(1, 2), initial=0), 1e-300)[:, None, None]
    box = np.ones((len(qps.group), d))
    hard = np.full_like(box, np.inf)
    recession = replace(
        qps,
        H=qps.H / curvature / REGULARISATION + REGULARISATION * np.eye(d),
        G=np.concatenate([np.broadcast_to(np.eye(d), (len(qps.G), d, d)), qps.G], axis=1),
        g=qps.g / scale[:, None],
        l=np.concatenate([-box, np.where(np.isfinite(qps.l), 0, -np.inf)], axis=1),
        u=np.concatenate([box, np.where(np.isfinite(qps.u), 0, np.inf)], axis=1),
        w=np.concatenate([hard, qps.w / scale[:, None]], axis=1),
    )
    direction = solve(recession).v
    y = np.einsum("brd,bd->br", qps.G[qps.group], direction)
    uphill = np.maximum(np.where(np.isfinite(qps.u), y, 0), np.where(np.isfinite(qps.l), -y, 0))
    weight = np.where(np.isfinite(qps.w), qps.w, 0.0) / scale[:, None]
    slope = (recession.g * direction).sum(-1) + (weight * np.maximum(uphill, 0)).sum(-1)
    return slope < -1e3 * SIGNIFICANT
