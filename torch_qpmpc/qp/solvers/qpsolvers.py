"""Any solver of the `qpsolvers` package: ``solver="qpsolvers:NAME"``; and its form of the QPs.

The split-slack form has soft rows as linear ones, for solvers with hard constraints only:

    min over v, t+, t-:   1/2 v'Hv + g'v + w'(t+ + t-)
    subject to            l <= G v - t+ + t- <= u,   0 <= t+, t-

There is one slack per side instead of the paper's one sigma per row: the optimum is the same, and
ProxQP needs half the iterations and reports no false infeasibility. Hard rows have no slack.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy  # imports scipy.sparse at its first use

from torch_qpmpc.errors import QPError
from torch_qpmpc.qp.pipeline.arrays import BackendSolution, SoftQPs


@dataclass(frozen=True)
class SplitSlack:
    """Matrices shared by a batch: x = (v, t+, t-), rows (G v - t+ + t-, t+, t-)."""

    n_v: int
    n_rows: int
    soft: np.ndarray  # rows that have slacks
    H: list[scipy.sparse.csc_matrix]
    rows: list[scipy.sparse.csc_matrix]

    @classmethod
    def of(cls, qps: SoftQPs) -> SplitSlack:
        (n_rows, n_v), sp = qps.G.shape[1:], scipy.sparse
        soft = np.flatnonzero(np.isfinite(qps.w).any(axis=0))
        n_t, unit = 2 * len(soft), sp.csc_matrix(np.eye(n_rows))[:, soft]
        slack = sp.hstack([-unit, unit])
        positive = sp.hstack([sp.csc_matrix((n_t, n_v)), sp.identity(n_t)])
        blank = sp.csc_matrix((n_t, n_t))
        return cls(
            n_v,
            n_rows,
            soft,
            [sp.csc_matrix(sp.block_diag([H, blank])) for H in qps.H],
            [sp.csc_matrix(sp.vstack([sp.hstack([G, slack]), positive])) for G in qps.G],
        )

    def gradient(self, g: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Return the linear cost of x for one QP; a hard row's slack is fixed at zero."""
        weight = np.where(np.isfinite(w), w, 0.0)[self.soft]
        return np.concatenate([g, weight, weight])

    def bounds(
        self, lower: np.ndarray, upper: np.ndarray, w: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return lower and upper bounds of the rows for one QP."""
        slack_upper = np.tile(np.where(np.isfinite(w), np.inf, 0.0)[self.soft], 2)
        return (
            np.concatenate([lower, np.zeros_like(slack_upper)]),
            np.concatenate([upper, slack_upper]),
        )


def check_available(name: str) -> None:
    """Raise `QPError` unless qpsolvers has the solver called ``name`` installed."""
    import qpsolvers  # imports all its solvers, which takes as long as the rest of this package

    if name not in qpsolvers.available_solvers:
        raise QPError.expected(
            "solver",
            f"'qpsolvers:{name}'",
            f"one of {sorted(qpsolvers.available_solvers)} after 'qpsolvers:'",
            f"Install the solver's package, for example with pip install qpsolvers[{name}].",
        )


def solve(qps: SoftQPs, *, name: str) -> BackendSolution:
    """Solve the QPs one by one."""
    import qpsolvers

    form = SplitSlack.of(qps)
    v, lam = np.zeros_like(qps.g), np.zeros_like(qps.l)
    sparse = name in qpsolvers.sparse_solvers
    for i, m in enumerate(qps.group):
        lower, upper = form.bounds(qps.l[i], qps.u[i], qps.w[i])
        rows = form.rows[m][: form.n_rows]
        has_upper = np.flatnonzero(np.isfinite(upper[: form.n_rows]))
        has_lower = np.flatnonzero(np.isfinite(lower[: form.n_rows]))
        one_sided = scipy.sparse.csc_matrix(
            scipy.sparse.vstack([rows[has_upper], -rows[has_lower]])
        )
        box = np.full(form.n_v, np.inf)
        problem = qpsolvers.Problem(
            form.H[m] if sparse else form.H[m].toarray(),
            form.gradient(qps.g[i], qps.w[i]),
            one_sided if sparse else one_sided.toarray(),
            np.concatenate([upper[has_upper], -lower[has_lower]]),
            lb=np.concatenate([-box, lower[form.n_rows :]]),
            ub=np.concatenate([box, upper[form.n_rows :]]),
        )
        try:
            solution = qpsolvers.solve_problem(problem, solver=name)
        except (qpsolvers.QPError, ValueError, ArithmeticError):
            continue  # Its zeros are rejected by the certificate.
        if solution.x is None or solution.z is None:
            continue
        v[i] = solution.x[: form.n_v]
        lam[i, has_upper] += solution.z[: len(has_upper)]
        lam[i, has_lower] -= solution.z[len(has_upper) :]
    return BackendSolution(v, lam, np.zeros(len(v), dtype=np.int64))
