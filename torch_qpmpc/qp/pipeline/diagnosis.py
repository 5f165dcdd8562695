"""The cause of an unsolved QP (eq:qp2, eq:qp3): infeasible, unbounded, or not converged.

A diagnosis needs a proof in the QP's own numbers, in which the fixed entries are equations of C. A
proof that could result from rounding, or that has an error larger than rounding, does not count:

* *Infeasible* (Farkas' lemma): multipliers chi and lam of the hard rows with ``C'chi + G'lam = 0``
  and ``b'chi + ub'max(lam, 0) - lb'max(-lam, 0) < 0``, which every feasible z makes non-negative.
* *Unbounded*: a feasible point, and a direction d with ``H d = 0`` and ``C d = 0`` that no hard row
  limits and along which the cost decreases.

Both come from least squares with bounds (Lawson and Hanson, "Solving least squares problems",
chapter 23), in an orthonormal basis of the null space of C, which is accurate even if the solvers'
elimination is ill-conditioned.
"""

import numpy as np
import scipy  # imports scipy.optimize at its first use: a third of a second

from torch_qpmpc.qp.pipeline.arrays import CONTRADICTED, Theta
from torch_qpmpc.qp.pipeline.batch import Programs
from torch_qpmpc.qp.pipeline.condensing import null_space
from torch_qpmpc.qp.program import TOLERANCE, Status

#: A sum counts as zero, or as significant, relative to the sum of its absolute terms.
ROUNDING, SIGNIFICANT = 1e-12, 1e-7


def diagnose(programs: Programs) -> np.ndarray:
    """Return the `Status` of each QP, ``(B,)``: INFEASIBLE, UNBOUNDED or NOT_CONVERGED."""
    n_f, ranges, statuses = programs.n_f, {}, []
    for i, m in enumerate(programs.group.tolist()):
        qp = programs.one(i)
        q, free = qp.q + qp.H[:, :n_f] @ programs.fixed[i], qp.H[n_f:, n_f:]
        qp = qp._replace(H=np.pad(free, (n_f, 0)), q=q)  # in the rest of z, the fixed are linear
        if m not in ranges:
            T, Y, *_ = null_space(qp.C[None], 0)
            ranges[m] = Y[0], T[0]
        statuses.append(int(_status(qp, *ranges[m])))
    return np.array(statuses, np.int64)


def _status(qp: Theta, inverse: np.ndarray, null: np.ndarray) -> Status:
    """Return a status by C's pseudo-inverse ``(n_z, n_c)`` and null space ``(n_z, d)``."""
    z = inverse @ qp.b
    z = z + inverse @ (qp.b - qp.C @ z)
    if _contradict(qp, qp.C @ z - qp.b, np.zeros(len(qp.w)), z, inverse):
        return Status.INFEASIBLE
    nearest, lam = _nearest_feasible(qp, z, null)
    if _contradict(qp, np.zeros(len(qp.b)), lam, z, inverse):
        return Status.INFEASIBLE
    if _is_feasible(qp, nearest) and _falls(qp, _steepest_recession(qp, null)):
        return Status.UNBOUNDED
    return Status.NOT_CONVERGED


def _nearest_feasible(qp: Theta, z: np.ndarray, null: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the feasible point nearest to z, where C z = b, and multipliers against feasibility.

    This is Lawson and Hanson's least distance programming: for rows ``A v >= h``, the residual of
    ``min |[A'; h'] lam - e|`` over ``lam >= 0`` gives the point, or is zero if there is none.
    """
    hard, lam, y = np.isinf(qp.w), np.zeros(len(qp.w)), qp.G @ z
    lower, upper = (qp.lb - y)[hard], (qp.ub - y)[hard]
    if not (lower > 0).any() and not (upper < 0).any():
        return z, lam
    norms = np.linalg.norm(qp.G[hard], axis=1)
    norms[norms == 0] = 1.0
    A = _product(qp.G[hard], null) / norms[:, None]
    lower, upper = lower / norms, upper / norms
    length = max(lower.max(), -upper.min())
    # Bounds that are far away would only spoil the least squares.
    below, above = lower > -length / ROUNDING, upper < length / ROUNDING
    h = np.concatenate((lower[below], -upper[above])) / length
    E = np.concatenate((np.concatenate((A[below], -A[above])).T, h[None]))
    unit = np.zeros(len(E))
    unit[-1] = 1.0
    try:
        weights, _ = scipy.optimize.nnls(E, unit)
    except RuntimeError:  # nnls did not converge: neither proof
        return z, lam
    weights[weights < ROUNDING * weights.max()] = 0.0
    residual = E @ weights - unit
    if residual[-1] < 0:
        z = z + null @ (residual[:-1] / -residual[-1]) * length
    multipliers = np.zeros(len(norms))
    multipliers[above] = weights[below.sum() :]
    multipliers[below] -= weights[: below.sum()]
    lam[hard] = multipliers / norms
    return z, lam


def _contradict(
    qp: Theta, chi: np.ndarray, lam: np.ndarray, z: np.ndarray, inverse: np.ndarray
) -> bool:
    """True if chi, completed to ``C'chi + G'lam = 0``, and lam prove that no z is feasible.

    Not even one that violates each row by the fraction `CONTRADICTED` of its terms at ``z``, of
    whose entries none counts as larger than the hard rows allow.
    """
    G_lam = qp.G.T @ lam
    for _ in range(3):
        chi = chi - inverse.T @ (qp.C.T @ chi + G_lam)
    largest = max(np.abs(chi).max(initial=0.0), np.abs(lam).max(initial=0.0))
    chi = _without_noise(chi, largest)
    size = np.abs(chi)
    # Zero multipliers are skipped: their bounds may be infinite.
    charge = lam * np.where(lam > 0, qp.ub, np.where(lam < 0, qp.lb, 0))
    terms = np.abs(charge).sum() + np.abs(qp.b) @ size
    residual, reach = np.abs(qp.C.T @ chi + G_lam), _reach(qp)
    of_z = np.abs(qp.C).T @ size + np.abs(qp.G).T @ np.abs(lam)
    terms += np.minimum(np.abs(z), reach) @ of_z
    noise = len(chi) * np.finfo(float).eps * largest * np.abs(qp.C).sum(0)  # of chi
    zero = residual <= np.maximum(ROUNDING * of_z, np.minimum(noise, SIGNIFICANT * of_z))
    # The residual is charged at the largest |z| that the hard rows allow.
    excess = (residual * np.where(zero, 0, reach)).sum()
    return bool(qp.b @ chi + charge.sum() + excess < -CONTRADICTED * terms)


def _without_noise(x: np.ndarray, largest: float) -> np.ndarray:
    """Return x with entries set to zero that are rounding errors relative to ``largest``."""
    return np.where(np.abs(x) <= ROUNDING * largest, 0.0, x)


def _reach(qp: Theta) -> np.ndarray:
    """Return the bounds of |z| by hard rows with one entry each; inf without such a row."""
    rows = np.isinf(qp.w) & ((qp.G != 0).sum(1) == 1)
    entry = qp.G[rows].nonzero()[1]
    widest = np.maximum(np.abs(qp.lb), np.abs(qp.ub))[rows] / np.abs(qp.G[rows, entry])
    reach = np.full(len(qp.q), np.inf)
    np.minimum.at(reach, entry, widest)
    return reach


def _is_feasible(qp: Theta, z: np.ndarray) -> bool:
    """True if z satisfies C z = b and the hard rows."""
    y, size, hard = qp.G @ z, np.abs(z), np.isinf(qp.w)
    beyond = np.maximum(qp.lb - y, y - qp.ub)[hard]
    errors = np.concatenate((np.abs(qp.C @ z - qp.b), beyond))
    terms = np.abs(qp.C) @ size + np.abs(qp.b), np.abs(qp.G[hard]) @ size
    return bool((errors <= TOLERANCE * (1 + np.concatenate(terms))).all())


def _steepest_recession(qp: Theta, null: np.ndarray) -> np.ndarray:
    """Return the direction in which the cost of an unbounded QP decreases fastest.

    It is the residual of the multipliers that best balance the slope; zero if they balance it.
    """
    curvatures, basis = np.linalg.eigh(null.T @ qp.H @ null)
    flat = np.abs(curvatures) <= ROUNDING * np.abs(curvatures).max(initial=0.0)
    F = null @ basis[:, flat]
    slope = F.T @ qp.q
    scale = np.abs(slope).max(initial=0.0)
    if not scale > 0:
        return np.zeros(len(qp.q))
    high = np.where(np.isfinite(qp.ub), qp.w, 0.0) / scale
    low = np.where(np.isfinite(qp.lb), -qp.w, 0.0) / scale
    rows, slope = low < high, slope / scale
    A = _product(qp.G[rows], F).T
    if rows.any():
        bounds = low[rows], high[rows]
        lam = scipy.optimize.lsq_linear(A, -slope, bounds, method="bvls", tol=1e-15).x
        slope = slope + A @ lam
    return -F @ slope


def _product(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return the matrix product, with zeros for entries that are only rounding errors."""
    product = left @ right
    product[np.abs(product) <= ROUNDING * (np.abs(left) @ np.abs(right))] = 0.0
    return product


def _falls(qp: Theta, d: np.ndarray) -> bool:
    """True if the cost decreases without bound along d, by H, C and the hard rows."""
    d = _without_noise(d, np.abs(d).max(initial=0.0))
    hard, y, size = np.isinf(qp.w), _product(qp.G, d), np.abs(d)
    above, below = np.where(np.isfinite(qp.ub), y, 0), np.where(np.isfinite(qp.lb), -y, 0)
    outwards = np.maximum(above, below).clip(min=0)
    if outwards[hard].any() or _product(qp.H, d).any() or _product(qp.C, d).any():
        return False
    charge = np.where(hard, 0.0, qp.w)
    slope, terms = qp.q @ d + charge @ outwards, np.abs(qp.q) @ size + charge @ outwards
    return bool(slope < -SIGNIFICANT * terms)
