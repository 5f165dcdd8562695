"""The certificate of a solution: a relative KKT residual, and a bound of the value's error.

They judge the results of all backends. For multipliers ``lam = eta - upsilon`` of the softened
rows, optimality of ``h(y) = w dist(y, [lb, ub])`` in y = Gz is ``h(y) + h*(lam) = lam y`` with
conjugate ``h*(lam) = ub max(lam, 0) - lb max(-lam, 0)`` on ``|lam| <= w`` (Fenchel and Young). Each
row's gap is non-negative on its own, so errors of opposite sign cannot cancel as they do in a
summed duality gap.

A residual is relative to terms that one large weight or multiplier can dominate. The optimal value
lies between two others, in v, the variables that C z = b leaves free:

* Below, the dual function. The Lagrangian at v is the cost less the rows' gaps, and its slope
  ``r = Hv + g + G'lam`` is at most ``1/2 r'H^-1 r`` above its minimum. For a singular H it is
  ``1/2 r'(H + shift)^-1 r + shift / 2 |reach|^2``, or ``|r|'reach``, if some optimum is within
  ``reach``: within the hard bounds of v, or within `RANGE` times the largest entry of z.
* Above, the cost of a feasible point. The least step that ends all violations of hard rows, and
  holds those nearly active, is long where rows are nearly parallel. Rounding errors count as
  violations.

``value_error`` is the distance of the two and the rounding errors of the value, relative to the
largest of 1/2 z'Hz, q'z, w'sigma and their sum.

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
    parts = p.kernels.recover(claim.v, claim.lam, *_data(p), passes)
    value, z, chi, lam, xi, active, residual, error = parts
    status = 0 * claim.iterations  # SOLVED, unless an error is too large
    return BatchSolution(value, z, chi, lam, xi, status, residual, error, claim.iterations, active)


def certify(p: Programs, z: Array, lam: Array, chi: Array, xi: Array) -> tuple[Array, Array, Array]:
    """Certify z ``(B, n_z)`` with multipliers lam ``(B, n_g)``, chi ``(B, n_c)``, xi ``(B, n_f)``.

    Returns:
        The value, the residual and the error of the value, ``(B,)``. The residual is the largest
        error in stationarity, C z = b, the fixed entries, hard rows, and multipliers (outside
        [-w, w] or at absent bounds), each relative to the size of its terms; or, if larger, the sum
        of the errors in C z = b, weighted by |chi|, and of the rows' complementarity gaps, relative
        to the cost.
    """
    return p.kernels.certify(z, lam, chi, xi, *_data(p))


def _data(p: Programs) -> tuple:
    prepared, n_f = p.prepared, p.n_f
    sizes = prepared.reduced(n_f), prepared.sizes(n_f)
    return p.group, p.fixed, p.theta, *sizes, prepared.diagonal
