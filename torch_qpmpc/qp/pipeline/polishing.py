"""Active-set polishing of nearly accurate solutions that the certificate rejected.

A row's state, inactive, active at a bound or saturated at |lam| = w, follows from ``y + lam`` (the
argument of the proximal map of w dist(y, [l, u])). For fixed states the KKT conditions are linear;
solving them and updating the states is a semi-smooth Newton method, exact in a few steps from a
good start.
"""

from __future__ import annotations

import numpy as np
import torch

from torch_qpmpc.qp.solution import row_states
from torch_qpmpc.qp.solvers.base import BackendSolution, SoftQPs

MAX_STEPS = 10
#: Largest relative residual of linear equations that count as solved.
ACCURATE = 1e-12


def refine(qps: SoftQPs, start: BackendSolution, which: np.ndarray) -> BackendSolution:
    """Refine the solutions at the indices ``which``; if the steps do not settle, keep the last."""
    v, lam, iterations = (x.copy() for x in start)
    for i in which:
        H, G = qps.H[qps.group[i]], qps.G[qps.group[i]]
        previous = None
        for _ in range(MAX_STEPS):
            p = G @ v[i] + lam[i]
            bound, active, multiplier = row_states(p, qps.l[i], qps.u[i], qps.w[i])
            states = np.where(active, bound, np.inf), np.where(active, 0, multiplier)
            if previous is not None and np.array_equal(states, previous):
                break
            previous = states
            v[i], lam[i] = _solve_kkt(H, G, qps.g[i], bound, active, states[1])
            iterations[i] += 1
    return BackendSolution(v, lam, iterations)


def _solve_kkt(H, G, g, bound, active, lam_fixed) -> tuple[np.ndarray, np.ndarray]:
    """Return v and lam with ``G_i v`` at its bound in active rows, and fixed lam in the others."""
    d = len(g)
    G_a = G[active]
    kkt = np.block([[H, G_a.T], [G_a, np.zeros((len(G_a), len(G_a)))]])
    right = np.concatenate([-g - G.T @ lam_fixed, bound[active]])
    # In torch, which uses the caller's number of threads.
    system = torch.from_numpy(kkt), torch.from_numpy(right).unsqueeze(-1)
    solution = torch.linalg.solve_ex(*system).result
    error = (system[0] @ solution - system[1]).abs().amax()
    if not error <= ACCURATE * (1 + system[1].abs().amax()):
        # Singular, as with dependent active rows: a hundred times slower.
        solution = torch.linalg.lstsq(*system, rcond=1e-13, driver="gelsd").solution
    solution = solution[:, 0].numpy()
    lam = lam_fixed.copy()
    lam[active] = solution[d:]
    return solution[:d], lam
