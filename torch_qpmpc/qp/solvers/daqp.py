"""DAQP, the fast backend: a dual active-set method with built-in soft constraints, no slacks.

Of a batch it solves what `torch_qpmpc.qp.kernels.active_set`, a method of the same kind without
DAQP's call for each QP, leaves unsolved.
"""

import daqp
import numpy as np

from torch_qpmpc.qp.pipeline.arrays import BackendSolution, SoftQPs

#: The code of a soft row in DAQP's ``sense``.
SOFT = 8
#: DAQP's reciprocal quadratic slack weight; 1e4 to 1e8 are accurate to 1e-7, others less. A soft
#: row is off its bound by its multiplier over this weight: with 1e6, the certificate rejects QPs
#: with large multipliers narrowly.
RECIPROCAL_RHO = 1e7
#: DAQP's infinity.
NO_BOUND = 1e30
#: A limit of iterations, not of time: the result does not depend on the machine's load.
SETTINGS = {"primal_tol": 1e-9, "dual_tol": 1e-12, "iter_limit": 2000}


def solve(qps: SoftQPs) -> BackendSolution:
    """Solve the QPs one by one."""
    v, lam, iterations = np.zeros_like(qps.g), np.zeros_like(qps.l), np.zeros_like(qps.group)
    # A row with zero weight is no constraint, but DAQP would hold it with its small rho.
    lower = np.where(qps.w == 0, -NO_BOUND, np.maximum(qps.l, -NO_BOUND))
    upper = np.where(qps.w == 0, NO_BOUND, np.minimum(qps.u, NO_BOUND))
    rho = np.full(lam.shape[1], RECIPROCAL_RHO)
    for i, (m, g, w) in enumerate(zip(qps.group, qps.g, qps.w, strict=True)):
        model, hard = daqp.Model(), np.isinf(w)
        sense, weight = np.where(hard, 0, SOFT).astype(np.int32), np.where(hard, 0.0, w)
        flag, _ = model.setup(qps.H[m], g.copy(), qps.G[m], upper[i], lower[i], sense)
        if flag >= 0:  # else zeros, which the certificate rejects
            model.settings = SETTINGS
            model.soft_weights(rho_l=rho, rho_u=rho, w_l=weight, w_u=weight)
            v[i], _, _, info = model.solve()
            lam[i], iterations[i] = info["lam"], info["iterations"]
    return BackendSolution(v, lam, iterations)
