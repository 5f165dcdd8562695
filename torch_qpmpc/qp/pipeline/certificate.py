"""The project's own judgement of a claimed solution: a relative, sign-aware KKT residual.

No solver's word is taken. For multipliers ``lam = eta - upsilon`` of the softened rows, optimality
of ``h(y) = w dist(y, [lb, ub])`` in y = Gz is ``h(y) + h*(lam) = lam y`` with the conjugate
``h*(lam) = ub max(lam, 0) - lb max(-lam, 0)`` on ``|lam| <= w`` (Fenchel and Young). Each row's gap
is non-negative on its own, so errors of opposite sign cannot cancel as they do in a summed
duality gap.

The formulas are in `torch_qpmpc.qp.kernels`: `recover` completes what a backend returns and judges
it, `certify` judges a complete solution.
"""

from __future__ import annotations

from torch_qpmpc.qp.pipeline.arrays import Array
from torch_qpmpc.qp.pipeline.batch import Programs
from torch_qpmpc.qp.pipeline.batch_solution import BatchSolution
from torch_qpmpc.qp.solvers.base import BackendSolution


def recover(p: Programs, found: BackendSolution, passes: int = 0) -> BatchSolution:
    """Complete a backend's solutions of `Programs.reduced_qps`, and certify them.

    Each of ``passes`` refines z and chi against the errors of an ill-conditioned elimination.
    """
    reduced, diagonal = p.prepared.reduced(p.n_f), p.prepared.diagonal
    data = (p.group, p.fixed, p.theta, reduced, diagonal)
    value, z, chi, lam, xi, active, residual = p.kernels.recover(found.v, found.lam, *data, passes)
    status = 0 * found.iterations  # SOLVED, until the residual is judged
    return BatchSolution(value, z, chi, lam, xi, status, residual, found.iterations, active)


def certify(p: Programs, z: Array, lam: Array, chi: Array, xi: Array) -> tuple[Array, Array]:
    """Judge z ``(B, n_z)`` with multipliers lam ``(B, n_g)``, chi ``(B, n_c)``, xi ``(B, n_f)``.

    Returns:
        The value ``(B,)``, and the residual ``(B,)``: the largest of stationarity, C z = b, the
        fixed entries, violation of hard rows, multipliers outside [-w, w] or of absent bounds, each
        relative to the size of the terms that it compares; and what all of them, with the rows'
        complementarity gaps, are worth at the claim's own z and multipliers, relative to the cost.
    """
    data = (p.group, p.fixed, p.theta, p.prepared.diagonal)
    return p.kernels.certify(z, lam, chi, xi, *data)
