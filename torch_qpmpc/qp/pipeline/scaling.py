"""Scaling: a QP of unusual size is solved and certified in units of its own.

Tolerances are relative, but to no less than one: without units, solvers and certificate cannot
distinguish costs, variables or rows of size 1e-8 from zeros. With units of cost kappa, of length l,
and of the rows rho (of G) and gamma (of C),

    z = l z',  H' = H l^2 / kappa,  q' = q l / kappa,  C' = C l / gamma,  b' = b / gamma,
    G' = G l / rho,  (lb, ub)' = (lb, ub) / rho,  w' = w rho / kappa,

is the same QP. All units are powers of two, so that rounding does not change.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from torch_qpmpc.qp.kernels import theta as loops
from torch_qpmpc.qp.pipeline.arrays import Array, BatchSolution, Theta, per_qp

#: Sizes between these have the unit one.
SMALL, LARGE = 2.0**-7, 2.0**10


class Units(NamedTuple):
    """Units of each of the M matrix triples.

    ``cost`` and ``length`` ``(M, 1)``, ``rows`` ``(M, n_g)`` and ``equalities`` ``(M, n_c)``.
    """

    cost: np.ndarray
    length: np.ndarray
    rows: np.ndarray
    equalities: np.ndarray

    @classmethod
    def of(cls, theta: Theta, group: np.ndarray) -> Units | None:
        """Return the units of theta; None if all of them are one."""
        if not len(group) or not theta.q.shape[-1]:
            return None
        units = loops.units(theta, group, SMALL, LARGE)
        return None if units is None else cls(*units)

    def scaled(self, theta: Theta, group: np.ndarray) -> Theta:
        """Return theta in these units."""
        cost, length, rows, equalities = (per_qp(unit, group) for unit in self)
        by_row = (self.length / self.rows)[:, :, None]
        by_equality = (self.length / self.equalities)[:, :, None]
        return Theta(
            theta.H * (self.length**2 / self.cost)[:, :, None],
            theta.C * by_equality,
            theta.G * by_row,
            theta.q / (cost / length),
            theta.c / cost[:, 0],
            theta.b / equalities,
            theta.lb / rows,
            theta.ub / rows,
            theta.w * (rows / cost),
        )

    def inverse(self) -> Units:
        """Return the units that convert the scaled QPs to the original ones."""
        return Units(*(1 / unit for unit in self))

    def restored(self, solution: BatchSolution, group: Array) -> BatchSolution:
        """Return solutions in the original numbers, with the same relative residuals."""
        cost, length, rows, equalities = (per_qp(unit, group) for unit in self)
        return solution._replace(
            value=solution.value * cost[:, 0],
            z=solution.z * length,
            chi=solution.chi * (cost / equalities),
            lam=solution.lam * (cost / rows),
            xi=solution.xi * (cost / length),
        )

    def multipliers(self, lam: Array, group: Array) -> Array:
        """Return multipliers ``(B, n_g)`` of the rows in these units."""
        return lam * per_qp(self.rows / self.cost, group)
