"""Active-set crossover: from nearly right to right, for answers that the certificate rejected.

The rows' state is read off ``y + lam`` (the argument of the proximal map of w dist(y, [l, u])):
inactive, active at a bound, or saturated at |lam| = w. With the states held, the KKT conditions are
linear; solving them and reading the states again is a semi-smooth Newton method, exact in a few
steps from a good start.
"""

from __future__ import annotations

import numpy as np

from torch_qpmpc.condense import SoftQPs
from torch_qpmpc.solvers.answer import Answer

MAX_STEPS = 10


def refine(qps: SoftQPs, start: Answer, which: np.ndarray) -> Answer:
    """Sharpen the answers at the indices ``which``; where steps do not settle, the last stays."""
    v, lam, iterations = start.v.copy(), start.lam.copy(), start.iterations.copy()
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
    return Answer(v, lam, iterations)


def row_states(p, lower, upper, w) -> tuple:
    """Each row's nearest bound, whether it is active there, and lam if not; arrays or tensors.

    The excess of ``p = y + lam`` over the bounds would be the multiplier; |lam| <= w caps it.
    """
    bound = p.clip(lower, upper)
    excess = p - bound
    held = excess.clip(-w, w)
    active = (held == excess) & ((excess != 0) | (lower == upper))
    return bound, active, held


def _solve_kkt(H, G, g, bound, active, held) -> tuple[np.ndarray, np.ndarray]:
    """v and lam with ``G_i v`` at its bound where active, and lam as held elsewhere."""
    d = len(g)
    G_a = G[active]
    kkt = np.block([[H, G_a.T], [G_a, np.zeros((len(G_a), len(G_a)))]])
    right = np.concatenate([-g - G.T @ held, bound[active]])
    solution = np.linalg.lstsq(kkt, right, rcond=1e-13)[0]
    lam = held.copy()
    lam[active] = solution[d:]
    return solution[:d], lam
