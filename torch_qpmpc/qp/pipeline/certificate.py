"""The certificate of a solution: a relative, sign-aware KKT residual.

It judges the results of all backends. For multipliers ``lam = eta - upsilon`` of the softened rows,
optimality of ``h(y) = w dist(y, [lb, ub])`` in y = Gz is ``h(y) + h*(lam) = lam y`` with conjugate
``h*(lam) = ub max(lam, 0) - lb max(-lam, 0)`` on ``|lam| <= w`` (Fenchel and Young). Each row's gap
is non-negative on its own, so errors of opposite sign cannot cancel as they do in a summed
duality gap.

The formulas are in `torch_qpmpc.qp.kernels`: `recover` completes and certifies the solution of a
backend, `certify` certifies a complete one.
"""

from __future__ import annotations

from torch_qpmpc.qp.pipeline.arrays import Array, BatchSolution
from torch_qpmpc.qp.pipeline.batch import Programs
from torch_qpmpc.qp.solvers.base import BackendSolution


def recover(p: Programs, claim: BackendSolution, passes: int = 0) -> BatchSolution:
    """Complete a backend's solutions of `Programs.reduced_qps`, and certify them.

    ``passes`` iterative refinements of z and chi reduce errors of an ill-conditioned elimination.
    """
    reduced, diagonal = p.prepared.reduced(p.n_f), p.prepared.diagonal
    data = (p.group, p.fixed, p.theta, reduced, diagonal)
    value, z, chi, lam, xi, active, residual = p.kernels.recover(claim.v, claim.lam, *data, passes)
    status = 0 * claim.iterations  # SOLVED, unless the residual is too large
    return BatchSolution(value, z, chi, lam, xi, status, residual, claim.iterations, active)


def certify(p: Programs, z: Array, lam: Array, chi: Array, xi: Array) -> tuple[Array, Array]:
    """Certify z ``(B, n_z)`` with multipliers lam ``(B, n_g)``, chi ``(B, n_c)``, xi ``(B, n_f)``.

    Returns:
        The value ``(B,)``, and the residual ``(B,)``. The residual is the largest error in
        stationarity, C z = b, the fixed entries, hard rows, and multipliers (outside [-w, w] or at
        absent bounds), each relative to the size of its terms; or, if larger, the sum of the errors
        in stationarity and C z = b, weighted by |z| and |chi|, and of the rows' complementarity
        gaps, relative to the cost.
    """
    data = (p.group, p.fixed, p.theta, p.prepared.diagonal)
    return p.kernels.certify(z, lam, chi, xi, *data)
