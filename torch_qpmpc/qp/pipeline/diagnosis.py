"""Why a QP (eq:qp2, eq:qp3) has no certified solution: infeasible, unbounded, or not converged.

A verdict needs a proof that holds in the QP's own numbers, checked in all entries of z. A proof
that rounding could have made, or that leaves an error larger than rounding, proves nothing:

* *Infeasible* (Farkas' lemma): multipliers chi and lam of the hard rows with ``C'chi + G'lam = 0``
  off the fixed entries and ``b'chi + ub'max(lam, 0) - lb'max(-lam, 0) < 0``, while every feasible
  z makes the latter at least zero.
* *Unbounded*: a feasible point, and a direction d with ``H d = 0`` and ``C d = 0`` that no hard row
  ends and along which the cost falls.

Both come from least squares with bounds (Lawson and Hanson, "Solving least squares problems",
chapter 23), in an orthonormal basis of the null space of C, however ill-conditioned the elimination
is that the solvers used.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy  # imports scipy.optimize at its first use: a third of a second

from torch_qpmpc.qp.pipeline.batch import Programs, SoftQPs
from torch_qpmpc.qp.pipeline.batch_solution import TOLERANCE
from torch_qpmpc.qp.pipeline.condensing import null_space
from torch_qpmpc.qp.program import Status
from torch_qpmpc.qp.solvers import daqp

#: Relative to the sum of the absolute terms: what counts as zero, and what does not.
ROUNDING, SIGNIFICANT = 1e-12, 1e-7


def diagnose(p: Programs) -> np.ndarray:
    """`Status` of each QP, ``(B,)``, one of INFEASIBLE, UNBOUNDED and NOT_CONVERGED."""
    H, C, G, q, _, b, lb, ub, w = p.theta
    ranges = {m: _Range.of(C[m][:, p.n_f :]) for m in set(p.group.tolist())}
    found = []
    for i, m in enumerate(p.group.tolist()):
        vectors = (x[i % len(x)] for x in (b, lb, ub, w))
        of_b, of_lb, of_ub, of_w = vectors
        qp = _FreeQP.of(H[m], q[i % len(q)], C[m], of_b, G[m], of_lb, of_ub, of_w, p.fixed[i])
        found.append(int(_status(qp, ranges[m])))
    return np.array(found, np.int64)


@dataclass(frozen=True)
class _Range:
    """The pseudo-inverse of C ``(n, n_c)``, and its orthonormal null space ``(n, d)``."""

    inverse: np.ndarray
    null: np.ndarray

    @classmethod
    def of(cls, C: np.ndarray) -> _Range:
        T, Y_neg, _ = null_space(C[None], 0)
        return cls(-Y_neg[0], T[0])


@dataclass(frozen=True)
class _FreeQP:
    """One QP in the entries of z that are not fixed.

    ``b``, ``lb`` and ``ub`` have the fixed entries' part subtracted, and ``b_size``, ``lb_size``
    and ``ub_size`` are the sums of the absolute terms: rounding errors are relative to those.
    """

    H: np.ndarray
    q: np.ndarray
    C: np.ndarray
    b: np.ndarray
    b_size: np.ndarray
    G: np.ndarray
    lb: np.ndarray
    lb_size: np.ndarray
    ub: np.ndarray
    ub_size: np.ndarray
    w: np.ndarray

    @classmethod
    def of(cls, H, q, C, b, G, lb, ub, w, fixed) -> _FreeQP:
        n_f, size = len(fixed), np.abs(fixed)
        of_C, of_G = C[:, :n_f] @ fixed, G[:, :n_f] @ fixed
        C_size, G_size = np.abs(C[:, :n_f]) @ size, np.abs(G[:, :n_f]) @ size
        return cls(
            H=H[n_f:, n_f:],
            q=q[n_f:] + H[n_f:, :n_f] @ fixed,
            C=C[:, n_f:],
            b=b - of_C,
            b_size=np.abs(b) + C_size,
            G=G[:, n_f:],
            lb=lb - of_G,
            lb_size=np.abs(lb) + G_size,
            ub=ub - of_G,
            ub_size=np.abs(ub) + G_size,
            w=w,
        )


def _status(qp: _FreeQP, of_C: _Range) -> Status:
    z = of_C.inverse @ qp.b
    z = z + of_C.inverse @ (qp.b - qp.C @ z)
    no_rows = np.zeros(len(qp.w))
    if _contradict(qp, qp.C @ z - qp.b, no_rows, of_C):
        return Status.INFEASIBLE
    nearest, lam = _nearest_feasible(qp, z, of_C)
    if _contradict(qp, np.zeros(len(qp.b)), lam, of_C):
        return Status.INFEASIBLE
    if _is_feasible(qp, nearest) and _falls(qp, _steepest_recession(qp, of_C)):
        return Status.UNBOUNDED
    return Status.NOT_CONVERGED


def _nearest_feasible(qp: _FreeQP, z: np.ndarray, of_C: _Range) -> tuple[np.ndarray, np.ndarray]:
    """The feasible point nearest to z, where C z = b, or multipliers that deny that there is one.

    DAQP finds the point sooner. Where it finds none, Lawson and Hanson's least distance programming
    decides: of the rows ``A v >= h``, the residual of ``min |[A'; h'] lam - e|`` over ``lam >= 0``
    is the point, or zero where there is none.
    """
    hard, y = np.isinf(qp.w), qp.G @ z
    no_multipliers = np.zeros(len(hard))
    lower, upper = (qp.lb - y)[hard], (qp.ub - y)[hard]
    if not (lower > 0).any() and not (upper < 0).any():
        return z, no_multipliers
    norms = np.linalg.norm(qp.G[hard], axis=1)
    norms[norms == 0] = 1.0
    A = _product(qp.G[hard], of_C.null) / norms[:, None]
    lower, upper = lower / norms, upper / norms
    length = max(lower.max(), -upper.min())
    nearest = z + of_C.null @ _least_distance(A, lower / length, upper / length) * length
    if _is_feasible(qp, nearest):
        return nearest, no_multipliers
    below, above = np.isfinite(lower), np.isfinite(upper)
    h = np.concatenate((lower[below], -upper[above])) / length
    E = np.concatenate((np.concatenate((A[below], -A[above])).T, h[None]))
    unit = np.zeros(len(E))
    unit[-1] = 1.0
    try:
        weights, _ = scipy.optimize.nnls(E, unit)
    except RuntimeError:  # it did not settle: nothing is known
        return z, no_multipliers
    weights[weights < ROUNDING * weights.max()] = 0.0
    left = E @ weights - unit
    if left[-1] < 0:
        z = z + of_C.null @ (left[:-1] / -left[-1]) * length
    of_rows = np.zeros(len(norms))
    of_rows[above] = weights[below.sum() :]
    of_rows[below] -= weights[: below.sum()]
    lam = no_multipliers
    lam[hard] = of_rows / norms
    return z, lam


def _least_distance(A: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """The shortest v with ``lower <= A v <= upper``, if DAQP finds it."""
    unit, zero = np.eye(A.shape[1]), np.zeros((1, A.shape[1]))
    w = np.full((1, len(A)), np.inf)
    rows = (A[None], np.zeros(1, np.int64), zero, lower[None], upper[None], w)
    return daqp.solve(SoftQPs(unit[None], *rows)).v[0]


def _contradict(qp: _FreeQP, chi: np.ndarray, lam: np.ndarray, of_C: _Range) -> bool:
    """True if chi, completed to ``C'chi + G'lam = 0``, and lam prove that no z is feasible."""
    pull = qp.G.T @ lam
    for _ in range(3):
        chi = chi - of_C.inverse.T @ (qp.C.T @ chi + pull)
    largest = max(np.abs(chi).max(initial=0.0), np.abs(lam).max(initial=0.0))
    chi = _without_noise(chi, largest)
    up, down, size = np.maximum(lam, 0), np.maximum(-lam, 0), np.abs(chi)
    # A multiplier of zero has no bound to multiply, which may be infinite.
    with np.errstate(invalid="ignore"):
        charge = np.where(up > 0, up * qp.ub, 0) - np.where(down > 0, down * qp.lb, 0)
        terms = np.where(up > 0, up * qp.ub_size, 0) + np.where(down > 0, down * qp.lb_size, 0)
    left, reach = np.abs(qp.C.T @ chi + pull), _reach(qp)
    zero = left <= ROUNDING * (np.abs(qp.C).T @ size + np.abs(qp.G).T @ (up + down))
    # What is left over counts for as much as the rest of the hard rows lets z make of it.
    excess = (left * np.where(zero, 0, reach)).sum()
    demand = qp.b @ chi + charge.sum() + excess
    return bool(demand < -SIGNIFICANT * (qp.b_size @ size + terms.sum()))


def _without_noise(x: np.ndarray, largest: float) -> np.ndarray:
    """x with zero for what rounding makes of a zero beside numbers as large as ``largest``."""
    return np.where(np.abs(x) <= ROUNDING * largest, 0.0, x)


def _reach(qp: _FreeQP) -> np.ndarray:
    """Bounds of |z| by the hard rows of one entry each; inf where there is none."""
    rows = np.isinf(qp.w) & ((qp.G != 0).sum(1) == 1)
    entry = qp.G[rows].nonzero()[1]
    widest = np.maximum(np.abs(qp.lb), np.abs(qp.ub))[rows] / np.abs(qp.G[rows, entry])
    reach = np.full(len(qp.q), np.inf)
    np.minimum.at(reach, entry, widest)
    return reach


def _is_feasible(qp: _FreeQP, z: np.ndarray) -> bool:
    """True if z satisfies C z = b and the hard rows."""
    y, size = qp.G @ z, np.abs(qp.G) @ np.abs(z)
    beyond = np.maximum(qp.lb - y, y - qp.ub)[np.isinf(qp.w)]
    short = np.abs(qp.C @ z - qp.b)
    C_size = np.abs(qp.C) @ np.abs(z) + qp.b_size
    return bool(
        (short <= TOLERANCE * (1 + C_size)).all()
        and (beyond <= TOLERANCE * (1 + size[np.isinf(qp.w)])).all()
    )


def _steepest_recession(qp: _FreeQP, of_C: _Range) -> np.ndarray:
    """The direction, in all free entries, along which the cost of a QP without end falls most.

    It is the residual of the multipliers that balance the slope best; zero where they balance it.
    """
    curvatures, basis = np.linalg.eigh(of_C.null.T @ qp.H @ of_C.null)
    flat = np.abs(curvatures) <= ROUNDING * np.abs(curvatures).max(initial=0.0)
    F = of_C.null @ basis[:, flat]
    slope = F.T @ qp.q
    scale = np.abs(slope).max(initial=0.0)
    if not scale > 0:
        return np.zeros(len(qp.q))
    most = np.where(np.isfinite(qp.ub), qp.w, 0.0) / scale
    least = np.where(np.isfinite(qp.lb), -qp.w, 0.0) / scale
    rows, slope = least < most, slope / scale
    A = _product(qp.G[rows], F).T
    if rows.any():
        bounds = least[rows], most[rows]
        lam = scipy.optimize.lsq_linear(A, -slope, bounds, method="bvls", tol=1e-15).x
        slope = slope + A @ lam
    return -F @ slope


def _product(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """The matrix product, with zero where it is only rounding."""
    product = left @ right
    product[np.abs(product) <= ROUNDING * (np.abs(left) @ np.abs(right))] = 0.0
    return product


def _falls(qp: _FreeQP, d: np.ndarray) -> bool:
    """True if the cost falls for ever along d, which no curvature, C or hard row ends."""
    d = _without_noise(d, np.abs(d).max(initial=0.0))
    y, size = qp.G @ d, np.abs(d)
    row_size = np.abs(qp.G) @ size
    outwards = np.maximum(
        np.where(np.isfinite(qp.ub), y, 0), np.where(np.isfinite(qp.lb), -y, 0)
    ).clip(min=0)
    hard = np.isinf(qp.w)
    if (outwards > ROUNDING * row_size)[hard].any():
        return False
    for matrix in (qp.H, qp.C):
        if (np.abs(matrix @ d) > ROUNDING * (np.abs(matrix) @ size)).any():
            return False
    charge = np.where(hard, 0.0, qp.w)
    slope, terms = qp.q @ d + charge @ outwards, np.abs(qp.q) @ size + charge @ outwards
    return bool(slope < -SIGNIFICANT * terms)
