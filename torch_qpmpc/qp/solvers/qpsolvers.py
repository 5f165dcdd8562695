"""Any solver of the `qpsolvers` package, ``solver="qpsolvers:NAME"``, on the split-slack form."""

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
    for i, (m, g, lower, upper) in enumerate(zip(qps.group, *form[2:], strict=True)):
        has_upper, has_lower = (np.flatnonzero(np.isfinite(x)) for x in (upper, lower))
        sides = [form.rows[m][has_upper], -form.rows[m][has_lower]]
        one_sided = scipy.sparse.vstack(sides, format="csc")
        problem = qpsolvers.Problem(
            form.H[m] if sparse else form.H[m].toarray(),
            g,
            one_sided if sparse else one_sided.toarray(),
            np.concatenate([upper[has_upper], -lower[has_lower]]),
        )
        try:
            solution = qpsolvers.solve_problem(problem, solver=name)
        except (qpsolvers.QPError, ValueError, ArithmeticError):
            continue  # Its zeros are rejected by the certificate.
        if solution.x is None or solution.z is None:
            continue
        force = np.zeros(len(lower))
        force[has_upper] += solution.z[: len(has_upper)]
        force[has_lower] -= solution.z[len(has_upper) :]
        v[i], lam[i] = solution.x[: v.shape[1]], force[: lam.shape[1]]
    return BackendSolution(v, lam, np.zeros(len(v), dtype=np.int64))
