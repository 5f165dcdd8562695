"""ProxQP, the default: the sparse batched solver of ProxSuite on the split-slack form.

This is the only file that imports ProxSuite. Its handles are local to a call: a copied or pickled
handle crashes the process, so none may reach a module, and a fresh one makes the answer independent
of what was solved before.
"""

from __future__ import annotations

import os

import numpy as np
import torch
from proxsuite import proxqp

from torch_qpmpc.condense import SoftQPs
from torch_qpmpc.solvers.answer import Answer
from torch_qpmpc.solvers.split_slack import SplitSlack

EPS_ABS = 1e-9
#: ProxQP's default, 1e-4, calls one soft (always feasible) QP in fifty infeasible.
EPS_INFEASIBLE = 1e-12
#: Its defaults, 10,000 x 1,500, can keep one infeasible QP busy for half a minute.
MAX_ITER, MAX_ITER_IN = 300, 100

_forked = False


def _mark_forked() -> None:
    global _forked
    _forked = True


# OpenMP's threads do not survive a fork: solving in parallel in the child would wait for ever.
os.register_at_fork(after_in_child=_mark_forked)


def solve(qps: SoftQPs, start: Answer | None = None) -> Answer:
    """Solve a batch; ``start`` is a primal-dual guess for the same QPs."""
    form = SplitSlack.of(qps)
    n_x, n_in = form.n_x, form.n_in
    n_qps = len(qps.group)
    batch = proxqp.sparse.BatchQP(n_qps)
    handles = []
    for i, m in enumerate(qps.group):
        qp = batch.init_qp_in_place(n_x, 0, n_in)
        lower, upper = form.bounds(qps.l[i], qps.u[i], qps.w[i])
        _configure(qp.settings)
        if start is not None:
            qp.settings.initial_guess = proxqp.InitialGuess.WARM_START
        qp.init(
            form.H[m], form.gradient(qps.g[i], qps.w[i]), None, None, form.rows[m], lower, upper
        )
        handles.append(qp)
    threads = torch.get_num_threads()
    if start is not None:
        for i, qp in enumerate(handles):
            qp.solve(*_guess(form, qps, start, i))
    elif _forked or threads == 1 or n_qps == 1:
        for qp in handles:
            qp.solve()
    else:
        # ProxSuite sets the thread count of the OpenMP runtime that torch uses too: keep torch's.
        proxqp.sparse.solve_in_parallel(batch, threads)
    return Answer(
        v=np.array([qp.results.x[: form.n_v] for qp in handles]),
        lam=np.array([qp.results.z[: form.n_rows] for qp in handles]),
        iterations=np.array([qp.results.info.iter for qp in handles]),
    )


def _configure(settings: proxqp.Settings) -> None:
    settings.eps_abs = EPS_ABS
    settings.eps_primal_inf = settings.eps_dual_inf = EPS_INFEASIBLE
    settings.check_duality_gap = True
    settings.eps_duality_gap_abs = EPS_ABS
    settings.eps_duality_gap_rel = EPS_ABS
    settings.max_iter, settings.max_iter_in = MAX_ITER, MAX_ITER_IN
    settings.initial_guess = proxqp.InitialGuess.NO_INITIAL_GUESS


def _guess(form: SplitSlack, qps: SoftQPs, start: Answer, i: int) -> tuple:
    """x = (v, t+, t-) and the multipliers of its rows, from v and lam."""
    y = qps.G[qps.group[i]] @ start.v[i]
    weight = np.where(np.isfinite(qps.w[i]), qps.w[i], np.abs(start.lam[i]))
    t_over = np.maximum(y - qps.u[i], 0)[form.over]
    t_under = np.maximum(qps.l[i] - y, 0)[form.under]
    dual = (start.lam[i] - weight)[form.over], (-start.lam[i] - weight)[form.under]
    return (
        np.concatenate([start.v[i], t_over, t_under]),
        np.zeros(0),
        np.concatenate([start.lam[i], *dual]),
    )
