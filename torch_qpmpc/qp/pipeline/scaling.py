"""Scaling: a QP of unusual size is solved and certified in units of its own.

Tolerances are relative, but to no less than one: without units, solvers and certificate cannot
distinguish costs, variables or rows of size 1e-8 from zeros. With units of cost kappa, of length l,
and of the rows rho (of G) and gamma (of C),

    z = l z',  H' = H l^2 / kappa,  q' = q l / kappa,  C' = C l / gamma,  b' = b / gamma,
    G' = G l / rho,  (lb, ub)' = (lb, ub) / rho,  w' = w rho / kappa,

is the same QP. All units are powers of two, so that rounding does not change. The entries of z
share one length, unless the columns of H, C and G differ by orders of magnitude, as for states in
watts beside actions between -1 and 1: then each has its own, from equilibration. QPs that share
their matrices, but whose optima differ by orders of magnitude, do not share a length.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from torch_qpmpc.qp.kernels.linalg import row_sums
from torch_qpmpc.qp.pipeline.arrays import Array, BatchSolution, Theta, per_qp

#: Sizes between these have the unit one.
SMALL, LARGE = 2.0**-7, 2.0**10
#: Columns that differ by more than this factor have units of their own, ..
APART = 2.0**14
#: .. after so many passes of equilibration, which carry a unit through a dead time, or fewer if one
#: moves no unit by more than this, as a logarithm.
PASSES, STILL = 64, 0.02
#: QPs share a length if theirs, as powers of two, have the same quotient by this.
ALIKE = 7
#: Entries below this, relative to the largest, may be what rounding leaves of zeros.
ROUNDING = 2.0**-40


class Units(NamedTuple):
    """Units of K classes of QPs, each of which shares matrices and a length.

    ``cost`` ``(K, 1)``, ``length`` ``(K, 1)`` or ``(K, n_z)``, ``rows`` ``(K, n_g)`` and
    ``equalities`` ``(K, n_c)``; ``group`` is the class of each QP, and ``triple`` ``(K,)`` the
    index of a class's matrices among the M.
    """

    cost: np.ndarray
    length: np.ndarray
    rows: np.ndarray
    equalities: np.ndarray
    group: np.ndarray
    triple: np.ndarray

    @classmethod
    @np.errstate(all="ignore")
    def of(cls, theta: Theta, group: np.ndarray) -> Units | None:
        """Return the units of theta; None if all of them are one."""
        if not len(group) or not theta.q.shape[-1]:
            return None
        own = cls.of_columns(theta, group)
        units = cls.of_rows_and_cost(theta if own is None else own.scaled(theta), group)
        if own is None or units is None:
            return units or own
        return units._replace(length=units.length * own.length[units.triple])

    @classmethod
    @np.errstate(all="ignore")
    def of_columns(cls, theta: Theta, group: np.ndarray) -> Units | None:
        """Return units of the entries of z that follow from the matrices; None if alike."""
        of_C, of_G = (column_sizes(x) for x in (theta.C, theta.G))
        curvature = np.sqrt(np.abs(theta.H.diagonal(axis1=1, axis2=2)))
        if not (_apart(np.maximum(of_C, of_G)) or _apart(curvature)):
            return None
        M = max(map(len, theta[:3]))
        H, C, G = (x if len(x) == M else x.repeat(M, 0) for x in theta[:3])
        columns = lengths(H, np.concatenate((C, G), axis=1))
        one = np.ones((len(columns), 1))
        n_c, n_g = theta.C.shape[1], theta.G.shape[1]
        triple = np.arange(len(columns))
        return cls(one, columns, one.repeat(n_g, 1), one.repeat(n_c, 1), group, triple)

    @classmethod
    @np.errstate(all="ignore")
    def of_rows_and_cost(cls, theta: Theta, group: np.ndarray) -> Units | None:
        """Return units with one length for all entries of z; None if all of them are one."""
        rows, equalities = row_sums(theta.G), row_sums(theta.C)
        near = np.fmin(
            *(np.where(np.isfinite(x) & (x != 0), np.abs(x), np.nan) for x in (theta.lb, theta.ub))
        )
        near, b = np.where(np.isnan(near), 0.0, near), np.abs(theta.b)
        b = np.where(b > ROUNDING * b.max(-1, keepdims=True, initial=0.0), b, 0)
        M = max(map(len, theta[:3]))
        H = column_sizes(theta.H).max(-1, keepdims=True)
        H, rows, equalities = (x if len(x) == M else x.repeat(M, 0) for x in (H, rows, equalities))
        reach = np.concatenate((near / rows[group], b / equalities[group]), axis=-1)
        q = finite_sizes(theta.q, group, M).max(-1, keepdims=True)
        sizes = np.maximum(H, q), rows, equalities, reach
        if (sizes[0] > 0).all() and not any(_unusual(x).any() for x in sizes):
            return None
        # A bound, however large, demands no large z, and a large z is compared with itself.
        own = np.minimum(_typical(reach), 1.0)
        kinds = np.stack((group, np.frexp(own[:, 0])[1] // ALIKE), axis=-1)
        kinds, group = np.unique(kinds, axis=0, return_inverse=True)
        triple, group = kinds[:, 0], group.reshape(-1)
        length, q, w = (finite_sizes(x, group, len(triple)) for x in (own, theta.q, theta.w))
        H, rows, equalities = H[triple], rows[triple] * length, equalities[triple] * length
        cost = np.maximum(H * length**2, q.max(-1, keepdims=True) * length)
        of_rows = (w * rows).max(-1, keepdims=True, initial=0.0)
        cost = np.where(cost > 0, cost, np.maximum(cost, of_rows))  # a QP without any other cost
        cost, rows, equalities = (_power_above(x) for x in (cost, rows, equalities))
        units = cost, length, rows, equalities
        return cls(*units, group, triple) if any((unit != 1).any() for unit in units) else None

    def per_qp(self, group: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return cost, length, rows and equalities of the QPs of these classes."""
        return tuple(per_qp(unit, group) for unit in self[:4])

    def scaled(self, theta: Theta) -> Theta:
        """Return theta in these units, with the matrices of each class."""
        cost, length, rows, equalities = self.per_qp(self.group)
        H, C, G = (per_qp(x, self.triple) for x in theta[:3])
        by_row = self.length[:, None] / self.rows[:, :, None]
        by_equality = self.length[:, None] / self.equalities[:, :, None]
        return Theta(
            H * (self.length[:, :, None] * (self.length / self.cost)[:, None]),
            C * by_equality,
            G * by_row,
            theta.q / (cost / length),
            theta.c / cost[:, 0],
            theta.b / equalities,
            theta.lb / rows,
            theta.ub / rows,
            theta.w * (rows / cost),
        )

    def restored(self, solution: BatchSolution, group: Array) -> BatchSolution:
        """Return solutions of QPs of these classes in the original numbers.

        Their relative residuals are the same.
        """
        cost, length, rows, equalities = self.per_qp(group)
        return solution._replace(
            value=solution.value * cost[:, 0],
            z=solution.z * length,
            chi=solution.chi * (cost / equalities),
            lam=solution.lam * (cost / rows),
            xi=solution.xi * (cost / length[:, : solution.xi.shape[-1]]),
        )


def lengths(H: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return units of the entries of z ``(M, n_z)`` that equilibrate H and rows of equations.

    Their logarithms, and those of units of the rows and of the cost, bring those of the entries
    nearest to zero (Curtis and Reid, 1972). So a signal's own bounds, which any unit suits, have no
    part in its unit. Nor have entries that vanish beside the largest of their row and column, once
    those are near one (Ruiz, 2001): what rounding leaves of zeros, and exponentials in a cost.
    """
    (M, n, _), r = H.shape, rows.shape[1]
    # The matrices of an MPC scheme are sparse. An entry of H belongs to two of z.
    (m, i, j), (k, row, column) = H.nonzero(), rows.nonzero()
    sizes = np.log2(np.abs(np.concatenate((H[m, i, j], rows[k, row, column]))))
    line = np.concatenate((M * r + m, k * r + row))
    first = np.concatenate((m * n + i, np.full(len(k), M * n)))
    second = np.concatenate((m * n + j, k * n + column))

    def equilibrated(typical: Any, kept: np.ndarray, step: float) -> tuple[Any, Any]:
        """Return units, and scaled entries whose typical ones, of those kept, are near zero."""
        units = np.zeros(M * n + 1)
        for _ in range(PASSES):
            scaled = sizes + units[first] + units[second]
            scaled -= typical(line[kept], scaled[kept], M * r + M)[line]
            units[:-1] -= (move := step * typical(second[kept], scaled[kept], M * n))
            if np.abs(move).max() <= STILL:
                break
        return units[:-1].reshape(M, n), scaled

    units, scaled = equilibrated(_largest, np.bincount(line)[line] > 1, 0.5)
    for _ in range(2):
        of_line, of_column = (_largest(x, scaled, x.max() + 1)[x] for x in (line, second))
        kept = scaled > np.log2(ROUNDING) + np.minimum(of_line, of_column)
        units, scaled = equilibrated(_means, kept, 1.0)
    return np.exp2(np.round(units))


def column_sizes(matrices: np.ndarray) -> np.ndarray:
    """Return the largest absolute entries of the columns of ``(M, i, j)``."""
    return np.abs(matrices).max(1, initial=0.0)


def finite_sizes(vectors: np.ndarray, group: np.ndarray, M: int) -> np.ndarray:
    """Return the largest finite sizes ``(M, n)`` of the vectors ``(B or 1, n)`` of each group."""
    sizes = np.where(np.isfinite(vectors), np.abs(vectors), 0.0)
    if len(sizes) == 1 or M == 1:
        return sizes.max(0, keepdims=True).repeat(M, 0)
    largest = np.zeros((M, sizes.shape[1]))
    np.maximum.at(largest, group, sizes)
    return largest


def _means(groups: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    """Return the mean of the values in each of ``count`` groups, zero in empty ones."""
    sizes = np.bincount(groups, minlength=count)
    return np.bincount(groups, values, minlength=count) / np.maximum(sizes, 1)


def _largest(groups: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    """Return the largest of the values in each of ``count`` groups, zero in empty ones."""
    largest = np.full(count, -np.inf)
    np.maximum.at(largest, groups, values)
    return np.where(np.isfinite(largest), largest, 0.0)


def _apart(sizes: np.ndarray) -> bool:
    """Return True if positive sizes differ by more than `APART`."""
    smallest = np.where(sizes > 0, sizes, np.inf).min(-1, initial=np.inf)
    return bool((sizes.max(-1, initial=0.0) > APART * smallest).any())


def _typical(sizes: np.ndarray) -> np.ndarray:
    """Return `_power_above` of the lower median of the positive, finite sizes, ``(M, 1)``."""
    known = (sizes > 0) & (sizes < np.inf)
    powers = np.sort(np.where(known, _power_above(sizes), np.inf), axis=-1)
    count = known.sum(-1, keepdims=True)
    if not powers.shape[-1]:
        return np.ones((len(sizes), 1))
    middle = np.take_along_axis(powers, np.maximum(count - 1, 0) // 2, axis=-1)
    return np.where(count > 0, middle, 1.0)


def _power_above(sizes: np.ndarray) -> np.ndarray:
    """Return the powers of two next above sizes; one for ordinary, zero or not finite ones."""
    return np.where(_unusual(sizes), np.ldexp(1.0, np.frexp(sizes)[1]), 1.0)


def _unusual(sizes: np.ndarray) -> np.ndarray:
    return ((sizes > 0) & (sizes < SMALL)) | ((sizes > LARGE) & (sizes < np.inf))
