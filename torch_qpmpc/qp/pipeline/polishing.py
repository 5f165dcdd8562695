"""Active-set crossover: from nearly right to right, for solutions that the certificate rejected.

The rows' state is read off ``y + lam`` (the argument of the proximal map of w dist(y, [l, u])):
inactive, active at a bound, or saturated at |lam| = w. With the states held, the KKT conditions are
linear; solving them and reading the states again is a semi-smooth Newton method, exact in a few
steps from a good start.
"""

from __future__ import annotations

import numpy as np
import torch

from torch_qpmpc.qp.pipeline.batch import SoftQPs
from torch_qpmpc.qp.solution import row_states
from torch_qpmpc.qp.solvers.base import BackendSolution

MAX_STEPS = 10


def refine(qps: SoftQPs, start: BackendSolution, which: np.ndarray) -> BackendSolution:
    """Sharpen the solutions at the indices ``which``; where steps do not settle, the last stays."""
    v, lam, iterations = (x.copy() for x in start)
    for i in which:
        H, G = qps.H[qps.group[i]], qps.G[qps.group[i]]
        previous = None
        for _ in range(MAX_STEPS):
            p = G @ v[i] + lam[i]
            bound, active, held = row_states(p, qps.l[i], qps.u[i], qps.w[i])
            states = np.where(active, bound, np.inf), np.where(active, 0, held)
            if previous is not None and np.array_equal(states, previous):
                break
            previous = states
            v[i], lam[i] = _solve_kkt(H, G, qps.g[i], bound, active, states[1])
            iterations[i] += 1
    return BackendSolution(v, lam, iterations)


def _solve_kkt(H, G, g, bound, active, held) -> tuple[np.ndarray, np.ndarray]:
    """v and lam with ``G_i v`` at its bound where active, and lam as held elsewhere."""
    d = len(g)
    G_a = G[active]
    kkt = np.block([[H, G_a.T], [G_a, np.zeros((len(G_a), len(G_a)))]])
    right = np.concatenate([-g - G.T @ held, bound[active]])
    # By torch, which has the caller's number of threads.
    system = torch.from_numpy(kkt), torch.from_numpy(right).unsqueeze(-1)
    solution = torch.linalg.lstsq(*system, rcond=1e-13, driver="gelsd").solution[:, 0].numpy()
    lam = held.copy()
    lam[active] = solution[d:]
    return solution[:d], lam
