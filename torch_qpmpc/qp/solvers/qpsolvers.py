"""Any solver of the `qpsolvers` package, ``solver="qpsolvers:NAME"``, on the split-slack form."""

from __future__ import annotations

import numpy as np
import scipy  # imports scipy.sparse at its first use

from torch_qpmpc.errors import QPError
from torch_qpmpc.qp.pipeline.arrays import BackendSolution, SoftQPs
from torch_qpmpc.qp.solvers.proxqp import SplitSlack


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
