"""Why a QP has no certified solution: infeasible, unbounded, or merely not converged.

Asked only about QPs that the chosen solver failed on. Two auxiliary problems answer it, each
feasible and bounded by construction, so that the answer does not rest on the failed solver's word.
"""

from __future__ import annotations

import numpy as np

from torch_qpmpc.condense import SoftQPs
from torch_qpmpc.qp import Status
from torch_qpmpc.solvers.daqp import solve

#: Weight of the auxiliary objective against the unit curvature that makes it strictly convex.
WEIGHT = 1e6
SIGNIFICANT = 1e-6


def diagnose(qps: SoftQPs) -> np.ndarray:
    """`Status` of each QP, ``(B,)``, one of INFEASIBLE, UNBOUNDED and NOT_CONVERGED."""
    status = np.full(len(qps.group), Status.NOT_CONVERGED, dtype=np.int64)
    status[_falls_without_bound(qps)] = Status.UNBOUNDED
    status[_hard_rows_conflict(qps)] = Status.INFEASIBLE
    return status


def _hard_rows_conflict(qps: SoftQPs) -> np.ndarray:
    """Whether multipliers prove that no v satisfies the hard rows (Farkas' lemma).

    They come from minimising the rows' summed violation; with ``G'lam = 0`` the rows imply
    ``0 = lam'Gv <= u'max(lam, 0) - l'max(-lam, 0)``, which a negative right-hand side contradicts.
    """
    norms = np.maximum(np.linalg.norm(qps.G, axis=-1), 1e-300)
    hard = np.isinf(qps.w)
    lower = np.where(hard, qps.l / norms[qps.group], -np.inf)
    upper = np.where(hard, qps.u / norms[qps.group], np.inf)
    relaxed = SoftQPs(
        H=np.tile(np.eye(qps.g.shape[1]), (len(qps.H), 1, 1)),
        G=qps.G / norms[..., None],
        group=qps.group,
        g=np.zeros_like(qps.g),
        l=lower,
        u=upper,
        w=np.where(hard, WEIGHT, 0.0),
    )
    nearest = solve(relaxed)
    y = np.einsum("brd,bd->br", relaxed.G[qps.group], nearest.v)
    violation = np.maximum(np.maximum(lower - y, y - upper), 0) / (1 + np.abs(y))
    lam = np.where(hard, nearest.lam / WEIGHT, 0.0)
    pull = np.einsum("brd,br->bd", relaxed.G[qps.group], lam)
    up, down = np.maximum(lam, 0), np.maximum(-lam, 0)
    bound = (up * np.where(up > 0, upper, 0) - down * np.where(down > 0, lower, 0)).sum(-1)
    proof = (np.abs(pull).max(axis=-1, initial=0) <= 1e-2 * -bound) & (bound < -SIGNIFICANT)
    # Rows that hold only far from v = 0 pull as hard as rows that never do, but they hold.
    return proof & (violation.max(axis=-1, initial=0) > SIGNIFICANT)


def _falls_without_bound(qps: SoftQPs) -> np.ndarray:
    """Whether a direction free of curvature and of hard bounds lowers the cost."""
    d = qps.g.shape[1]
    scale = np.maximum(np.abs(qps.g).max(axis=-1, initial=0), 1e-300)
    curvature = np.maximum(np.abs(qps.H).max(axis=(1, 2), initial=0), 1e-300)[:, None, None]
    box, hard = np.ones((len(qps.group), d)), np.full((len(qps.group), d), np.inf)
    recession = SoftQPs(
        H=WEIGHT * qps.H / curvature + np.eye(d) / WEIGHT,
        G=np.concatenate([np.tile(np.eye(d), (len(qps.G), 1, 1)), qps.G], axis=1),
        group=qps.group,
        g=qps.g / scale[:, None],
        l=np.concatenate([-box, np.where(np.isfinite(qps.l), 0, -np.inf)], axis=1),
        u=np.concatenate([box, np.where(np.isfinite(qps.u), 0, np.inf)], axis=1),
        w=np.concatenate([hard, qps.w / scale[:, None]], axis=1),
    )
    direction = solve(recession).v
    # The slope far out: the linear cost, what soft rows charge, and no room for hard ones.
    y = np.einsum("brd,bd->br", qps.G[qps.group], direction)
    uphill = np.maximum(np.where(np.isfinite(qps.u), y, 0), np.where(np.isfinite(qps.l), -y, 0))
    charge = np.where(np.isfinite(qps.w), qps.w / scale[:, None], WEIGHT) * np.maximum(uphill, 0)
    bend = np.einsum("bij,bj->bi", (qps.H / curvature)[qps.group], direction)
    slope = (recession.g * direction).sum(-1) + charge.sum(-1)
    # Only a direction without curvature reaches the box against so large a weight.
    far = np.abs(direction).max(axis=-1, initial=0) > 0.5
    flat = np.abs(bend).max(axis=-1, initial=0) <= 10 / WEIGHT
    return far & flat & (slope < -1e3 * SIGNIFICANT)
