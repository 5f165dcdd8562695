"""DAQP, the fast path: a dual active-set solver with soft constraints of its own, no slacks."""

from __future__ import annotations

import daqp
import numpy as np

from torch_qpmpc.condense import SoftQPs
from torch_qpmpc.solvers.answer import Answer

SOFT, ACTIVE_LOWER, ACTIVE = 8, 2, 1
#: DAQP's reciprocal quadratic slack weight; 1e4 to 1e8 are right to 1e-7, outside it errs.
RECIPROCAL_RHO = 1e6
#: DAQP's infinity.
NO_BOUND = 1e30
SETTINGS = {"primal_tol": 1e-9, "dual_tol": 1e-12, "iter_limit": 2000, "time_limit": 0.2}


def solve(qps: SoftQPs, start: Answer | None = None) -> Answer:
    """Solve a batch; the multipliers of ``start`` say which rows to begin with as active."""
    n_qps, n_rows = qps.l.shape
    v, lam = np.zeros_like(qps.g), np.zeros_like(qps.l)
    iterations = np.zeros(n_qps, dtype=np.int64)
    hard = np.isinf(qps.w)
    sense = np.where(hard, 0, SOFT).astype(np.int32)
    if start is not None:
        sense |= np.where(start.lam > 0, ACTIVE, 0).astype(np.int32)
        sense |= np.where(start.lam < 0, ACTIVE | ACTIVE_LOWER, 0).astype(np.int32)
    weight = np.where(hard, 0.0, qps.w)
    rho = np.full(n_rows, RECIPROCAL_RHO)
    # A row that may be violated for nothing is no row; DAQP would hold it with its small rho.
    upper = np.where(qps.w > 0, np.minimum(qps.u, NO_BOUND), NO_BOUND)
    lower = np.where(qps.w > 0, np.maximum(qps.l, -NO_BOUND), -NO_BOUND)
    for m in np.unique(qps.group):
        H, G = np.array(qps.H[m], order="C"), np.array(qps.G[m], order="C")
        model, pattern = daqp.Model(), None
        for i in np.flatnonzero(qps.group == m):
            # Updating a model to another pattern of soft rows corrupts memory: set up another one.
            if pattern is not None and np.array_equal(pattern, hard[i]):
                model.update(f=qps.g[i], bupper=upper[i], blower=lower[i], sense=sense[i])
            else:
                model, pattern = daqp.Model(), None
                flag, _ = model.setup(H, qps.g[i], G, upper[i], lower[i], sense[i].copy())
                if flag < 0:
                    continue
                model.settings = SETTINGS
                pattern = hard[i]
            if n_rows:  # soft_weights refuses empty arrays
                model.soft_weights(rho_l=rho, rho_u=rho, w_l=weight[i], w_u=weight[i])
            x, _, _, info = model.solve()
            v[i], lam[i], iterations[i] = x, info["lam"], info["iterations"]
    return Answer(v, lam, iterations)
