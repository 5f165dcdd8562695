"""ProxQP, the default backend: the sparse batched solver of ProxSuite on the split-slack form.

This is the only file that imports ProxSuite. Its handles are local to a call: a copied or pickled
handle crashes the process, so none may reach a module, and a new one makes the result independent
of earlier solves.

The split-slack form has soft rows as linear ones, for solvers with hard constraints only:

    min over v, t+, t-:   1/2 v'Hv + g'v + w'(t+ + t-)
    subject to            l <= G v - t+ + t- <= u,   0 <= t+, t-

There is one slack per side instead of the paper's one sigma per row: the optimum is the same, and
ProxQP needs half the iterations and reports no false infeasibility. Hard rows have no slack.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy  # imports scipy.sparse at its first use
import torch
from proxsuite import proxqp

from torch_qpmpc.qp.pipeline.arrays import BackendSolution, SoftQPs

EPS_ABS = 1e-9
#: ProxQP's default, 1e-4, calls one soft (always feasible) QP in fifty infeasible.
EPS_INFEASIBLE = 1e-12
#: With the defaults, 10,000 x 1,500, one infeasible QP can take half a minute. Fallbacks are faster
#: beyond these limits. (An inner limit of 25 made ProxQP hang.)
MAX_ITER, MAX_ITER_IN = 30, 100
#: The default, 10, takes a tenth of the time and saves no iteration.
REFINEMENTS = 2


class SplitSlack(NamedTuple):
    """A batch in x = (v, t+, t-) with the rows (G v - t+ + t-, t+, t-).

    H and ``rows`` are the matrices that it shares, the linear costs g and the bounds of the rows
    those of each QP. A hard row's slack is fixed at zero.
    """

    H: list[scipy.sparse.csc_matrix]
    rows: list[scipy.sparse.csc_matrix]
    g: np.ndarray
    lower: np.ndarray
    upper: np.ndarray

    @classmethod
    def of(cls, qps: SoftQPs) -> SplitSlack:
        (n_rows, n_v), sp, is_soft = qps.G.shape[1:], scipy.sparse, np.isfinite(qps.w)
        soft = np.flatnonzero(is_soft.any(axis=0))
        n_t, unit = 2 * len(soft), sp.csc_matrix(np.eye(n_rows))[:, soft]
        slack = sp.hstack([-unit, unit])
        positive = sp.hstack([sp.csc_matrix((n_t, n_v)), sp.identity(n_t)])
        weight, most = np.where(is_soft, qps.w, 0)[:, soft], np.where(is_soft, np.inf, 0)[:, soft]
        return cls(
            [sp.csc_matrix(sp.block_diag([H, sp.csc_matrix((n_t, n_t))])) for H in qps.H],
            [sp.csc_matrix(sp.vstack([sp.hstack([G, slack]), positive])) for G in qps.G],
            np.hstack((qps.g, weight, weight)),
            np.hstack((qps.l, 0 * weight, 0 * weight)),
            np.hstack((qps.u, most, most)),
        )


def solve(qps: SoftQPs) -> BackendSolution:
    """Solve a batch on torch's number of threads."""
    form, n_qps, handles = SplitSlack.of(qps), len(qps.group), []
    batch = proxqp.sparse.BatchQP(n_qps)
    for m, g, *bounds in zip(qps.group, *form[2:], strict=True):
        qp = batch.init_qp_in_place(len(g), 0, len(bounds[0]))
        _configure(qp.settings)
        # No preconditioner: it takes a third of the time of the solve and saves no iteration.
        qp.init(form.H[m], g, None, None, form.rows[m], *bounds, False)
        handles.append(qp)
    threads = torch.get_num_threads()
    if threads == 1 or n_qps == 1:
        for qp in handles:
            qp.solve()
    else:
        # ProxSuite sets the thread count of the OpenMP runtime, which torch shares: keep torch's.
        proxqp.sparse.solve_in_parallel(batch, threads)
    results = [qp.results for qp in handles]
    return BackendSolution(
        np.array([result.x[: qps.g.shape[1]] for result in results]).reshape(qps.g.shape),
        np.array([result.z[: qps.l.shape[1]] for result in results]).reshape(qps.l.shape),
        np.array([result.info.iter for result in results], np.int64),
    )


def _configure(settings: proxqp.Settings) -> None:
    settings.eps_abs = EPS_ABS
    settings.eps_primal_inf = settings.eps_dual_inf = EPS_INFEASIBLE
    settings.check_duality_gap = True
    settings.eps_duality_gap_abs = EPS_ABS
    settings.eps_duality_gap_rel = EPS_ABS
    settings.max_iter, settings.max_iter_in = MAX_ITER, MAX_ITER_IN
    settings.nb_iterative_refinement = REFINEMENTS
    # The first guess is the unconstrained optimum, with slacks of -w / rho, and saves one iteration
    # in ten. The two slacks of a row cancel: a single one violates its row, and ProxQP adds all
    # such rows to its factor, up to 14 times as slow.
    settings.initial_guess = proxqp.InitialGuess.EQUALITY_CONSTRAINED_INITIAL_GUESS
